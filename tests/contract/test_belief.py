# SPDX-License-Identifier: Apache-2.0
"""Belief of a sender about the inputs that act, compared with the reports of the robot."""

from __future__ import annotations

import timeit

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.approach import Increments
from rti_mpc.contract.belief import Belief
from rti_mpc.contract.message import Command
from rti_mpc.contract.schedule import NO_COMMAND, end_ns
from rti_mpc.contract.status import Mode, QpStatus
from tests.slow import slow_but

MS = 1_000_000
STEP = np.array([0.25, 0.4])
FULL = np.array([0.25, 0.4])
OURS = 7  # epoch


def command(seq: int, stamp_ms: int, u: Array) -> Command:
    stamp_ns = stamp_ms * MS
    return Command(OURS, seq, stamp_ns, 1, 1, stamp_ns, stamp_ns + 250 * MS, 0, Mode.TRACKING, QpStatus.SOLVED, 100 * MS, u)


@pytest.fixture
def belief() -> Belief:
    """Commands 1 to 6, each 100 ms after the one before; that of number k is k percent below full."""
    made = Belief(np.zeros(2), STEP / 0.1, Increments(-STEP, STEP, 100 * MS))
    for seq in range(1, 7):
        add(made, command(seq, 100 * seq, plan(seq)))
    return made


def plan(seq: int) -> Array:
    """A plan of five different rows; each input tells the command's number and the row."""
    return np.array([(1.0 - 0.01 * seq - 0.001 * row) * FULL for row in range(5)])


def add(belief: Belief, one: Command) -> None:
    belief.add(one, one.stamp_ns, end_ns(one))


def test_report_of_what_was_believed_changes_nothing(belief: Belief) -> None:
    for t_ms, seq in ((200, 1), (350, 3), (400, 3), (400, 4), (650, 6)):
        assert not belief.correct(t_ms * MS, plan(seq)[0], (OURS, seq)), (t_ms, seq)
    assert belief.confirmed == 5


def test_commands_that_have_not_acted_are_taken_out(belief: Belief) -> None:
    assert belief.correct(505 * MS, plan(3)[2], (OURS, 3))
    np.testing.assert_array_equal(belief.at(450 * MS)[0], plan(3)[1])
    np.testing.assert_array_equal(belief.at(504 * MS)[0], plan(3)[2])
    np.testing.assert_array_equal(belief.at(506 * MS)[0], plan(5)[0], err_msg="what was sent less than a period ago may still come")


def test_robots_own_ramp_takes_out_all_that_should_have_acted(belief: Belief) -> None:
    robot = Belief(np.zeros(2), STEP / 0.1, Increments(-STEP, STEP, 100 * MS))
    for seq in (1, 2):
        add(robot, command(seq, 100 * seq, plan(seq)))
    assert belief.correct(500 * MS, robot.at(500 * MS - 1)[0], NO_COMMAND)
    for t_ms in range(420, 500):
        np.testing.assert_allclose(belief.at(t_ms * MS)[0], robot.at(t_ms * MS)[0], atol=1e-12)


def test_ramp_of_another_shape_is_taken_as_it_is(belief: Belief) -> None:
    u = np.array([0.01, 0.3])
    assert belief.correct(900 * MS, u, NO_COMMAND)
    np.testing.assert_array_equal(belief.at(900 * MS - 1)[0], u)
    now, _, braking = belief.at(910 * MS)
    assert braking
    assert (now < u).all()
    assert not belief.at(1100 * MS)[0].any()


def test_command_on_its_way_is_not_missing(belief: Belief) -> None:
    belief.correct(405 * MS, plan(4)[0], (OURS, 4))
    belief.correct(505 * MS, plan(4)[1], (OURS, 4))
    np.testing.assert_array_equal(belief.at(504 * MS)[0], plan(4)[1])
    np.testing.assert_array_equal(belief.at(506 * MS)[0], plan(5)[0])
    assert belief.confirmed == 1


def test_command_that_comes_late_is_put_back(belief: Belief) -> None:
    belief.correct(505 * MS, plan(3)[2], (OURS, 3))
    assert belief.correct(520 * MS, plan(4)[1], (OURS, 4))
    np.testing.assert_array_equal(belief.at(519 * MS)[0], plan(4)[1])
    np.testing.assert_array_equal(belief.at(521 * MS)[0], plan(5)[0])


@pytest.mark.parametrize("row_of", [(3, 1), (2, 2), (4, 0)])
def test_input_itself_tells_what_acts_where_a_guard_has_numbers_of_its_own(belief: Belief, row_of: tuple[int, int]) -> None:
    seq, row = row_of
    assert belief.correct(449 * MS, plan(seq)[row], (10**6, 1)) == (seq != 4)
    np.testing.assert_array_equal(belief.at(449 * MS - 1)[0], plan(seq)[row])


def test_input_that_no_plan_explains_is_taken_as_it_is_and_the_newest_plan_goes_on_from_it(belief: Belief) -> None:
    u = np.array([-0.2, 0.1])
    assert belief.correct(449 * MS, u, (10**6, 1))
    np.testing.assert_array_equal(belief.at(449 * MS - 1)[0], u)
    np.testing.assert_allclose(belief.at(449 * MS)[0], np.minimum(plan(4)[0], u + STEP))


def test_robot_that_moves_before_anything_was_sent_is_where_it_says() -> None:
    fresh = Belief(np.zeros(2), STEP / 0.1, Increments(-STEP, STEP, 100 * MS))
    assert fresh.correct(10**12, FULL, (99, 5))
    np.testing.assert_array_equal(fresh.at(10**12 - 1)[0], FULL)


@pytest.mark.parametrize(("seed", "reports"), slow_but([(0, 400), (0, 1500), (1, 1500), (2, 1500)], (0, 400)))
def test_whatever_is_reported_nothing_is_raised_and_what_is_reported_is_believed(seed: int, reports: int) -> None:
    rng = np.random.default_rng(seed)
    made = Belief(np.zeros(2), STEP / 0.1, Increments(-STEP, STEP, 100 * MS))
    t_ms, seq = 0, 0
    for _ in range(reports):
        t_ms += int(rng.choice([1, 7, 100, 100, 400]))
        if rng.random() < 0.7:
            seq += 1
            one = command(seq, t_ms + int(rng.integers(-250, 200)), rng.uniform(-1, 1, (5, 2)))
            start_ns = max(one.stamp_ns, t_ms * MS + int(rng.integers(0, 90)) * MS)
            if start_ns < end_ns(one):
                made.add(one, start_ns, end_ns(one))
        if rng.random() < 0.02:
            made.cut(t_ms * MS, t_ms * MS)
        u = rng.uniform(-1, 1, 2) if rng.random() < 0.5 else made.at(t_ms * MS)[0].copy()
        source = [NO_COMMAND, (OURS, max(1, seq - int(rng.integers(0, 12)))), (99, 1)][int(rng.integers(0, 3))]
        made.correct(t_ms * MS, u, source)
        assert made._plays(u, t_ms * MS)
        assert 0 < len(made) <= 64


def test_report_of_what_was_believed_costs_microseconds(belief: Belief) -> None:
    """It is on the path from state to command."""
    u = plan(6)[0]
    belief.correct(650 * MS, u, (OURS, 6))
    best_s = min(timeit.repeat(lambda: belief.correct(651 * MS, u, (OURS, 6)), number=200, repeat=20)) / 200
    assert best_s < 100e-6, "about 10 us on an idle core"
