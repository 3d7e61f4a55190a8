# SPDX-License-Identifier: Apache-2.0
"""Actuator: the robot's side of the command contract, rule by rule."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.approach import Increments
from rti_mpc.contract.message import Command
from rti_mpc.contract.schedule import RAMP_STEP_NS
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.rotation import Rotations
from rti_mpc.wire.actuator import Actuator

MS = 1_000_000
SLEW = np.array([1.0, 2.0])


def actuator(delay_ns: int = 0, slew: Array = SLEW) -> Actuator:
    return Actuator(np.zeros(2), slew, epoch=7, delay_ns=delay_ns)


def command(seq: int = 1, stamp_ms: int = 0, first: float = 0.1, epoch: int = 100, valid_ms: int = 250) -> Command:
    """Four rows of 100 ms: first, first + 0.01, ... for either input."""
    u = first + 0.01 * np.arange(4.0)[:, None] + np.zeros((4, 2))
    return Command(
        epoch=epoch,
        seq=seq,
        stamp_ns=stamp_ms * MS,
        state_epoch=7,
        state_seq=1,
        state_stamp_ns=0,
        valid_until_ns=(stamp_ms + valid_ms) * MS,
        config_hash=0,
        mode=Mode.TRACKING,
        status=QpStatus.SOLVED,
        period_ns=100 * MS,
        u=u,
    )


def played(robot: Actuator, from_ms: float, to_ms: float) -> list[tuple[float, float]]:
    """Times and values of the changes of the first input, from an instant on."""
    changes: list[tuple[float, float]] = []
    start_ns = round(from_ms * MS)
    for until_ns, u in robot.play(start_ns, round(to_ms * MS)):
        if not changes or changes[-1][1] != round(u[0], 12):
            changes.append((start_ns / MS, round(float(u[0]), 12)))
        start_ns = until_ns
    assert start_ns == round(to_ms * MS)
    return changes


def test_robot_stands_still_without_commands() -> None:
    robot = actuator()
    assert played(robot, 0, 5000) == [(0, 0.0)]
    assert robot.counters.starved == 0


def test_rows_act_on_their_grid() -> None:
    robot = actuator()
    assert robot.accept(command(stamp_ms=30), 0) == ""
    assert played(robot, 0, 260) == [(0, 0.0), (30, 0.1), (130, 0.11), (230, 0.12)]


def test_where_an_interval_is_cut_changes_nothing() -> None:
    whole, cut = actuator(), actuator()
    for robot in (whole, cut):
        robot.accept(command(stamp_ms=30), 0)
    changes = [change for i in range(0, 600, 7) for change in played(cut, i, i + 7)]
    merged = [change for i, change in enumerate(changes) if i == 0 or changes[i - 1][1] != change[1]]
    assert merged == played(whole, 0, 602)


def test_late_command_acts_from_its_arrival_with_the_row_due_then() -> None:
    robot = actuator()
    robot.accept(command(seq=1, stamp_ms=0), 0)
    robot.accept(command(seq=2, stamp_ms=50, first=0.2), 170 * MS)
    assert played(robot, 0, 200) == [(0, 0.1), (100, 0.11), (170, 0.21)]
    assert robot.counters.late == 1


def test_command_that_arrives_within_its_first_row_is_not_late() -> None:
    robot = actuator()
    robot.accept(command(stamp_ms=0), 99 * MS)
    assert robot.counters.late == 0
    assert played(robot, 0, 150) == [(0, 0.0), (99, 0.1), (100, 0.11)]


def test_early_command_waits_while_the_previous_plan_plays_on() -> None:
    robot = actuator()
    robot.accept(command(seq=1, stamp_ms=0), 0)
    robot.accept(command(seq=2, stamp_ms=150, first=0.3), 40 * MS)
    assert played(robot, 0, 200) == [(0, 0.1), (100, 0.11), (150, 0.3)]


def test_newest_command_replaces_one_that_still_waits() -> None:
    robot = actuator()
    robot.accept(command(seq=1, stamp_ms=200, first=0.3), 0)
    robot.accept(command(seq=2, stamp_ms=100, first=0.5), 0)
    assert played(robot, 0, 300) == [(0, 0.0), (100, 0.5), (200, 0.51)]


def test_flood_of_early_commands_is_bounded() -> None:
    robot = actuator()
    for seq in range(1000):
        robot.accept(command(seq=seq, stamp_ms=1000 * seq), 0)
    assert len(robot._schedule) <= 64


def test_nothing_acts_once_a_plan_expires_and_the_ramp_ends_exactly_at_rest() -> None:
    robot = actuator()
    robot.accept(command(valid_ms=250), 0)
    changes = played(robot, 0, 1000)
    assert [t for t, _ in changes[:4]] == [0, 100, 200, 250]
    assert changes[-1] == (360, 0.0)  # 0.12 at 1 per s, begun at once
    assert robot.at_rest
    assert not robot.u.any()
    assert robot.counters.starved == 1


def test_nothing_acts_past_the_last_row_however_long_the_plan_is_valid() -> None:
    robot = actuator()
    robot.accept(command(valid_ms=10_000), 0)
    played(robot, 0, 1000)
    assert robot.at_rest


def test_braking_stays_inside_the_slew_limits_over_every_window() -> None:
    robot = actuator()
    robot.accept(replace(command(valid_ms=100), u=np.array([[0.5, -0.7]])), 0)
    u = np.array([(u.copy()) for t in range(0, 1000, 10) for _, u in robot.play(t * MS, (t + 10) * MS)])
    for window in (1, 5, 10):
        assert (np.abs(u[window + 5 :] - u[5:-window]) <= SLEW * window * 0.01 + 1e-12).all()
    assert not u[-1].any()


def test_inputs_without_slew_limits_rest_at_once() -> None:
    robot = actuator(slew=np.full(2, np.inf))
    robot.accept(command(), 0)
    assert played(robot, 0, 300)[-1] == (250, 0.0)


def test_new_command_ends_the_ramp() -> None:
    robot = actuator()
    robot.accept(command(seq=1), 0)
    played(robot, 0, 300)
    robot.accept(command(seq=2, stamp_ms=300, first=0.4), 300)
    assert played(robot, 300, 350) == [(300, 0.4)]


def test_rest_need_not_be_zero() -> None:
    robot = Actuator(np.array([0.3]), np.array([0.7]), epoch=7)
    robot.accept(replace(command(), u=np.ones((4, 1))), 0)
    played(robot, 0, 3000)
    assert robot.u[0] == 0.3


@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("foreign_epoch", {"state_epoch": 6}),
        ("foreign_epoch", {"state_epoch": 8}),
        ("not_finite", {"u": np.array([[0.1, np.nan]])}),
        ("not_finite", {"u": np.array([[np.inf, 0.1]])}),
        ("wrong_shape", {"u": np.zeros((4, 3))}),
        ("wrong_shape", {"u": np.zeros((0, 2))}),
        ("wrong_shape", {"u": np.zeros(2)}),
        ("wrong_shape", {"period_ns": 0}),
        ("repeated", {"seq": 1}),
        ("old", {"seq": 0}),
        ("foreign", {"epoch": 99}),
        ("early", {"state_stamp_ns": 260 * MS + 1}),
    ],
)
def test_refused_commands_are_counted_and_the_plan_plays_on(reason: str, change) -> None:
    robot = actuator()
    robot.accept(command(seq=1), 0)
    assert robot.accept(replace(command(seq=2, first=0.5), **change), 10 * MS) == reason
    assert robot.counters.refused == 1
    assert played(robot, 0, 100) == [(0, 0.1)]


def test_expired_command_is_dropped_and_counted() -> None:
    robot = actuator()
    assert robot.accept(command(), 250 * MS) == "expired"
    assert (robot.counters.expired, robot.counters.refused) == (1, 0)
    assert played(robot, 250, 500) == [(250, 0.0)]


def test_expired_command_of_another_epoch_locks_nobody_out() -> None:
    robot = actuator()
    robot.accept(command(seq=1, epoch=100), 0)
    assert robot.accept(command(seq=1, epoch=101), 250 * MS) == "expired"
    assert robot.accept(command(seq=2, epoch=100, stamp_ms=240, first=0.2), 250 * MS) == ""
    assert robot.counters.lost == 0


def test_higher_epoch_takes_over_at_once_and_a_lower_one_after_silence() -> None:
    robot = actuator()
    robot.accept(command(seq=5, epoch=100), 0)
    assert robot.accept(command(seq=1, epoch=101, first=0.2), 10 * MS) == ""
    assert robot.accept(command(seq=6, epoch=100, stamp_ms=10, first=0.3), 20 * MS) == "foreign"
    assert robot.accept(command(seq=7, epoch=100, stamp_ms=300, first=0.3), 300 * MS) == ""


def test_gaps_in_the_sequence_are_counted_as_lost() -> None:
    robot = actuator()
    for seq in (1, 2, 5, 6):
        robot.accept(command(seq=seq), 0)
    assert robot.counters.lost == 2


def test_delay_of_the_actuators_makes_commands_arrive_later() -> None:
    """One sent early enough still acts on its stamp: that is how a controller compensates."""
    robot = actuator(delay_ns=40 * MS)
    robot.accept(command(seq=1, stamp_ms=0), 0)
    robot.accept(command(seq=2, stamp_ms=100, first=0.2), 60 * MS)
    assert played(robot, 0, 150) == [(0, 0.0), (40, 0.1), (100, 0.2)]


def test_plans_are_copied_on_acceptance() -> None:
    robot = actuator()
    message = command()
    robot.accept(message, 0)
    message.u[:] = 9.0
    assert played(robot, 0, 50) == [(0, 0.1)]


def test_switched_off_robot_ramps_to_rest_and_takes_no_command() -> None:
    robot = actuator()
    robot.accept(command(seq=1), 0)
    played(robot, 0, 50)
    robot.switch_off()
    assert robot.accept(command(seq=2, stamp_ms=50), 50 * MS) == "switched_off"
    assert played(robot, 50, 300)[-1] == (140, 0.0)
    assert robot.counters.starved == 0


def test_switched_off_robot_waits_with_its_ramp_for_a_row_that_has_just_braked() -> None:
    """The row's own step counts against the slew limits, too."""
    robot = Actuator(np.zeros(2), SLEW, 7, increments=Increments(-0.1 * SLEW, 0.1 * SLEW, 100 * MS))
    robot.accept(replace(command(), u=np.array([[0.1, 0.2], [0.2, 0.4], [0.1, 0.2], [0.1, 0.2]])), 0)
    played(robot, 0, 210)
    robot.switch_off()
    acted = dict(played(robot, 210, 600))
    assert acted[210] == 0.1
    assert min(t for t, u in acted.items() if u < 0.1) >= 275, "one increment within three quarters of a period"
    assert robot.at_rest


