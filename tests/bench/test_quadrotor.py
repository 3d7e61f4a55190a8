# SPDX-License-Identifier: Apache-2.0
"""CPU time of both phases while the quadrotor that ships flies its eight at 100 Hz: all that the controller does in a sample, in lockstep."""

from __future__ import annotations

import os

import numpy as np
import pytest

from rti_mpc.contract.message import Reference
from rti_mpc.control.controller import Controller, Timing
from rti_mpc_service.config.build import build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import robot_file
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.bench.timed import timed

SHORT = "CI" in os.environ  # to see that all of it runs: figures need a quiet machine, and `make bench`
SHARE = 0.2  # of the period that each phase may take, at p99

pytestmark = pytest.mark.benchmark


def test_phases_of_a_flight_take_a_fifth_of_the_period() -> None:
    config = load(robot_file("quadrotor"))
    scenario, settings = find_scenario(config), robot_settings(config)
    controller, body = Controller(build_rti(config), Timing()), Lockstep(RobotSettings(**settings))
    rows = scenario.y(np.array(settings["x0"]))
    controller.receive_reference(Reference(1, 1, 0, round(1e9 * scenario.period_s), scenario.end, rows, np.zeros((len(rows), 0))))
    phases: dict[str, list[float]] = {"preparation": [], "feedback": []}
    prepare, feedback = timed(controller.prepare, phases["preparation"]), timed(controller.receive_state, phases["feedback"])
    while body.now_ns < round(1e9 * (5.0 if SHORT else scenario.duration_s - 1.0)):
        if (command := feedback(body.tick(), body.now_ns)) is not None:
            body.accept(command, body.now_ns)
            controller.commit(command)
            prepare()
    most_ms = SHARE * 1e3 * config.ocp.dt_s
    for phase, ms in phases.items():
        p50, p99, most = np.percentile(ms, (50, 99, 100))
        print(f"\n{phase:11} median {p50:.2f}, p99 {p99:.2f}, max {most:.2f} ms of {len(ms)}, of {1e3 * config.ocp.dt_s:.0f}")
        assert SHORT or p99 <= most_ms, f"{phase}: p99 {p99:.2f} ms of CPU time, {most_ms:.1f} is a fifth of the period"
