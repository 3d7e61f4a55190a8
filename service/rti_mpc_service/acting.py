# SPDX-License-Identifier: Apache-2.0
"""
Bounds that act in a plan, told from the plan alone, so that `rti-mpc why` and the viewer say the same.

A bound acts at a stage at which the plan is at it, or beyond it. Inputs are at their bounds to rounding; a
constraint, such as the distance to an obstacle, is held along its linearization only, and may be a little away.
"""

from __future__ import annotations

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array

DISTANCE = 1e-4  # from a bound at which it acts, in units of its signal; past a disc, of 87 nodes that were held 76 are nearer, of others 7


def unit(lower: Array | float, upper: Array | float, one: float = 1.0) -> float:
    """Return what a signal ranges over whose scale is not known: half its range; with one bound its magnitude, `one` SI unit of it at least."""
    low, high = float(np.min(lower)), float(np.max(upper))
    ends = [abs(end) for end in (low, high) if isfinite(end)]
    return 0.5 * (high - low) if len(ends) == 2 else max([one, *ends])


def at_bounds(values: Array, lower: Array | float, upper: Array | float, of: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """
    Return at which stages a lower and an upper bound acts.

    Args:
        values: Along a plan.
        lower: Lower bound, or that of each stage; minus infinity where there is none.
        upper: Upper bound, likewise.
        of: Scale of the signal, of an increment that of its input; where nobody has told it, what `unit` returns.
    """
    near = DISTANCE * of
    return np.asarray(values <= lower + near), np.asarray(values >= upper - near)
