# SPDX-License-Identifier: Apache-2.0
"""
Slew limits of the inputs that really act: the rows of a plan, approached from the inputs that acted before.

A controller that does not know of a lost command starts its plan from an input that
does not act. Whoever plays the rows, or passes them on, therefore brings them inside the
slew limits of the inputs that acted: no two inputs within three quarters of a period
differ by more than one increment. The last quarter is left to transport: with limits over
a whole period, commands that arrive some milliseconds sooner or later would clip healthy
plans, and no late plan could reverse its direction. `rti_mpc.control.sent` holds late
commands to the same window.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rti_mpc.array import Array

SLEW_WINDOW_PERIODS = 0.75  # inputs within this time differ by no more than one increment
TOLERANCE_SHARE = 1e-6  # of the largest value of an input: above any rounding, single precision included, and below what an actuator resolves
UNCHANGED_SHARE = 1e-9  # of the largest increment: a row that differs by less has not been changed


@dataclass(frozen=True, eq=False)
class Increments:
    """
    Limits of the change of inputs over one period.

    Attributes:
        lbdu: Lower bound of an input's change over `dt_ns`, shape ``(nu,)``, at most 0.
        ubdu: Upper bound of an input's change, at least 0.
        dt_ns: The period.
        unchanged: By how much a row may differ from itself, approached, by rounding, shape ``(nu,)``; 0 without limits, which change nothing.
    """

    lbdu: Array
    ubdu: Array
    dt_ns: int
    unchanged: Array = field(init=False)

    def __post_init__(self) -> None:
        """Work out what is rounding."""
        largest = np.maximum(-self.lbdu, self.ubdu)
        object.__setattr__(self, "unchanged", np.where(np.isfinite(largest), UNCHANGED_SHARE * largest, 0.0))


def magnitudes(lbu: float | Array, ubu: float | Array, lbdu: Array, ubdu: Array) -> Array:
    """Return what the rounding of each input is relative to, shape ``(nu,)``: its largest value; its largest increment without bounds; or else 1."""
    largest, increment = np.maximum(np.abs(lbu), np.abs(ubu)), np.maximum(-lbdu, ubdu)
    known = np.where(np.isfinite(increment) & (increment > 0.0), increment, 1.0)
    return np.where(np.isfinite(largest) & (largest > 0.0), largest, known)


def segments(at: Callable[[int], tuple[Array, int, bool]], from_ns: int, to_ns: int) -> list[tuple[int, Array]]:
    """Return the inputs that acted in an interval, oldest first, each behind the time until which it acted; `at` is that of a `Schedule`."""
    acted = []
    while from_ns < to_ns:
        u, change_ns, _ = at(from_ns)
        from_ns = min(change_ns, to_ns)
        acted.append((from_ns, u))
    return acted


def approach(
    u: Array, stamp_ns: int, period_ns: int, start_ns: int, acted: list[tuple[int, Array]], limits: Increments, *, late: bool = True
) -> Array:
    """
    Bring the rows of a plan inside the slew limits of what acted before it.

    Args:
        u: Rows, shape ``(n, nu)``; row ``i`` acts from ``stamp_ns + i * period_ns``.
        stamp_ns: When row 0 would act.
        period_ns: Time between rows.
        start_ns: When the plan begins to act, with its row for that time.
        acted: Inputs that acted in the period before `start_ns`, as `segments` returns them.
        limits: The slew limits.
        late: Whether it may begin later, by up to a row: what acts until then may be what acted before.

    Returns:
        The rows, shape ``(n, nu)``: `u` itself if it is inside.
    """
    window_ns = round(SLEW_WINDOW_PERIODS * limits.dt_ns)
    share = min(1.0, period_ns / limits.dt_ns)
    lowest, highest = share * limits.lbdu, share * limits.ubdu
    change = np.diff(u, axis=0)
    even = period_ns >= window_ns and bool((change >= lowest - limits.unchanged).all() and (change <= highest + limits.unchanged).all())
    first = max(0, (start_ns - stamp_ns) // period_ns)
    begins_ns = stamp_ns + (first + 1) * period_ns  # when a plan that comes late by less than a row begins
    rows, near, limited = u, list(acted), False
    for k in range(first, len(u)):
        row_ns = max(start_ns, stamp_ns + k * period_ns)
        if even and k > first and not limited and row_ns - window_ns >= start_ns:
            break
        row = within(u[k], near, row_ns - window_ns, limits)
        was_limited, limited = limited, bool((np.abs(row - u[k]) > limits.unchanged).any())
        if limited or was_limited:
            if rows is u:
                rows = u.copy()
                if late:  # if the plan comes late, the robot begins with the second row
                    near = [(begins_ns if until_ns <= start_ns + period_ns else until_ns, before) for until_ns, before in near]
            row = within(u[k], near, row_ns - limits.dt_ns, limits)
            if k > first:
                row = np.minimum(np.maximum(row, rows[k - 1] + lowest), rows[k - 1] + highest)
            limited = bool((np.abs(row - u[k]) > limits.unchanged).any())
            rows[k] = row
        if row_ns - limits.dt_ns >= begins_ns:
            near = [(until_ns, before) for until_ns, before in near if until_ns > row_ns - limits.dt_ns]
        near.append(((row_ns if late else stamp_ns + k * period_ns) + period_ns, rows[k]))
    return rows


def within(row: Array, acted: list[tuple[int, Array]], after_ns: int, limits: Increments) -> Array:
    """Return the input nearest to a row inside the slew limits of all inputs that acted after a time; the last of them is always allowed."""
    now = acted[-1][1]
    near = np.array([u for until_ns, u in acted if until_ns > after_ns] or [now])
    lower = np.minimum(near.max(axis=0) + limits.lbdu, now)
    upper = np.maximum(near.min(axis=0) + limits.ubdu, now)
    clipped: Array = np.minimum(np.maximum(row, lower), upper)
    return clipped
