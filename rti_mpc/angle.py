# SPDX-License-Identifier: Apache-2.0
"""Whole turns in an angle, which say nothing about where it points."""

from __future__ import annotations

import math

MAX_ANGLE_RAD = 1e9  # the direction of a larger angle is lost in rounding


def whole_turns(angle: float) -> float:
    """Return the whole turns in an angle, in rad, at most half a turn from it; none if it is not finite or beyond `MAX_ANGLE_RAD`."""
    return math.tau * round(angle / math.tau) if abs(angle) < MAX_ANGLE_RAD else 0.0
