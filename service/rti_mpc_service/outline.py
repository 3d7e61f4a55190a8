# SPDX-License-Identifier: Apache-2.0
"""Outlines of robots from above, relative to the point x, y of their model."""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array

AXLE_OFFSET_M = 0.2  # of the Pioneer's point x, y ahead of its axle, as in `rti_mpc.model.robots.pioneer_3dx`

# Corners (x ahead, y to the left), in m, from the middle of the axle.

PIONEER_BODY = [(0.2, 0.09), (0.13, 0.14), (-0.19, 0.14), (-0.255, 0.08), (-0.255, -0.08), (-0.19, -0.14), (0.13, -0.14), (0.2, -0.09)]
PIONEER_WHEEL = [(0.0975, 0.145), (-0.0975, 0.145), (-0.0975, 0.19), (0.0975, 0.19)]
ARROW = [(0.12, 0.0), (-0.12, 0.09), (-0.07, 0.0), (-0.12, -0.09)]

OUTLINES = {"pioneer_3dx": (PIONEER_BODY, PIONEER_WHEEL, [(x, -y) for x, y in reversed(PIONEER_WHEEL)])}


def outline(model: str) -> list[Array]:
    """
    Return the parts of a robot, the body first; an arrow for a model whose shape is not known.

    Args:
        model: Name of the model.

    Returns:
        Polygons in m, x ahead and y to the left, each of shape ``(M, 2)``.
    """
    parts = OUTLINES.get(model)
    return [np.array(ARROW)] if parts is None else [np.array(part) - (AXLE_OFFSET_M, 0.0) for part in parts]


def placed(polygon: Array, x: float, y: float, psi: float) -> Array:
    """Return a polygon, shape ``(M, 2)``, turned by `psi` and moved to ``(x, y)``."""
    c, s = np.cos(psi), np.sin(psi)
    return np.asarray(polygon @ np.array([[c, s], [-s, c]]) + (x, y))
