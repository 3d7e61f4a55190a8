# SPDX-License-Identifier: Apache-2.0
"""The robot without clock and network."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.approach import Increments
from rti_mpc.contract.message import Command
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.errors import ConfigError
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.plant import Plant
from rti_mpc_sim.settings import RobotSettings
from tests.robots import pushed

MS = 1_000_000
X0 = np.array([0.5, 0.0, 3.0, 0.0, 0.0])
SETTINGS = RobotSettings(pioneer_3dx(), X0, slew=np.array([1.0, 2.0]))


def command(robot: Lockstep, seq: int, u: list[float], stamp_ns: int | None = None) -> Command:
    stamp_ns = robot.now_ns if stamp_ns is None else stamp_ns
    rows = np.zeros((7, 2)) + u  # np.tile of numpy 2.4 loses 56 bytes a call
    return Command(1, seq, stamp_ns, robot.epoch, seq, stamp_ns, stamp_ns + 250 * MS, 0, Mode.TRACKING, QpStatus.SOLVED, 100 * MS, rows)


def test_states_come_on_the_grid_of_the_period() -> None:
    robot = Lockstep(SETTINGS)
    states = [robot.tick() for _ in range(4)]
    assert [(state.epoch, state.seq, state.stamp_ns // MS) for state in states] == [(1, 1, 0), (1, 2, 100), (1, 3, 200), (1, 4, 300)]
    np.testing.assert_array_equal(states[-1].x, X0)


def test_plant_is_integrated_exactly_over_the_intervals_in_which_each_input_acted() -> None:
    """Also where a plan arrives between two states."""
    robot = Lockstep(SETTINGS)
    robot.tick()
    robot.accept(command(robot, 1, [0.3, 0.2]))
    robot.accept(command(robot, 2, [0.5, -0.6]), arrival_ns=37 * MS)
    plant = Plant(SETTINGS.model, X0, 0.1, 20)
    plant.advance(np.array([0.3, 0.2]), 0.037)
    plant.advance(np.array([0.5, -0.6]), 0.063)
    np.testing.assert_allclose(robot.tick().x, plant.x, atol=1e-12)


def test_robot_left_alone_comes_to_rest_and_stands() -> None:
    robot = Lockstep(SETTINGS)
    robot.tick()
    robot.accept(command(robot, 1, [0.5, 0.7]))
    robot.tick()
    assert robot.u.tolist() == [0.5, 0.7]
    for _ in range(60):
        robot.tick()
    assert robot.u.tolist() == [0.0, 0.0]
    assert np.abs(robot.x[3:]).max() < 1e-6
    assert robot.counters.starved == 1


def test_state_of_a_turning_robot_wraps_and_its_truth_does_not() -> None:
    robot = Lockstep(SETTINGS)
    for seq in range(1, 40):
        state = robot.tick()
        robot.accept(command(robot, seq, [0.0, 0.7]))
    assert robot.x[2] > 4.0
    assert state.x[2] == pytest.approx(robot.x[2] - 2 * np.pi)


def test_delayed_states_arrive_late_with_their_old_stamp() -> None:
    robot = Lockstep(replace(SETTINGS, sensor_delay_s=0.13))
    times = [(robot.tick().stamp_ns // MS, robot.now_ns // MS) for _ in range(3)]
    assert times == [(0, 130), (100, 230), (200, 330)]


def test_same_seed_gives_the_same_run() -> None:
    settings = replace(SETTINGS, noise_std=np.full(5, 0.01), dropout=0.3, actuator_lag_s=0.05, actuator_delay_s=0.02)

    def run(seed: int = 1) -> list[float]:
        robot = Lockstep(replace(settings, seed=seed))
        trace = []
        for seq in range(1, 30):
            trace += robot.tick().x.tolist()
            robot.accept(command(robot, seq, [0.4, 0.1]))
        return trace

    assert run() == run()
    assert run() != run(seed=2)


def test_robot_does_not_grow_the_heap() -> None:
    robot = Lockstep(SETTINGS)

    def live(first: int, last: int) -> int:
        for seq in range(first, last):
            robot.tick()
            robot.accept(command(robot, seq, [0.4, 0.1], stamp_ns=robot.now_ns + 30 * MS))
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    before = live(1, 100)
    after = live(100, 400)
    tracemalloc.stop()
    assert after - before < 4096


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"x0": np.zeros(4)}, "x0 must be 5 numbers"),
        ({"x0": np.full(5, np.inf)}, "x0 must be finite"),
        ({"slew": np.array([1.0, 0.0])}, "slew must be above 0"),
        ({"noise_std": np.full(5, -1.0)}, "noise_std must be finite and at least 0"),
        ({"dropout": 1.0}, "dropout must be from 0 to below 1"),
        ({"state_period_s": 0.0}, "state_period_s must be from"),
        ({"substeps": 0}, "substeps must be from 1"),
        ({"actuator_lag_s": float("nan")}, "actuator_lag_s must be from 0"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(change, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        replace(SETTINGS, **change)


# Ways to rest.


def stopped(robot: Lockstep) -> float:
    """Speed after five seconds on a way to rest from 0.5 m/s."""
    rows = np.array([-0.5, -1.0, -1.0, -1.0, -1.0, -0.5, 0.0])[:, None]
    speeds = 0.5 + 0.1 * np.concatenate([[0.0], np.cumsum(rows[:-1, 0])])
    plan = Command(1, 1, 0, 1, 1, 0, 250 * MS, 0, Mode.TRACKING, QpStatus.SOLVED, 100 * MS, np.zeros((3, 1)))
    way = {"rest_period_ns": 100 * MS, "u_rest": rows, "x_rest": np.column_stack([np.zeros(7), speeds]), "K": np.array([[0.0, 2.0]])}
    assert robot.accept(replace(plan, **way)) == ""  # type: ignore[arg-type]
    while robot.now_ns < 5000 * MS:
        robot.tick()
    assert robot.actuator.at_rest or robot.u[0] != 0.0
    return abs(float(robot.x[1]))


@pytest.mark.parametrize("dropout", [0.0, 0.9])
@pytest.mark.parametrize("change", [{}, {"actuator_delay_s": 0.02}, {"actuator_lag_s": 0.05}, {"noise_std": np.array([0.0, 1e-4])}])
def test_robot_feeds_its_own_measurements_back_on_its_way_to_rest_lost_or_not(change: dict[str, Any], dropout: float) -> None:
    x0, step = np.array([0.0, 0.5]), np.array([0.5])
    increments = Increments(-step, step, 100 * MS)
    settings = RobotSettings(pushed(), x0, lbu=-2 * step, ubu=2 * step, slew=10 * step, increments=increments, dropout=dropout, **change)
    assert stopped(Lockstep(settings)) < 1e-3
