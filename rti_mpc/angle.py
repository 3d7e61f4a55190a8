# SPDX-License-Identifier: Apache-2.0
"""Whole turns in an angle, which do not change its direction."""

from __future__ import annotations

import math

MAX_ANGLE_RAD = 1e9  # the direction of a larger angle is lost in rounding


def whole_turns(angle: float) -> float:
    """Return the multiple of a turn nearest to an angle, in rad; 0 if the angle is not finite or beyond `MAX_ANGLE_RAD`."""
    return math.tau * round(angle / math.tau) if abs(angle) < MAX_ANGLE_RAD else 0.0
