# SPDX-License-Identifier: Apache-2.0
"""Whole turns in an angle, which say nothing about where it points."""

from __future__ import annotations

import math

COUNTED_RAD = 1e9  # from here on what an angle is beside its turns is lost in rounding


def whole_turns(angle: float) -> float:
    """Return the whole turns in an angle, in rad, at most half a turn from it; none if it is not finite or beyond `COUNTED_RAD`."""
    return math.tau * round(angle / math.tau) if abs(angle) < COUNTED_RAD else 0.0
