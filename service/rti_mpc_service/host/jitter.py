# SPDX-License-Identifier: Apache-2.0
"""Jitter of the host: how late a bare timer wakes."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray


def bare_timer(period_s: float, go_on: Callable[[], object]) -> NDArray[np.int64]:
    """
    Sleep to the ticks of an absolute grid, and note when each was due and how late the wake-up is.

    Args:
        period_s: Time between two ticks, s; missed ticks are skipped.
        go_on: Called at each tick; the timer ends when it returns a false value.

    Returns:
        Due times by the monotonic clock, and lateness, ns, shape ``(n, 2)``.
    """
    period_ns, ticks = round(1e9 * period_s), []
    due_ns = time.monotonic_ns()
    while go_on():
        due_ns += period_ns
        due_ns += max(0, time.monotonic_ns() - due_ns) // period_ns * period_ns
        time.sleep(max(0.0, 1e-9 * (due_ns - time.monotonic_ns())))
        ticks.append((due_ns, time.monotonic_ns() - due_ns))
    return np.array(ticks, np.int64).reshape(-1, 2)
