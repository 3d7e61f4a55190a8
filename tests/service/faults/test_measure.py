# SPDX-License-Identifier: Apache-2.0
"""Measurement of a fault, on records made up for the tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.limits import Limits
from rti_mpc_service.faults.measure import Incident, Measured, measure
from rti_mpc_service.faults.promise import KEEPS_ON, STOPS
from rti_mpc_service.rig.robot_log import RobotLog

ROW_S = 0.01
LAG_S = 0.24
SLEW = 2.5  # 0.25 m/s in a period of 0.1 s
LIMITS = Limits(u_rest=np.zeros(1), lbu=np.array([-0.5]), ubu=np.array([0.5]), lbdu=np.array([-0.25]), ubdu=np.array([0.25]), dt_s=0.1)
FAULT_S, MEND_S, END_S = 1.0, 5.0, 7.0
INCIDENT = Incident(round(1e9 * FAULT_S), round(1e9 * MEND_S), round(1e9 * END_S))


def record(u: Callable[[Array], Array], answered: Callable[[Array], Array] = lambda t: np.ones_like(t)) -> RobotLog:
    """Robot on the x axis whose speed follows an input of time with a lag; every tenth state is answered where told."""
    t = ROW_S * np.arange(round(8.0 / ROW_S))
    inputs, speed, x = np.asarray(u(t), dtype=np.float64), float(u(t[:1])[0]), 0.0
    states = np.zeros((len(t), 2))
    for row in range(1, len(t)):
        speed += (1 - np.exp(-ROW_S / LAG_S)) * (inputs[row] - speed)
        x += ROW_S * speed
        states[row, 0] = x
    latency_us = np.where((np.arange(len(t)) % 10 == 0) & (answered(t) > 0), 2000.0, np.nan)
    stamp_ns = np.round(1e9 * t).astype(np.int64)
    return RobotLog(stamp_ns, np.arange(len(t)), states, inputs[:, None], latency_us, {})


def stopping(t: Array, *, speed: float = 0.4, after_s: float = 0.25, slew: float = SLEW) -> Array:
    """An input that ramps to rest some time after the fault, and is there again when mended."""
    ramp = np.clip(speed - slew * (t - FAULT_S - after_s), 0.0, speed)
    return np.where(t < MEND_S + 0.5, ramp, 0.1)


def answered_unless_broken(t: Array) -> Array:
    return np.where((t < FAULT_S) | (t > MEND_S), 1.0, 0.0)


def measured(log: RobotLog) -> Measured:
    return measure(log, log.x, np.full(len(log.x), 0.001), INCIDENT, LIMITS)


def test_ramp_to_rest_is_timed_from_its_first_step_to_its_last_and_the_robot_to_its_standstill() -> None:
    found = measured(record(stopping, answered_unless_broken))
    assert found.speed_m_s == pytest.approx(0.4, rel=1e-6)
    assert found.brake_s == pytest.approx(0.26, abs=1e-9)
    assert found.zero_s == pytest.approx(0.41, abs=1e-9)
    assert found.still_s == pytest.approx(0.41 + LAG_S * np.log(0.4 * 0.75 / 1e-3), abs=0.05)  # a quarter is lost in the ramp
    assert found.distance_m == pytest.approx(0.4 * (0.25 + 0.08 + LAG_S), abs=5e-3)
    assert found.recovery_s == pytest.approx(0.5, abs=2 * ROW_S)
    assert found.step_share == pytest.approx(0.9, abs=1e-6)  # nine steps of ten
    assert found.stale == 0
    assert not STOPS.broken(found)


def test_slowing_down_along_the_path_is_not_yet_braking() -> None:
    def slowing(t: Array) -> Array:
        return np.where(t < FAULT_S + 0.25, 0.4 - 0.02 * np.floor((t - FAULT_S) / 0.1 + 1e-9), stopping(t, speed=0.36))

    assert measured(record(slowing)).brake_s == pytest.approx(0.26, abs=0.02)


def test_stepwise_ramp_begins_with_its_first_step() -> None:
    def staircase(t: Array) -> Array:
        return np.where(t < FAULT_S + 0.2 - 1e-9, 0.4, np.where(t < FAULT_S + 0.3 - 1e-9, 0.15, 0.0))

    found = measured(record(staircase))
    assert (found.brake_s, found.zero_s) == (pytest.approx(0.2, abs=1e-9), pytest.approx(0.3, abs=1e-9))
    assert found.step_share == pytest.approx(1.0)


def test_ramp_that_waits_after_its_first_step_begins_with_that_step() -> None:
    def waiting(t: Array) -> Array:
        ramp = np.clip(0.25 - SLEW * (t - FAULT_S - 0.35), 0.0, 0.25)
        return np.where(t < FAULT_S + 0.2 - 1e-9, 0.5, ramp)

    found = measured(record(waiting))
    assert (found.brake_s, found.zero_s) == (pytest.approx(0.2, abs=1e-9), pytest.approx(0.45, abs=1e-9))


def test_ramp_that_is_too_steep_shows() -> None:
    assert measured(record(lambda t: stopping(t, slew=1.2 * SLEW))).step_share == pytest.approx(0.9 * 1.2, abs=1e-6)
    found = measured(record(lambda t: np.where(t < FAULT_S + 0.2, 0.4, 0.0)))
    assert found.step_share == pytest.approx(0.4 / 0.25)
    assert "step_share must be at most 1, got 1.6" in STOPS.broken(found)


def test_robot_that_moves_once_more_has_not_stopped_before() -> None:
    def twitching(t: Array) -> Array:
        return np.where((t > 3.0) & (t < 3.1), 0.05, stopping(t))

    found = measured(record(twitching))
    assert found.zero_s == pytest.approx(3.1 - FAULT_S, abs=2 * ROW_S)
    assert STOPS.broken(found)


def test_robot_that_never_stops_breaks_every_promise_of_stopping() -> None:
    broken = STOPS.broken(measured(record(lambda t: np.full_like(t, 0.2))))
    assert [text.split()[0] for text in broken] == ["brake_s", "zero_s", "still_s"]


def test_input_before_the_first_answer_to_a_fresh_state_is_stale() -> None:
    def stale(t: Array) -> Array:
        return np.where((t > MEND_S + 0.005) & (t < MEND_S + 0.035), 0.05, stopping(t))

    answers_late = record(stale, lambda t: np.where((t < FAULT_S) | (t > MEND_S + 0.15), 1.0, 0.0))
    assert measured(answers_late).stale == 3
    assert measured(record(stale, lambda t: np.ones_like(t))).stale == 0


def test_robot_that_drives_on_keeps_on() -> None:
    found = measured(record(lambda t: np.full_like(t, 0.2)))
    assert (found.missed, found.zero_s, found.still_s, found.brake_s) == (0, None, None, None)
    assert found.error_m == pytest.approx(0.001)
    assert found.distance_m == pytest.approx(0.2 * (MEND_S - FAULT_S), rel=0.01)
    assert not KEEPS_ON.broken(found)


@pytest.mark.parametrize(("until_s", "missed"), [(1.98, 0), (2.05, 1), (2.35, 4)])
def test_samples_without_a_command_are_counted(until_s: float, missed: int) -> None:
    found = measured(record(lambda t: np.full_like(t, 0.2), lambda t: np.where((t > 1.96) & (t < until_s), 0.0, 1.0)))
    assert found.missed == missed
    assert bool(KEEPS_ON.broken(found)) == bool(missed)


def test_silence_up_to_the_mending_counts_too() -> None:
    assert measured(record(lambda t: np.full_like(t, 0.2), lambda t: np.where(t > 4.55, 0.0, 1.0))).missed == 4
