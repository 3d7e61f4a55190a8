# SPDX-License-Identifier: Apache-2.0
"""Excuses of a busy host: the delays that it explains, and those that it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rti_mpc_service.faults.excuse import excuses, explained
from rti_mpc_service.faults.measure import Incident, Measured
from rti_mpc_service.faults.promise import KEEPS_ON, STOPS

S = 1_000_000_000
PERIOD_NS = S // 10
INCIDENT = Incident(fault_ns=1 * S, mend_ns=4 * S, end_ns=6 * S)
STOPPED = Measured(0.2, 0.21, 0.4, 1.8, 0.25, 0, 1.0, 2.5, 30, 0.5, 0.5)
DRIVING = replace(STOPPED, brake_s=None, zero_s=None, still_s=None, missed=2, error_m=0.002, recovery_s=0.01)
MISSED = np.array([2 * S, 3 * S])


def held_up(*stalls: tuple[float, float]) -> object:
    """A witness of stalls: when, s, and how long, ms."""
    return lambda from_ns, to_ns: sum(ms for at_s, ms in stalls if from_ns <= at_s * S <= to_ns)


def excused(measured: Measured, *stalls: tuple[float, float]) -> dict[str, float]:
    speed = 0.2  # m/s, of the reference
    return excuses(measured, MISSED, INCIDENT, PERIOD_NS, held_up_ms=held_up(*stalls), moved_m=lambda from_ns, to_ns: speed * (to_ns - from_ns) / S)  # type: ignore[arg-type]


def test_sample_that_was_missed_while_the_host_held_processes_up_is_shown_and_excused() -> None:
    found = excused(DRIVING, (1.95, 60.0), (3.05, 30.0))
    assert KEEPS_ON.broken(DRIVING) == ["missed must be at most 0, got 2"]
    assert KEEPS_ON.broken(DRIVING, found) == []
    assert explained(KEEPS_ON, DRIVING, found) == ["missed must be at most 0, got 2, of which the host explains 2"]


def test_error_is_excused_by_as_much_as_the_reference_moves_in_the_samples_that_the_host_took() -> None:
    """A whole one may leave the robot where it was: 20 mm each, at 0.2 m/s."""
    off = replace(DRIVING, error_m=0.025)
    both, one = excused(off, (1.95, 60.0), (3.05, 30.0)), excused(off, (1.95, 60.0))
    assert KEEPS_ON.broken(off, both) == []
    assert explained(KEEPS_ON, off, both)[1] == "error_m must be at most 0.01, got 0.025, of which the host explains 0.04"
    assert KEEPS_ON.broken(replace(off, missed=1), one) == []
    assert KEEPS_ON.broken(replace(off, missed=1, error_m=0.031), one) == ["error_m must be at most 0.01, got 0.031"]
    assert KEEPS_ON.broken(replace(off, missed=0), excused(off)) == ["error_m must be at most 0.01, got 0.025"], "nothing held it up"


@pytest.mark.parametrize("stalls", [[], [(1.95, 60.0)], [(1.95, 60.0), (3.5, 500.0)], [(1.95, 60.0), (3.0, 20.0)]])
def test_every_sample_needs_its_own_excuse_about_when_it_was_due_and_long_enough(stalls: list[tuple[float, float]]) -> None:
    found = excused(DRIVING, *stalls)
    assert KEEPS_ON.broken(DRIVING, found) == ["missed must be at most 0, got 2"]
    assert explained(KEEPS_ON, DRIVING, found) == []


def test_time_is_excused_by_as_much_as_the_host_took_of_it_and_no_more() -> None:
    late = replace(STOPPED, brake_s=0.34)
    assert STOPS.broken(late, excused(late, (1.1, 30.0))) == ["brake_s must be at most 0.3, got 0.34"]
    assert STOPS.broken(late, excused(late, (1.1, 45.0))) == []
    assert STOPS.broken(late, excused(late, (1.5, 45.0))), "the host held up what came later"
    assert explained(STOPS, STOPPED, excused(STOPPED, (1.1, 45.0))) == [], "what is within the promise needs none"


def test_nothing_excuses_what_never_happened_nor_a_step_that_is_too_large() -> None:
    for wrong in (replace(STOPPED, zero_s=None), replace(STOPPED, step_share=1.1), replace(STOPPED, stale=1)):
        found = excused(wrong, (1.1, 1e6))
        assert STOPS.broken(wrong, found) == STOPS.broken(wrong) != []
        assert explained(STOPS, wrong, found) == []
