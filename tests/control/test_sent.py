# SPDX-License-Identifier: Apache-2.0
"""Inputs already sent, as the controller computes them, compared with the simulated robot."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import Command
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.sent import Sent
from rti_mpc.rotation import Rotations
from rti_mpc.wire.actuator import Actuator

MS = 1_000_000
DT = 100 * MS
SLEW = np.array([0.2, 0.3])  # per dt


def command(seq: int, stamp_ms: int, rows: Array, valid_ms: int = 250) -> Command:
    stamp_ns = stamp_ms * MS
    return Command(1, seq, stamp_ns, 1, seq, stamp_ns, stamp_ns + valid_ms * MS, 0, Mode.TRACKING, QpStatus.SOLVED, DT, rows)


def sent(*commands: Command, slew: Array = SLEW) -> Sent:
    memory = Sent(np.zeros(2), -slew, slew, DT)
    for one in commands:
        memory.append(one)
    return memory


def plan(value: float, rows: int = 5) -> Array:
    return np.array([[value + 0.01 * i, -value - 0.01 * i] for i in range(rows)])


def test_nothing_sent_is_rest() -> None:
    u, change_ns = sent().at(7 * MS)
    np.testing.assert_array_equal(u, [0.0, 0.0])
    assert change_ns > 10**18


@pytest.mark.parametrize(("at_ms", "row", "change_ms"), [(0, 0, 100), (99, 0, 100), (100, 1, 200), (199, 1, 200), (249, 2, 250)])
def test_rows_act_one_after_the_other_until_the_command_expires(at_ms: int, row: int, change_ms: int) -> None:
    u, change_ns = sent(command(1, 0, plan(0.3))).at(at_ms * MS)
    np.testing.assert_array_equal(u, plan(0.3)[row])
    assert change_ns == change_ms * MS


def test_newest_command_whose_time_has_come_acts() -> None:
    memory = sent(command(1, 0, plan(0.1)), command(2, 100, plan(0.2)), command(3, 200, plan(0.3)))
    for at_ms, value, change_ms in ((50, 0.1, 100), (150, 0.2, 200), (200, 0.3, 300)):
        u, change_ns = memory.at(at_ms * MS)
        np.testing.assert_array_equal(u, plan(value)[0])
        assert change_ns == change_ms * MS


def test_time_before_all_that_is_remembered_was_rest() -> None:
    u, change_ns = sent(command(1, 100, plan(0.1))).at(99 * MS)
    np.testing.assert_array_equal(u, [0.0, 0.0])
    assert change_ns == 100 * MS


def test_expired_command_ramps_to_rest_inside_the_slew_limits() -> None:
    memory = sent(command(1, 0, np.tile([0.5, -0.7], (5, 1)), valid_ms=200))
    speeds = np.array([memory.at((200 + 50 * i) * MS)[0] for i in range(10)])
    np.testing.assert_allclose(speeds[0], [0.48, -0.67])  # in steps of 10 ms, the first at once
    np.testing.assert_allclose(speeds[2], [0.28, -0.37])
    np.testing.assert_allclose(speeds[-1], [0.0, 0.0], atol=1e-15)
    assert np.all(np.abs(np.diff(speeds, axis=0)) <= SLEW / 2 + 1e-12)


def test_robot_without_slew_limits_stops_at_once() -> None:
    memory = sent(command(1, 0, plan(0.5), valid_ms=200), slew=np.full(2, np.inf))
    np.testing.assert_array_equal(memory.at(200 * MS - 1)[0], plan(0.5)[1])
    np.testing.assert_array_equal(memory.at(200 * MS)[0], [0.0, 0.0])


def test_command_that_has_expired_before_its_time_is_none() -> None:
    """The robot refuses the last of several fallbacks, and brakes on from the one before."""
    memory = sent(
        command(1, 0, np.tile([0.5, -0.7], (5, 1)), valid_ms=150), command(2, 200, plan(0.1), valid_ms=-50), command(3, 300, plan(0.2), valid_ms=0)
    )
    np.testing.assert_allclose(memory.at(200 * MS)[0], [0.38, -0.52])
    np.testing.assert_allclose(memory.at(350 * MS)[0], [0.08, -0.07])


def test_cleared_memory_is_rest() -> None:
    memory = sent(command(1, 0, plan(0.5)))
    memory.brake(10 * MS, 10 * MS)
    memory.clear()
    np.testing.assert_array_equal(memory.at(0)[0], [0.0, 0.0])
    np.testing.assert_array_equal(memory.reach(50 * MS), [[-SLEW, -SLEW], [SLEW, SLEW]])


def test_first_plan_after_a_jump_ahead_is_near_to_what_acts_if_the_clock_is_only_faster_than_known() -> None:
    """Either the robot brakes from the command now, or its command was over long ago, and it has braked since."""
    jumped = command(1, 0, np.tile([0.5, -0.7], (5, 1)), valid_ms=200)
    memory = sent(jumped)
    braked = memory.at(350 * MS)[0].copy()
    memory.brake(100 * MS, 350 * MS)
    np.testing.assert_array_equal(memory.at(350 * MS - 1)[0], [0.5, -0.7])
    lowest, highest = memory.reach(350 * MS)
    assert (highest[0] - braked)[0] <= SLEW[0] + 1e-12
    assert (braked - lowest[0])[1] <= SLEW[1] + 1e-12
    assert (memory.at(350 * MS)[0] - lowest[0])[0] <= SLEW[0] + 1e-12


def test_reach_keeps_to_all_inputs_of_the_period_before_and_after() -> None:
    """Row 0 acts before, row 1 until the next command arrives, so the next input must be near both."""
    lowest, highest = sent(command(1, 0, np.array([[0.3, 0.0], [0.4, -0.2], [0.9, 0.9]]))).reach(DT)
    np.testing.assert_allclose(lowest, [[0.4 - 0.2, 0.0 - 0.3], [0.4 - 0.2, -0.2 - 0.3]])
    np.testing.assert_allclose(highest, [[0.3 + 0.2, -0.2 + 0.3], [0.4 + 0.2, -0.2 + 0.3]])


def test_reach_keeps_to_a_row_that_acts_while_the_next_command_is_on_its_way() -> None:
    """Sent a millisecond before the row begins, it may arrive ten after; what comes right after it must not be far from either."""
    ramp = command(2, 99, np.tile([0.2, 0.0], (3, 1)))
    memory = sent(command(1, 0, np.array([[0.2, 0.0], [0.3, 0.3], [0.3, 0.3]])))
    memory.append(ramp, 99 * MS)
    lowest, highest = memory.reach(DT)
    np.testing.assert_allclose(lowest[0], [0.3 - 0.2, 0.3 - 0.3])
    np.testing.assert_allclose(highest[0], [0.2 + 0.2, 0.0 + 0.3])


@pytest.mark.parametrize("t_ms", [0, 50, 100, 150, 249, 250, 260, 400, 900])
def test_reach_tells_the_input_that_acts_before_its_time(t_ms: int) -> None:
    memory = sent(command(1, 0, plan(0.3)), command(2, 100, plan(0.1), valid_ms=150))
    memory.reach(t_ms * MS)
    np.testing.assert_array_equal(memory.u_prev, memory.at(t_ms * MS - 1)[0])


def test_robot_that_brakes_on_its_own_is_taken_over_at_the_speed_it_has() -> None:
    """Whenever in the period the command arrives, the robot has not to take back more than its braking."""
    memory = sent(command(1, 0, np.tile([0.8, -1.2], (5, 1)), valid_ms=100))
    lowest, highest = memory.reach(2 * DT)
    step = SLEW / 10  # of the robot's braking
    assert np.all(np.abs([lowest[0], highest[0]] - memory.at(2 * DT)[0]) <= 1.01 * step)


def test_plans_that_no_later_command_can_meet_are_forgotten_and_no_reach_changes() -> None:
    rng = np.random.default_rng(1)
    memory, forgets_nothing = sent(), sent()
    forgets_nothing._slowest.forget = lambda t_ns: None  # type: ignore[method-assign]
    now_ms = 0
    for k in range(60):
        now_ms += int(rng.integers(20, 120))
        if rng.random() < 0.8:  # else none is sent, and the robot may come to brake
            one, left_ns = command(k, now_ms, rng.uniform(-0.5, 0.5, (5, 2))), (now_ms + int(rng.integers(0, 60))) * MS
            for each in (memory, forgets_nothing):
                each.append(one, left_ns)
        for later_ms in (10, 50, 100, 240):
            np.testing.assert_array_equal(memory.reach((now_ms + later_ms) * MS), forgets_nothing.reach((now_ms + later_ms) * MS))
    assert len(memory._slowest) < 8 < len(forgets_nothing._slowest)


def test_nothing_sent_lets_an_input_leave_rest_within_the_slew_limits() -> None:
    lowest, highest = sent().reach(0)
    np.testing.assert_array_equal([lowest, highest], [[-SLEW, -SLEW], [SLEW, SLEW]])


@pytest.mark.parametrize(("delay_ms", "value"), [(0, 0.2), (40, 0.2), (60, 0.11)])
def test_command_acts_not_before_it_can_have_arrived(delay_ms: int, value: float) -> None:
    memory = sent()
    memory.delay_ns = delay_ms * MS
    memory.append(command(1, 0, plan(0.1)))
    memory.append(command(2, 100, plan(0.2)))
    assert memory.at(150 * MS)[0][0] == pytest.approx(value)
    assert memory.at(160 * MS)[0][0] == pytest.approx(0.2)


def test_it_tells_what_the_actuator_really_plays() -> None:
    """Random plans, some late in coming, some skipped: the controller predicts over what acts."""
    rng = np.random.default_rng(3)
    actuator = Actuator(np.zeros(2), SLEW / 0.1, epoch=1)
    memory = sent()
    now_ns = 0
    for seq in range(1, 60):
        if rng.random() < 0.8:
            one = command(seq, now_ns // MS + int(rng.integers(0, 2)) * 30, rng.uniform(-0.5, 0.5, (5, 2)), valid_ms=int(rng.choice([-50, 150, 250])))
            memory.append(one)
            assert actuator.accept(one, now_ns) == ("" if one.valid_until_ns > one.stamp_ns else "expired")
        to_ns = now_ns + DT
        for until_ns, u in actuator.play(now_ns, to_ns):
            expected, change_ns = memory.at(now_ns)
            np.testing.assert_allclose(u, expected, atol=1e-12)  # slew limits per sample, or per second: rounding
            assert until_ns == pytest.approx(min(change_ns, to_ns), abs=1)
            now_ns = until_ns


# Ways to rest.

WAY = np.array([[0.1, 0.0], [-0.1, -0.2], [-0.2, -0.2], [0.0, 0.1]])


def resting(seq: int, stamp_ms: int, rows: Array, **change: Any) -> Command:
    return replace(command(seq, stamp_ms, rows), rest_period_ns=DT, u_rest=WAY, **change)


def test_robot_is_known_to_go_the_way_to_rest_of_its_last_command() -> None:
    memory, robot = sent(resting(1, 0, np.full((4, 2), 0.2))), Actuator(np.zeros(2), SLEW / 0.1, 1)
    robot.accept(resting(1, 0, np.full((4, 2), 0.2)), 0)
    t = 0
    for until_ns, u in robot.play(0, 1200 * MS):
        np.testing.assert_allclose(memory.at(t)[0], u)
        t = until_ns
    np.testing.assert_array_equal(memory.at(5000 * MS)[0], WAY[-1])
    spans = list(memory.spans(200 * MS, 400 * MS))
    assert [round(span, 12) for _, span in spans] == [0.05, 0.1, 0.05]


def test_state_that_is_fed_back_is_known_to_change_what_acts() -> None:
    fed_back = {"x_rest": np.zeros((4, 1)), "K": np.array([[0.5], [0.0]])}
    memory = Sent(np.zeros(2), -SLEW, SLEW, DT, (-np.ones(2), np.ones(2)), Rotations(1))
    memory.append(resting(1, 0, np.full((4, 2), 0.2), **fed_back))
    memory.feed_back(np.array([1.0]), 200 * MS)
    np.testing.assert_allclose(memory.at(300 * MS)[0], [0.1, 0.0])  # a plan acted
    memory.feed_back(np.array([0.1]), 400 * MS)
    np.testing.assert_allclose(memory.at(420 * MS)[0], [-0.1, -0.2])  # of -0.15: an increment from 0.1
    np.testing.assert_allclose(memory.at(460 * MS)[0], [-0.25, -0.2])
    np.testing.assert_allclose(memory.at(5000 * MS)[0], [-0.05, 0.1])


def test_plan_after_one_that_has_ended_a_way_to_rest_may_find_the_robot_further_on_it() -> None:
    """The one before may be late, or lost."""
    memory = sent(resting(1, 0, np.full((4, 2), 0.2)))
    lowest, highest = memory.reach(400 * MS)
    memory.append(command(2, 400, np.vstack([np.clip(0.3, lowest, highest), np.full((2, 2), 0.3)])))
    lowest, highest = memory.reach(480 * MS)
    further = WAY[3]  # from 550 ms on
    assert (lowest[1] >= further - SLEW - 1e-12).all()
    assert (highest[1] <= further + SLEW + 1e-12).all()
