# SPDX-License-Identifier: Apache-2.0
"""The shipped configuration in lockstep, against what the README promises."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import Command
from rti_mpc.contract.status import Mode
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.reference.trajectory import Heading, Trajectory, circle, eight, positioning
from rti_mpc.rti.ocp import Ocp
from rti_mpc_service.config.build import build_rti
from rti_mpc_service.config.config import load
from rti_mpc_service.rig.scenario import configured
from rti_mpc_service.scenario import find_scenario
from tests.loop import Run, drive, reference, robot
from tests.slow import slow_but

CONFIG = load(Path(__file__).parents[2] / "deploy" / "pioneer_3dx.toml")
SCENARIOS: dict[str, tuple[Trajectory, Heading, float]] = {
    "eight": (eight(), "consistent", 125.6),
    "circle": (circle(), "none", 125.6),
    "positioning": (positioning(), "none", 60.0),
}


def controller_for(trajectory: Trajectory, heading: Heading) -> tuple[Controller, Ocp]:
    """The controller that `rti-mpc demo` runs."""
    config = configured(CONFIG, find_scenario(CONFIG, trajectory.name, heading))
    rti = build_rti(config)
    return Controller(rti, Timing(config.timing.delay_s, config.stale_s, config.timing.valid_s)), rti.ocp


@cache
def drive_shipped(name: str, **changes: Any) -> tuple[Run, Trajectory, Ocp]:
    """Drive a scenario, once for all that is said of it."""
    trajectory, heading, duration_s = SCENARIOS[name]
    controller, ocp = controller_for(trajectory, heading)
    body = robot(trajectory, **changes)
    controller.receive_reference(reference(trajectory.lasting(140.0), heading))  # it goes on, or the robot would slow down for its end
    run = drive(controller, body, duration_s)
    assert controller.ladder.fallbacks == controller.grid.skipped == 0
    assert not run.refused
    return run, trajectory, ocp


@pytest.mark.parametrize("changes", slow_but([{}, {"state_period_s": 0.02}], {}), ids=str)
def test_eight_is_followed_within_a_millimetre(changes: dict[str, float]) -> None:
    run, trajectory, _ = drive_shipped("eight", **changes)
    assert run.error_mm(trajectory)[np.array(run.t_s) > 20.0].max() <= 1.0


def test_circle_is_followed_within_a_millimetre_over_its_last_lap() -> None:
    run, trajectory, _ = drive_shipped("circle")
    assert run.error_mm(trajectory)[np.array(run.t_s) > 20.0 * np.pi].max() <= 1.0


def test_positioning_ends_at_its_goal_and_at_rest() -> None:
    run, trajectory, _ = drive_shipped("positioning")
    assert run.error_mm(trajectory)[-1] <= 0.1
    assert 1e3 * abs(run.x[-1][3]) <= 1e-3
    assert run.commands[-1].mode is Mode.TRACKING


@pytest.mark.parametrize("name", SCENARIOS)
def test_inputs_are_exactly_inside_their_bounds_and_states_nearly(name: str) -> None:
    run, _, ocp = drive_shipped(name)
    plans = np.array([command.u for command in run.commands])
    assert np.all(plans >= ocp.lbu)
    assert np.all(plans <= ocp.ubu)
    assert slew_excess(run.commands, ocp) <= 1e-12
    speeds = np.abs(np.array(run.x)[:, 3:])
    assert np.all(speeds <= 1.01 * ocp.ubx[3:])


def slew_excess(commands: list[Command], ocp: Ocp) -> float:
    """Return the largest change of an input beyond its slew limit, from row to row and from command to command."""
    acting = np.array([command.u[0] for command in commands])
    steps = np.concatenate([np.diff(acting, axis=0), *(np.diff(command.u, axis=0) for command in commands)])
    return float(np.maximum(steps - ocp.ubdu, ocp.lbdu - steps).max())


@pytest.mark.parametrize(
    ("disturbance", "limit_mm"),
    [
        ({"noise_std": np.array([1e-3, 1e-3, 2e-3, 5e-3, 5e-3])}, 4.0),
        pytest.param({"dropout": 0.2}, 10.0, marks=pytest.mark.slow),
        ({"sensor_delay_s": 0.02, "actuator_delay_s": 0.02}, 1.0),
        pytest.param({"actuator_lag_s": 0.05}, 2.0, marks=pytest.mark.slow),
    ],
    ids=["noise", "dropout", "delay", "lag"],
)
def test_robot_that_is_not_the_model_is_followed_all_the_same(disturbance: dict[str, Any], limit_mm: float) -> None:
    trajectory, heading, _ = SCENARIOS["eight"]
    controller, ocp = controller_for(trajectory, heading)
    body = robot(trajectory, state_period_s=0.05, **disturbance)
    controller.receive_reference(reference(trajectory.lasting(140.0), heading))  # it goes on, or the robot would slow down for its end
    run = drive(controller, body, 60.0)
    assert run.error_mm(trajectory)[np.array(run.t_s) > 20.0].max() < limit_mm
    assert controller.ladder.fallbacks == 0
    assert all(np.all((c.u >= ocp.lbu) & (c.u <= ocp.ubu)) for c in run.commands)
