# SPDX-License-Identifier: Apache-2.0
"""
Sail a boat in a current that nobody measures, with and without the observer that estimates it: controller and robot in lockstep.

    python examples/observer.py [observer.png]
"""

import sys

import numpy as np

from rti_mpc import Controller, Reference, Timing
from rti_mpc_service.config.build import build_observer, build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config, ObserverSection
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import robot_file
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings

DURATION_S = 40.0


def sail(config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Return where the boat was and where it was to be, each shape ``(M, 2)``, in m."""
    scenario = find_scenario(config, duration_s=DURATION_S + 5.0)
    settings = robot_settings(config)
    y = scenario.y(np.array(settings["x0"]))
    controller, boat = Controller(build_rti(config), Timing(), observer=build_observer(config)), Lockstep(RobotSettings(**settings))
    controller.receive_reference(Reference(1, 1, 0, round(1e9 * scenario.period_s), scenario.end, y, np.zeros((len(y), 0))))
    sailed, wanted = [], []
    while boat.now_ns < 1e9 * DURATION_S:
        command = controller.receive_state(boat.tick(), boat.now_ns)
        sailed.append(boat.x[:2].copy())
        wanted.append(y[round(1e-9 * boat.now_ns / scenario.period_s), :2])
        if command is not None:
            boat.accept(command, boat.now_ns)
            controller.commit(command)
            controller.prepare()
    return np.array(sailed), np.array(wanted)


def draw(ways: dict[str, np.ndarray], wanted: np.ndarray, file: str) -> None:
    """Draw the ways sailed, and the errors over time."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(8.4, 3.4), layout="constrained")
    plan, errors = page.subplots(1, 2, width_ratios=[1.0, 1.2])
    plan.plot(*wanted.T, color="0.8", linewidth=5.0)
    for name, sailed in ways.items():
        plan.plot(*sailed.T, linewidth=1.2)
        errors.semilogy(np.linspace(0.0, DURATION_S, len(sailed)), 1e3 * np.hypot(*(sailed - wanted).T), linewidth=1.2, label=name)
    plan.set(xlabel="x [m]", ylabel="y [m]", title="an eight in a current", aspect="equal")
    errors.set(xlabel="time [s]", ylabel="error [mm]", title="distance from the reference")
    errors.legend(loc="center right")
    page.savefig(file, dpi=90)


with_observer = load(robot_file("boat"))
ways = {}
for name, config in {"without the observer": with_observer.model_copy(update={"observer": ObserverSection()}), "with it": with_observer}.items():
    ways[name], wanted = sail(config)
print(", ".join(f"{1e3 * np.hypot(*(sailed[-1] - wanted[-1])):.1f} mm off {name}" for name, sailed in ways.items()))
if len(sys.argv) > 1:
    draw(ways, wanted, sys.argv[1])
