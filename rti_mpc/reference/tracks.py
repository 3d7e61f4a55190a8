# SPDX-License-Identifier: Apache-2.0
"""
Three race tracks for a model car of 1:10: a hairpin, a chicane and a long oval.

Each is a closed cubic B-spline of a few control points, with the same width everywhere.
"""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.reference.path import Path, smooth_path

HALF_WIDTH_M = 0.75
POINTS_PER_SPAN = 12
CONTROL_POINTS_M: dict[str, list[tuple[float, float]]] = {
    "hairpin": [
        (0, 0),
        (5, 0),
        (10, 0),
        (13, 1),
        (13, 4),
        (10, 4.5),
        (6, 3),
        (2.5, 3),
        (2.5, 6),
        (6, 6.5),
        (9, 8),
        (7, 11),
        (1, 11),
        (-4, 8),
        (-4, 2),
    ],
    "chicane": [(0, 0), (4, 0), (7, 0), (9, 1.8), (11.5, -0.9), (14, 0.5), (18, 0), (22, 1), (22, 6), (18, 7), (9, 7), (0, 7), (-4, 6), (-4, 1)],
    "oval": [(0, 0), (7, 0), (14, 0), (21, 0), (27, 0.5), (29, 4.5), (27, 8.5), (21, 9), (14, 9), (7, 9), (0, 9), (-6, 8.5), (-8, 4.5), (-6, 0.5)],
}
TRACKS = tuple(CONTROL_POINTS_M)


def track(name: str, speed_m_s: float = 1.0) -> Path:
    """Build one of `TRACKS`, with one speed everywhere, in m/s, which `Path.limited` replaces by a profile."""
    return smooth_path(centre_line(name), right=HALF_WIDTH_M, left=HALF_WIDTH_M, speed=speed_m_s)


def centre_line(name: str) -> Array:
    """Return points of the centre line of one of `TRACKS`, the first also as the last, shape ``(n, 2)``, in m."""
    from scipy.interpolate import BSpline  # as in `smooth_path`

    control = np.array(CONTROL_POINTS_M[name], dtype=np.float64)
    n = len(control)
    curve = BSpline(np.arange(-3.0, n + 4.0), np.vstack([control, control[:3]]), 3)
    points = np.asarray(curve(np.linspace(0.0, n, POINTS_PER_SPAN * n + 1)), dtype=np.float64)
    points[-1] = points[0]
    return points