# Ways to rest.

WAY = {"rest_period_ns": 100 * MS, "u_rest": np.array([[0.05, 0.0], [-0.1, 0.0], [0.02, 0.0]])}


def test_way_to_rest_acts_when_the_plan_is_over_and_its_last_row_is_rest() -> None:
    robot = actuator()
    assert robot.accept(replace(command(), **WAY), 0) == ""
    assert played(robot, 0, 440) == [(0, 0.1), (100, 0.11), (200, 0.12), (250, 0.05), (350, -0.1)]
    assert (robot.source, robot.braking, robot.at_rest, robot.counters.starved) == ((0, 0), True, False, 1)
    assert played(robot, 440, 9000) == [(440, -0.1), (450, 0.02)]
    assert robot.at_rest


def test_robot_that_stands_when_its_plan_is_over_has_not_starved() -> None:
    robot = actuator()
    u = np.full((4, 2), 0.02)
    robot.accept(replace(command(), u=u, rest_period_ns=100 * MS, u_rest=u[:2]), 0)
    played(robot, 0, 400)
    assert robot.at_rest
    assert robot.counters.starved == 0


def test_switched_off_robot_goes_the_way_to_rest_of_the_plan_that_acted() -> None:
    robot = actuator()
    robot.accept(replace(command(), **WAY), 0)
    played(robot, 0, 50)
    robot.switch_off()
    assert played(robot, 50, 1000) == [(50, 0.05), (150, -0.1), (250, 0.02)]


