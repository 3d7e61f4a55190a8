# SPDX-License-Identifier: Apache-2.0
"""Inputs that act on a way to rest, and the feedback from states to them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.approach import SLEW_WINDOW_PERIODS, Increments
from rti_mpc.contract.belief import Belief
from rti_mpc.contract.message import Command
from rti_mpc.contract.schedule import NO_COMMAND, Schedule, end_ns, unfit
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.contract.way import Way
from rti_mpc.rotation import Rotations

MS = 1_000_000
STEP = np.array([0.25])  # per 100 ms
SLEW = STEP / 0.1
LIMITS = Increments(-STEP, STEP, 100 * MS)
BOUNDS = (np.array([-0.5]), np.array([0.5]))
BRAKES = [0.0, -0.25, -0.4, -0.4, -0.15, 0.0]  # of a robot whose input is an acceleration: not even on its way to 0
PLAIN = Rotations(2)
GAIN = {"x_rest": np.column_stack([np.linspace(1.0, 0.0, 6), np.linspace(3.0, 4.0, 6)]), "K": np.array([[0.5, 0.1]])}


def command(u: float = 0.2, rows: list[float] | None = None, stamp_ms: int = 0, period_ms: int = 100, **change: Any) -> Command:
    """A plan of constant rows that ends after 250 ms, with a way to rest."""
    stamp_ns = stamp_ms * MS
    way = np.array(BRAKES if rows is None else rows)[:, None]
    plan = Command(1, 1, stamp_ns, 1, 1, stamp_ns, stamp_ns + 250 * MS, 0, Mode.TRACKING, QpStatus.SOLVED, 100 * MS, np.full((4, 1), u))
    return replace(plan, **({"rest_period_ns": period_ms * MS, "u_rest": way} | change))


def schedule(*commands: Command, rotations: Rotations = PLAIN) -> Schedule:
    plans = Schedule(np.zeros(1), SLEW, LIMITS, BOUNDS, rotations)
    for one in commands:
        plans.add(one, one.stamp_ns, end_ns(one))
    return plans


def trace(plans: Schedule, from_ms: int, to_ms: int) -> Array:
    """Inputs every millisecond."""
    return np.array([plans.at(t * MS)[0][0] for t in range(from_ms, to_ms)])


def inside(u: Array) -> bool:
    """Whether inputs of every millisecond keep to the slew limits within three quarters of a period."""
    window = round(1e3 * SLEW_WINDOW_PERIODS * 0.1)
    return all(np.ptp(u[i : i + window + 1]) <= STEP[0] + 1e-9 for i in range(len(u)))


def test_rows_to_rest_act_from_the_end_of_the_plan_and_the_last_one_is_held() -> None:
    plans = schedule(command())
    seen = [(float(u[0]), braking) for u, _, braking in (plans.at(t * MS) for t in range(0, 1000, 50))]
    rest = [(row, True) for row in BRAKES for _ in range(2)]
    assert seen[:5] == [(0.2, False)] * 5
    assert seen[5:17] == rest
    assert seen[17:] == [(0.0, True)] * 3
    assert plans.at(10**15)[0] == 0.0


def test_input_held_at_last_need_not_be_that_at_which_the_model_rests() -> None:
    plans = schedule(command(rows=[0.3, 0.4]))
    assert plans.at(10_000 * MS)[0] == 0.4
    assert plans.rest(0) == 0.4
    assert not plans.rests(300 * MS)
    assert plans.rests(350 * MS)


def test_robot_has_come_to_rest_when_no_row_moves_it_any_more() -> None:
    plans = schedule(command())
    assert [plans.rests(t * MS) for t in (0, 250, 260, 740, 749, 750, 5000)] == [False] * 5 + [True] * 2, "a row of 0 between others is none"


@pytest.mark.parametrize("period_ms", [7, 10, 30, 100, 250])
def test_way_to_rest_is_approached_inside_the_slew_limits_and_reached(period_ms: int) -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        rows = rng.uniform(-0.5, 0.5, int(rng.integers(1, 40))).tolist()
        plans = schedule(command(u=float(rng.uniform(-0.5, 0.5)), rows=rows, period_ms=period_ms, valid_until_ns=int(rng.integers(1, 300)) * MS))
        u = trace(plans, 0, 600 + len(rows) * period_ms)
        assert inside(u)
        assert u[-1] == rows[-1]


def test_told_change_is_the_next_one() -> None:
    plans = schedule(command(rows=[0.5, -0.5, 0.1], period_ms=30))
    t = -10 * MS
    for _ in range(100):
        u, change_ns, _ = plans.at(t)
        assert change_ns > t
        if change_ns > 10**18:
            break
        np.testing.assert_array_equal(plans.at(change_ns - 1)[0], u)
        t = change_ns
    assert plans.at(t)[0] == 0.1


def test_command_without_rows_to_rest_ramps_as_before() -> None:
    with_none, bare = command(rows=[]), command(rows=[], rest_period_ns=0, u_rest=np.zeros((0, 0)))
    np.testing.assert_array_equal(trace(schedule(with_none), 0, 600), trace(schedule(bare), 0, 600))
    assert schedule(bare).at(250 * MS)[0] == pytest.approx(0.175)


@pytest.mark.parametrize("by_ms", [0, 5000, -5000])
def test_plan_that_is_cut_is_followed_by_its_own_way_to_rest_from_then_on(by_ms: int) -> None:
    plans, whole = schedule(command()), schedule(command(valid_until_ns=120 * MS))
    plans.cut(120 * MS, (120 + by_ms) * MS)
    np.testing.assert_array_equal(trace(plans, 120 + by_ms, 900 + by_ms), trace(whole, 120, 900))


@pytest.mark.parametrize("by_ms", [0, 5000, -5000])
def test_way_to_rest_goes_on_where_the_clock_jumps(by_ms: int) -> None:
    plans, whole = schedule(command()), schedule(command())
    plans.at(600 * MS)
    plans.cut(520 * MS, (520 + by_ms) * MS)
    np.testing.assert_array_equal(trace(plans, 520 + by_ms, 1000 + by_ms), trace(whole, 520, 1000))


def test_way_that_is_limited_by_what_is_forgotten_goes_on_the_same_where_the_clock_jumps() -> None:
    rows = command(u=0.5, rows=[-0.5] * 3, period_ms=200, valid_until_ns=30 * MS)
    plans, whole = schedule(command(u=0.25, stamp_ms=-220), rows), schedule(command(u=0.25, stamp_ms=-220), rows)
    for kept in (plans, whole):
        kept.at(31 * MS)
        kept.forget(180 * MS)
    plans.cut(180 * MS, 5180 * MS)
    np.testing.assert_array_equal(trace(plans, 5180, 6000), trace(whole, 180, 1000))


def test_time_that_is_forgotten_is_cut_into_the_way_to_rest_of_the_first_plan() -> None:
    plans = schedule(command())
    plans.forget(200 * MS)
    plans.cut(-500 * MS, 0)
    assert plans.at(10**12)[0] == 0.0
    assert plans.at(210 * MS)[0] == -0.4


def test_copy_and_forgetting_change_nothing_of_the_way() -> None:
    plans = schedule(command(), command(u=0.1, stamp_ms=100))
    copied, expected = schedule(), trace(schedule(command(), command(u=0.1, stamp_ms=100)), 340, 1200)
    copied.copy(plans)
    plans.forget(340 * MS)
    np.testing.assert_array_equal(trace(plans, 340, 1200), expected)
    np.testing.assert_array_equal(trace(copied, 340, 1200), expected)


# Feedback.


def test_deviation_is_that_from_the_state_of_its_time_between_the_rows() -> None:
    way = Way.of(command(**GAIN), 250 * MS)
    assert way is not None
    for t_ms, x, u in (
        (250, [1.0, 3.0], 0.0),
        (250, [1.2, 3.0], -0.1),
        (300, [0.9, 3.1], 0.0),  # half way to the next row
        (350, [0.8, 3.2], 0.0),
        (750, [0.0, 4.0], 0.0),
        (9750, [0.2, 4.0], -0.1),  # held
    ):
        np.testing.assert_allclose(way.corrected(np.array(x), t_ms * MS, PLAIN).correction, [u], atol=1e-12)


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 2])
def test_angles_are_compared_modulo_a_turn(turns: int) -> None:
    way = Way.of(command(x_rest=np.column_stack([np.linspace(3.1, 3.2, 6), np.zeros(6)]), K=np.array([[1.0, 0.0]])), 0)
    assert way is not None
    corrected = way.corrected(np.array([3.2 + turns * 2 * np.pi, 0.0]), 0, Rotations(2, (0,)))
    np.testing.assert_allclose(corrected.correction, [-0.1], atol=1e-12)


def test_state_from_before_the_way_or_of_another_size_corrects_nothing() -> None:
    way = Way.of(command(**GAIN), 250 * MS)
    assert way is not None
    assert way.corrected(np.ones(2), 249 * MS, PLAIN) is way
    assert way.corrected(np.ones(3), 300 * MS, Rotations(3)) is way
    assert way.corrected(None, 300 * MS, PLAIN) is way


def test_correction_acts_until_the_next_state_inside_bounds_and_slew_limits() -> None:
    plans = schedule(command(**GAIN))
    assert not plans.feed_back(np.array([9.0, 9.0]), 200 * MS, 200 * MS), "a plan acts"
    assert plans.feed_back(np.array([1.2, 3.0]), 250 * MS, 260 * MS)
    assert plans.at(259 * MS)[0] == 0.0
    np.testing.assert_allclose(plans.at(300 * MS)[0], [-0.05])  # one increment within three quarters of a period, from 0.2
    np.testing.assert_allclose(plans.at(400 * MS)[0], [-0.25])  # of -0.35: one increment within a period where it is limited
    np.testing.assert_allclose(plans.at(460 * MS)[0], [-0.5])
    assert plans.feed_back(np.array([0.4, 3.6]), 550 * MS, 550 * MS)
    np.testing.assert_allclose(plans.at(560 * MS)[0], [-0.4])
    u = trace(plans, 0, 1500)
    assert inside(u)
    assert u[-1] == pytest.approx(0.0, abs=1e-12)  # rounding of K (x - x_i)


def test_feedback_goes_on_where_the_robot_stands() -> None:
    """A gust moves it: the last row is held, and fed back."""
    plans = schedule(command(**GAIN))
    assert plans.feed_back(np.array([-0.2, 4.0]), 5000 * MS, 5000 * MS)
    np.testing.assert_allclose(plans.at(5000 * MS)[0], [0.1])
    np.testing.assert_allclose(plans.at(9000 * MS)[0], [0.1])
    assert plans.feed_back(None, 9000 * MS, 9000 * MS), "of a state that is too old nothing is left"
    assert plans.at(9000 * MS)[0] == 0.0


def test_plan_still_to_come_is_approached_from_what_feedback_makes_act() -> None:
    coming = command(u=0.25, stamp_ms=600)
    plans = schedule(command(**GAIN), coming)
    assert plans.at(600 * MS)[0] == pytest.approx(-0.15)
    plans.feed_back(np.array([2.0, 3.0]), 450 * MS, 450 * MS)
    u = trace(plans, 0, 1700)
    assert inside(u)
    assert u[449] == -0.25
    assert u[599] == -0.5
    assert u[600] == -0.25


def test_every_state_that_counts_is_remembered_as_long_as_slew_limits_ask_for_it() -> None:
    plans = schedule(command(**GAIN))
    rng = np.random.default_rng(1)
    u = []
    for t in range(250, 2000):
        plans.forget(t * MS)
        plans.feed_back(rng.normal(size=2), t * MS, t * MS)
        u.append(float(plans.at(t * MS)[0][0]))
    assert inside(np.array(u))
    assert len(plans) < 40


# What is refused.


@pytest.mark.parametrize(
    "change",
    [
        {"u_rest": np.zeros((6, 2))},
        {"u_rest": np.zeros(6)},
        {"u_rest": np.zeros((1001, 1))},
        {"rest_period_ns": 0},
        {"rest_period_ns": -1},
        {"x_rest": GAIN["x_rest"]},
        {"K": GAIN["K"]},
        GAIN | {"x_rest": np.zeros((5, 2))},
        GAIN | {"x_rest": np.zeros((6, 3))},
        GAIN | {"x_rest": np.zeros((6, 3)), "K": np.zeros((1, 3))},
        GAIN | {"K": np.zeros((2, 2))},
        GAIN | {"u_rest": np.zeros((0, 1))},
        {"u_rest": np.zeros((0, 1)), "K": np.zeros((1, 2))},
    ],
)
def test_way_to_rest_whose_parts_do_not_belong_together_is_unfit(change: dict[str, Any]) -> None:
    assert unfit(command(**change), 1, 1, 2) == "wrong_shape"


@pytest.mark.parametrize("name", ["u_rest", "x_rest", "K"])
def test_way_to_rest_that_is_not_finite_is_unfit(name: str) -> None:
    assert unfit(command(**GAIN), 1, 1, 2) == ""
    wrong = command(**GAIN)
    setattr(wrong, name, np.where(getattr(wrong, name) == getattr(wrong, name)[0, 0], np.nan, getattr(wrong, name)))
    assert unfit(wrong, 1, 1, 2) == "not_finite"


# As its sender believes it.


def test_robot_on_its_way_to_rest_is_believed_to_go_on() -> None:
    belief = Belief(np.zeros(1), SLEW, LIMITS, BOUNDS, PLAIN)
    one = command()
    belief.add(one, 0, end_ns(one), approached=False)
    assert not belief.correct(100 * MS, np.array([0.2]), (1, 1))
    assert not belief.correct(400 * MS, np.array([-0.25]), NO_COMMAND)
    assert not belief.correct(900 * MS, np.array([0.0]), NO_COMMAND)
    assert belief.correct(1000 * MS, np.array([0.1]), NO_COMMAND), "that is another input than believed"
    assert belief.at(1100 * MS)[0] == 0.0


def test_input_that_nobody_expected_is_believed_to_go_on_along_the_way() -> None:
    belief = Belief(np.zeros(1), SLEW, LIMITS, BOUNDS, PLAIN)
    one = command()
    belief.add(one, 0, end_ns(one), approached=False)
    belief.correct(300 * MS, np.array([0.0]), NO_COMMAND)
    assert belief.correct(400 * MS, np.array([-0.1]), NO_COMMAND)
    np.testing.assert_allclose(belief.at(460 * MS)[0], [-0.35])  # an increment further, not on the ramp to 0
    assert belief.at(600 * MS)[0] == -0.4
