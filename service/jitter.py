# SPDX-License-Identifier: Apache-2.0
"""What the host does to a loop that does nothing: how late a bare timer wakes."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from rti_mpc.array import Array


def lateness_us(period_s: float, go_on: Callable[[], object]) -> Array:
    """
    Sleep to the ticks of an absolute grid, and note how late each wake-up is.

    Args:
        period_s: Between two ticks, s; those that were missed are left out of the grid.
        go_on: Asked at each tick.

    Returns:
        Lateness of each wake-up, us, shape ``(n,)``.
    """
    period_ns, late_us = round(1e9 * period_s), []
    due_ns = time.monotonic_ns()
    while go_on():
        due_ns += period_ns
        due_ns += max(0, time.monotonic_ns() - due_ns) // period_ns * period_ns
        time.sleep(max(0.0, 1e-9 * (due_ns - time.monotonic_ns())))
        late_us.append(1e-3 * (time.monotonic_ns() - due_ns))
    return np.array(late_us)
