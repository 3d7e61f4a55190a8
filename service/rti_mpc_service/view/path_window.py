# SPDX-License-Identifier: Apache-2.0
"""The part of a path around a robot that follows it, from the stage parameters of a reference."""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array

KNOT_PARTS = 5  # x, y, width to the right, width to the left, speed; see `rti_mpc.model.path_following`
MIN_KNOTS = 4
POINTS_PER_KNOT = 4


def path_window(p: Array, first: int, knots: int) -> tuple[Array, Array, Array]:
    """
    Return the path and its two edges, to the right and to the left.

    Args:
        p: Stage parameters, shape ``(np,)``.
        first: Index of ``path_start`` among them; the step and the knots follow.
        knots: Number of knots, control points of a uniform cubic B-spline.

    Returns:
        Three polylines, each of shape ``(M, 2)``, in m.
    """
    knot = p[first + 2 : first + 2 + KNOT_PARTS * knots].reshape(knots, KNOT_PARTS)
    t = np.linspace(1.0, knots - 2.0, POINTS_PER_KNOT * (knots - 3) + 1)
    away = t[:, None] - np.arange(knots)
    outer, inner = np.maximum(2.0 - np.abs(away), 0.0), np.maximum(1.0 - np.abs(away), 0.0)
    centre = (outer**3 - 4.0 * inner**3) / 6.0 @ knot[:, :2]
    along = -np.sign(away) * (outer**2 - 4.0 * inner**2) / 2.0 @ knot[:, :2]
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.hypot(*along.T), 1e-12)[:, None]  # to the left
    right, left = (inner @ knot[:, 2:4]).T
    return centre, centre - right[:, None] * normal, centre + left[:, None] * normal
