# SPDX-License-Identifier: Apache-2.0
"""Schedule of the inputs that act; the single rules are tested with the actuators, `tests/wire/test_actuator.py`."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.approach import Increments
from rti_mpc.contract.message import Command
from rti_mpc.contract.schedule import RAMP_STEP_NS, Schedule, end_ns, unfit
from rti_mpc.contract.status import Mode, QpStatus

MS = 1_000_000
SLEW = np.array([2.5, 4.0])  # per s: 0.25 and 0.4 over 100 ms


def command(u: Array, stamp_ms: int = 0, valid_ms: int = 250, period_ms: int = 100) -> Command:
    stamp_ns = stamp_ms * MS
    return Command(1, 1, stamp_ns, 1, 1, stamp_ns, stamp_ns + valid_ms * MS, 0, Mode.TRACKING, QpStatus.SOLVED, period_ms * MS, u)


def schedule(*commands: Command) -> Schedule:
    plans = Schedule(np.zeros(2), SLEW)
    for one in commands:
        plans.add(one, one.stamp_ns, end_ns(one))
    return plans


def trace(plans: Schedule, from_ms: int, to_ms: int) -> Array:
    """Inputs every millisecond."""
    return np.array([plans.at(t * MS)[0] for t in range(from_ms, to_ms)])


def test_any_time_may_be_asked_for_in_any_order() -> None:
    plans = schedule(command(np.full((4, 2), 0.2)), command(np.full((4, 2), 0.3), stamp_ms=100))
    forward = trace(plans, -50, 600)
    backward = np.array([plans.at(t * MS)[0] for t in range(599, -51, -1)])[::-1]
    np.testing.assert_array_equal(forward, backward)


def test_told_change_is_the_next_one() -> None:
    plans = schedule(command(np.array([[0.1, 0.1], [0.2, 0.2], [0.3, 0.3]]), valid_ms=220))
    t = -10 * MS
    for _ in range(20):
        u, change_ns, _ = plans.at(t)
        if change_ns > 10**18:
            break
        np.testing.assert_array_equal(plans.at(change_ns - 1)[0], u)
        assert (plans.at(change_ns)[0] != u).any()
        t = change_ns
    assert not plans.at(t)[0].any()


@pytest.mark.parametrize("valid_ms", [110, 150, 199, 250])
@pytest.mark.parametrize("first", [0.5, 0.35, -0.5])
def test_ramp_after_a_row_that_has_braked_itself_stays_inside_the_slew_limits_over_every_window(valid_ms: int, first: float) -> None:
    """A row's jump counts against the limits for as long as it lasts, and the ramp comes on top of it."""
    rows = np.array([[first, 0.7], [first - 0.25 * np.sign(first), 0.3], [first - 0.5 * np.sign(first), 0.0]])
    plans = schedule(command(np.tile(rows[0], (10, 1)), stamp_ms=-900, valid_ms=900), command(rows, valid_ms=valid_ms))
    u = trace(plans, -300, 900)
    for window in (10, 50, 100):
        reach = np.maximum(SLEW * 1e-3 * window, [0.25, 0.4])  # a row jumps at once by what it may over its period
        assert (np.abs(u[window:] - u[:-window]) <= reach + 1e-12).all()
    assert not u[-1].any()


def test_ramp_is_never_later_for_a_row_that_has_braked_itself() -> None:
    """It has only begun earlier."""
    level = schedule(command(np.full((4, 2), 0.5)))
    braked = schedule(command(np.array([[0.5, 0.5], [0.5, 0.5], [0.25, 0.25], [0.0, 0.0]])))
    assert (trace(braked, 0, 600) <= trace(level, 0, 600) + 1e-12).all()


def test_ramp_that_nobody_could_have_commanded_waits_for_no_more_than_a_row() -> None:
    plans = schedule(command(np.full((9, 2), 100.0), stamp_ms=-800, valid_ms=800), command(np.full((9, 2), 1.0), valid_ms=150))
    np.testing.assert_array_equal(plans.at(150 * MS)[0] < 1.0, [True, True])


