# SPDX-License-Identifier: Apache-2.0
"""Robots with unusual names and orders of signals, in lockstep: their references are built by role."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Reference
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.reference.trajectory import eight
from rti_mpc.signals import plane
from rti_mpc_service.config.build import build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.rig.scenario import configured
from rti_mpc_service.scenario import find_scenario
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import drive
from tests.robots import toml
from tests.slow import slow_but

pytestmark = pytest.mark.usefixtures("interpreted")


@pytest.mark.parametrize(
    ("name", "limit_mm"),
    [("shuffled", 1.0), pytest.param("glider", 1.0, marks=pytest.mark.slow), pytest.param("rover", 10.0, marks=pytest.mark.slow)],
)
def test_the_eight_is_followed_whatever_the_order_and_the_names(name: str, limit_mm: float, tmp_path: Path) -> None:
    """The rover's heading is the tangent, without an offset; it cuts where the eight bends."""
    path = tmp_path / "robot.toml"
    path.write_text(toml(name))
    config = load(path)
    scenario = find_scenario(config, duration_s=60.0)
    config = configured(config, scenario)
    rti = build_rti(config)
    model = rti.ocp.model
    controller = Controller(rti, Timing())
    body = Lockstep(RobotSettings(**robot_settings(config)))
    y = scenario.y(body.x)
    controller.receive_reference(Reference(1, 1, 0, round(1e9 * scenario.period_s), scenario.end, y, np.zeros((len(y), 0))))
    position = plane(model.states)
    assert position is not None
    assert body.x[list(position)] == pytest.approx([0.5, 0.0]), "it starts where the scenario says"
    run = drive(controller, body, 55.0)
    settled = np.array(run.t_s) > 20.0
    wanted = eight().position(np.array(run.t_s))
    error_mm = 1e3 * np.hypot(*(np.array(run.x)[:, position] - wanted).T)
    assert error_mm[settled].max() <= limit_mm


@pytest.mark.parametrize("scenario", slow_but(["sines", "steps"], "steps"))
def test_outputs_of_a_robot_that_follows_no_path_are_followed(scenario: str, tmp_path: Path) -> None:
    """An arm, its joints turned at will inside the bounds of their angles."""
    path = tmp_path / "robot.toml"
    path.write_text(toml("arm").replace("bounds = {", "bounds = { states = { elbow = [-0.1, 3.0] },"))
    config = load(path)
    followed = find_scenario(config, scenario)
    rti = build_rti(config)
    controller, body = Controller(rti, Timing()), Lockstep(RobotSettings(**robot_settings(config)))
    y = followed.y(body.x)
    controller.receive_reference(Reference(1, 1, 0, round(1e9 * followed.period_s), followed.end, y, np.zeros((len(y), 0))))
    run = drive(controller, body, 30.0)
    x, t = np.array(run.x), np.array(run.t_s)
    wanted = np.column_stack([np.interp(t, followed.period_s * np.arange(len(y)), column) for column in y.T])
    around = [np.column_stack([np.interp(t + ahead, t, column) for column in wanted.T]) for ahead in (-2.0, 2.0)]
    settled = t > 10.0
    if scenario == "steps":  # a step is begun before, and takes a while
        settled &= np.all([other == wanted for other in around], axis=(0, 2)) & (t < t[-1] - 2.0)
    assert settled.sum() > 30
    assert np.abs(x - wanted)[settled].max() <= 0.01  # rad
    assert np.ptp(x, axis=0).min() > 0.4, "both move"
    assert x[:, 1].min() >= -0.1 - 1e-6
