# SPDX-License-Identifier: Apache-2.0
"""Sail a boat in a current that nobody measures, with and without the observer that estimates it: controller and robot in lockstep."""

import numpy as np

from rti_mpc import Controller
from rti_mpc.contract.message import Reference
from rti_mpc.control.controller import Timing
from rti_mpc_service.config.build import build_observer, build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config, ObserverSection
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import robot_file
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings

DURATION_S = 40.0


def error_m(config: Config) -> float:
    """Return how far the boat is from its reference after 40 s, in m."""
    scenario = find_scenario(config, duration_s=DURATION_S + 5.0)
    settings = robot_settings(config)
    y = scenario.y(np.array(settings["x0"]))
    controller, boat = Controller(build_rti(config), Timing(), observer=build_observer(config)), Lockstep(RobotSettings(**settings))
    controller.receive_reference(Reference(1, 1, 0, round(1e9 * scenario.period_s), scenario.end, y, np.zeros((len(y), 0))))
    while boat.now_ns < 1e9 * DURATION_S:
        command = controller.receive_state(boat.tick(), boat.now_ns)
        if command is not None:
            boat.accept(command, boat.now_ns)
            controller.commit(command)
            controller.prepare()
    return float(np.hypot(*(boat.x[:2] - y[round(1e-9 * boat.now_ns / scenario.period_s)])))


with_observer = load(robot_file("boat"))
without = with_observer.model_copy(update={"observer": ObserverSection()})
print(f"{1e3 * error_m(without):.1f} mm off without the observer, {1e3 * error_m(with_observer):.1f} mm with it")
