# SPDX-License-Identifier: Apache-2.0
"""
Draw a circle with an arm whose motors answer 30 ms late, the delay ignored, configured and measured: controller and robot in lockstep.

    python examples/delay.py [delay.png]

A robot's own file says the same in its table `[timing]`: `delay_s = 0.03`, or `delay_s = "measured"`.
"""

import sys

import numpy as np

from rti_mpc import Controller, Reference, Timing
from rti_mpc_service.config.build import build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import robot_file
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings

DURATION_S, SETTLED_S = 12.0, 8.0  # three turns of the circle, of which the last one counts
ACTUATOR_DELAY_S = 0.03  # from the arrival of a command until it acts; the controller's period is 0.02 s
DELAYS_S = {"ignored": 0.0, "configured": ACTUATOR_DELAY_S, "measured": None}


def draw_circle(delay_s: float | None) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the tip and where it was to be, each shape ``(M, 2)`` in m, and the delay that the controller expects in the end, in s."""
    config = load(robot_file("two_link_arm"))
    scenario = find_scenario(config, duration_s=DURATION_S + 5.0)
    settings = robot_settings(config)
    rows, tip = scenario.y(np.array(settings["x0"])), settings["model"].h()
    controller = Controller(build_rti(config), Timing(delay_s))
    arm = Lockstep(RobotSettings(**settings, actuator_delay_s=ACTUATOR_DELAY_S))
    controller.receive_reference(Reference(1, 1, 0, round(1e9 * scenario.period_s), scenario.end, rows, np.zeros((len(rows), 0))))
    drawn, wanted = [], []
    while arm.now_ns < 1e9 * DURATION_S:
        command = controller.receive_state(arm.tick(), arm.now_ns)
        drawn.append(np.array(tip(arm.x, [])).ravel())
        wanted.append([np.interp(1e-9 * arm.now_ns / scenario.period_s, np.arange(len(rows)), column) for column in rows.T])
        if command is not None:
            arm.accept(command, arm.now_ns)
            controller.commit(command)
            controller.prepare()
    return np.array(drawn), np.array(wanted), 1e-9 * controller.grid.delay_ns


def draw(runs: dict[str, np.ndarray], wanted: np.ndarray, file: str) -> None:
    """Draw the circles, and the errors over time."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(8.4, 3.4), layout="constrained")
    plan, errors = page.subplots(1, 2, width_ratios=[1.0, 1.4])
    plan.plot(*wanted.T, color="0.8", linewidth=5.0)
    for name, drawn in runs.items():
        plan.plot(*drawn[round(SETTLED_S / DURATION_S * len(drawn)) :].T, linewidth=1.2)
        errors.semilogy(np.linspace(0.0, DURATION_S, len(drawn)), 1e3 * np.hypot(*(drawn - wanted).T), linewidth=1.2, label=f"delay {name}")
    plan.set(xlabel="x [m]", ylabel="z [m]", title="the last turn", aspect="equal")
    errors.set(xlabel="time [s]", ylabel="error [mm]", title="motors that answer 30 ms late")
    errors.legend(loc="center right")
    page.savefig(file, dpi=90)


runs = {}
for name, delay_s in DELAYS_S.items():
    runs[name], wanted, expected_s = draw_circle(delay_s)
    error = np.hypot(*(runs[name] - wanted).T)[round(SETTLED_S / DURATION_S * len(wanted)) :]
    print(f"{1e3 * error.max():.2f} mm off at most with the delay {name}, which is taken to be {1e3 * expected_s:.1f} ms")
if len(sys.argv) > 1:
    draw(runs, wanted, sys.argv[1])