def test_braking_from_an_input_begins_at_once_and_ends_at_rest() -> None:
    plans = schedule(command(np.full((4, 2), 0.5)))
    plans.brake(np.array([0.25, 0.4]), 40 * MS)
    u, change_ns, braking = plans.at(40 * MS)
    np.testing.assert_allclose(u, [0.225, 0.36])
    assert (change_ns, braking) == (40 * MS + RAMP_STEP_NS, True)
    assert not plans.at(140 * MS)[0].any()


@pytest.mark.parametrize("forgets_ms", [None, 150])
def test_inputs_that_acted_in_an_interval_are_those_of_each_of_its_times(forgets_ms: int | None) -> None:
    rows = 0.01 * np.arange(8.0).reshape(4, 2)
    plans = schedule(command(rows), command(rows + 0.1, stamp_ms=130, valid_ms=350), command(rows + 0.2, stamp_ms=230, valid_ms=150))
    if forgets_ms is not None:
        plans.forget(forgets_ms * MS)
    every = trace(plans, -50, 700).tolist()
    for from_ms in range(-50, 650, 10):
        for to_ms in range(from_ms, min(from_ms + 250, 700), 10):
            acted = [u for u, before in zip(every[from_ms + 50 : to_ms + 50], [None, *every[from_ms + 50 :]], strict=False) if u != before]
            assert plans.acted(from_ms * MS, to_ms * MS) == acted, (from_ms, to_ms)


def test_what_is_forgotten_was_over() -> None:
    plans = schedule(*(command(np.full((4, 2), 0.01 * i), stamp_ms=100 * i) for i in range(20)))
    before = trace(plans, 1500, 2600)
    plans.forget(1500 * MS)
    assert len(plans) == 5
    np.testing.assert_array_equal(trace(plans, 1500, 2600), before)


@pytest.mark.parametrize("by_ms", [0, 5000, -5000])
@pytest.mark.parametrize("cut_ms", [50, 101, 150, 230, 300])
def test_what_acts_is_cut_at_a_time_that_is_now_another_one(by_ms: int, cut_ms: int) -> None:
    """The ramp that follows is that of a plan which was valid until then, with its last row's jump paid for."""
    rows = np.array([[0.5, 0.7], [0.25, 0.3], [0.25, 0.3]])
    plans, expired = schedule(command(rows, valid_ms=250)), schedule(command(rows, valid_ms=min(cut_ms, 250)))
    plans.add(command(rows, stamp_ms=400), 400 * MS, 650 * MS)  # which never acts
    plans.cut(cut_ms * MS, (cut_ms + by_ms) * MS)
    np.testing.assert_allclose(trace(plans, cut_ms + by_ms, cut_ms + by_ms + 600), trace(expired, cut_ms, cut_ms + 600), atol=1e-12)


def test_time_that_is_forgotten_is_cut_at_what_acted_before() -> None:
    plans = schedule()
    plans.brake(np.array([0.4, 0.0]), 0)
    plans.cut(-100 * MS, 900 * MS)
    np.testing.assert_allclose(plans.at(900 * MS - 1)[0], [0.4, 0.0])
    np.testing.assert_allclose(plans.at(900 * MS)[0], [0.375, 0.0])


def test_plan_that_replaces_all_that_is_remembered_is_approached_from_what_acted_before() -> None:
    plans = Schedule(np.zeros(2), SLEW, Increments(np.array([-0.25, -0.4]), np.array([0.25, 0.4]), 100 * MS))
    late = command(np.full((4, 2), 0.1), stamp_ms=1000)
    plans.add(late, late.stamp_ns, end_ns(late))
    plans.forget(2000 * MS)
    sooner = command(np.full((4, 2), 0.5), stamp_ms=900)
    plans.add(sooner, sooner.stamp_ns, end_ns(sooner))
    np.testing.assert_array_equal(plans.at(900 * MS)[0], [0.25, 0.4])


def test_plan_longer_than_any_horizon_is_unfit() -> None:
    """A message has room for 65,000 rows, whose approach kept a guard from its robot for seconds."""
    assert unfit(command(np.zeros((1000, 2))), 2, 1) == ""
    assert unfit(command(np.zeros((1001, 2))), 2, 1) == "wrong_shape"
