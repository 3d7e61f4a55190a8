# SPDX-License-Identifier: Apache-2.0
"""Robots that keep no convention, in lockstep: what they are to follow comes by role."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Reference
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.reference.trajectory import eight, followed_roles, rows
from rti_mpc.signals import place, plane
from rti_mpc_service.config.build import build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.rig.scenario import configured
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, drive
from tests.robots import toml


@pytest.mark.parametrize(("name", "limit_mm"), [("shuffled", 1.0), ("glider", 1.0), ("rover", 10.0)])
def test_the_eight_is_followed_whatever_the_order_and_the_names(name: str, limit_mm: float, tmp_path: Path) -> None:
    """The rover's heading is the tangent, without an offset; it cuts where the eight bends."""
    path = tmp_path / "robot.toml"
    path.write_text(toml(name))
    config = configured(load(path), eight(), "consistent", guard=False)
    rti = build_rti(config)
    model = rti.ocp.model
    offset = place(model.parameters, "axle_offset")
    a = None if offset is None else model.p_nominal[offset]
    y = rows(eight().lasting(60.0), 0.02, "consistent", a, roles=followed_roles(name, model.outputs))
    controller = Controller(rti, Timing())
    controller.receive_reference(Reference(1, 1, 0, 20 * MS, eight().end, y, np.zeros((len(y), 0))))
    body = Lockstep(RobotSettings(**robot_settings(config)))
    position = plane(model.states)
    assert position is not None
    assert body.x[list(position)] == pytest.approx([0.5, 0.0]), "it starts where the scenario says"
    run = drive(controller, body, 55.0)
    settled = np.array(run.t_s) > 20.0
    wanted = eight().position(np.array(run.t_s))
    error_mm = 1e3 * np.hypot(*(np.array(run.x)[:, position] - wanted).T)
    assert error_mm[settled].max() <= limit_mm
