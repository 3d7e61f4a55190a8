# SPDX-License-Identifier: Apache-2.0
"""Clock of the simulation: waits end on an absolute grid."""

from __future__ import annotations

import time
from threading import Event

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc_sim.clock import Clock

HALF = 20  # of the waits
BUSY_MS = 2.0  # after each
ROUNDING_NS = 8  # of robot time: two monotonic ones, at four times real speed


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_waits_end_on_an_absolute_grid(speed: float) -> None:
    """Never early, and what is done in between does not add up."""
    clock = Clock(speed)
    late_ms = []
    for k in range(1, 2 * HALF + 1):
        clock.wait(k * round(10_000_000 * speed), Event())
        late_ms.append(1e-6 * (clock.now_ns() / speed - k * 10_000_000))
        time.sleep(1e-3 * BUSY_MS)
    assert min(late_ms) >= 0.0
    assert min(late_ms[HALF:]) < HALF * BUSY_MS


def test_a_stopped_wait_ends_soon() -> None:
    stop = Event()
    stop.set()
    clock = Clock()
    clock.wait(10_000_000_000, stop)
    assert clock.now_ns() < 5_000_000_000  # of the ten that were asked for


def test_clock_set_back_goes_on_from_there_at_its_speed() -> None:
    clock = Clock(4.0)
    clock.wait(100_000_000, Event())
    before_ns = time.monotonic_ns()
    assert clock.set_back(80_000_000) >= 5_000_000
    after_ns = time.monotonic_ns()
    clock.wait(120_000_000, Event())
    now_ns = time.monotonic_ns()
    assert clock.at_ns(now_ns) >= 120_000_000
    assert 80_000_000 + 4 * (now_ns - after_ns) - ROUNDING_NS <= clock.at_ns(now_ns) <= 80_000_000 + 4 * (now_ns - before_ns) + ROUNDING_NS


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_speed_must_be_positive(speed: float) -> None:
    with pytest.raises(ConfigError, match="speed"):
        Clock(speed)