def test_way_to_rest_that_was_interrupted_is_forgotten() -> None:
    robot = actuator()
    robot.accept(replace(command(), **WAY), 0)
    played(robot, 0, 300)
    robot.accept(command(seq=2, stamp_ms=300, first=0.2), 300 * MS)
    assert played(robot, 300, 2000)[-1][1] == 0.0, "the ramp, to where the model rests"


def test_measurements_correct_a_way_to_rest_after_the_delay_inside_the_bounds() -> None:
    robot = Actuator(np.zeros(2), SLEW, 7, 20 * MS, (np.array([-0.3, -0.3]), np.array([0.3, 0.3])), rotations=Rotations(2, (1,)))
    fed_back = WAY | {"x_rest": np.zeros((3, 2)), "K": np.array([[1.0, 0.0], [0.0, 0.2]])}
    assert robot.accept(replace(command(), **fed_back), 0) == ""
    robot.measure(np.array([9.0, 9.0]), 100 * MS)  # a plan acts
    assert played(robot, 0, 270)[-1] == (250, 0.05)
    robot.measure(np.array([-0.1, 0.5 + 4 * np.pi]), 270 * MS)
    assert played(robot, 270, 350) == [(270, 0.05), (290, 0.15)]
    assert robot.u[1] == pytest.approx(-0.1)
    robot.measure(np.array([-5.0, 0.0]), 350 * MS)
    assert played(robot, 350, 450) == [(350, 0.0), (370, 0.3)]


@pytest.mark.parametrize("change", [{"K": np.zeros((2, 3)), "x_rest": np.zeros((3, 3))}, {"u_rest": np.zeros((3, 1))}, {"rest_period_ns": 0}])
def test_way_to_rest_of_another_robot_is_refused(change: dict[str, Any]) -> None:
    robot = Actuator(np.zeros(2), SLEW, 7, rotations=Rotations(2, (1,)))
    assert robot.accept(replace(command(), **(WAY | change)), 0) == "wrong_shape"
    assert played(robot, 0, 500) == [(0, 0.0)]


def test_brake_steps_are_short_against_any_sample() -> None:
    assert RAMP_STEP_NS <= 10 * MS
