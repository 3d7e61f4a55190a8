# SPDX-License-Identifier: Apache-2.0
"""
Tune by hand: one problem with several weights, each in closed loop, in a table.

    python examples/tuning.py [tuning.png]
"""

import sys

import numpy as np

from rti_mpc import Rti, compare, simulate
from rti_mpc.rti.simulation import Simulation
from rti_mpc_service.config.build import build_ocp
from rti_mpc_service.config.config import load
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import robot_file

config = load(robot_file("kinematic_bicycle"))
ocp = build_ocp(config)
scenario = find_scenario(config, duration_s=20.0)
rows = scenario.y(np.zeros(ocp.model.nx))
times = scenario.period_s * np.arange(len(rows))


def eight(t: np.ndarray) -> np.ndarray:
    """Rows x, y, psi of the car's own scenario."""
    return np.column_stack([np.interp(t, times, column) for column in rows.T])


def draw(runs: dict[str, Simulation], file: str) -> None:
    """Draw the ways driven, and what was commanded for them."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(8.4, 3.4), layout="constrained")
    plan, inputs = page.subplots(1, 2, width_ratios=[1.0, 1.4])
    for name, run in runs.items():
        plan.plot(*run.x[:, :2].T, linewidth=1.2)
        inputs.plot(run.t[:-1], run.u[:, 1], linewidth=1.2, label=name)
    plan.plot(*run.y_ref[:, :2].T, color="0.8", linewidth=5.0, zorder=0)
    plan.set(xlabel="x [m]", ylabel="y [m]", title="the eight", aspect="equal")
    inputs.set(xlabel="time [s]", ylabel="steering rate [rad/s]", title="what it takes")
    inputs.legend(loc="upper right", ncols=3)
    page.savefig(file, dpi=90)


runs = {}
for weight in (1e-4, 1e-2, 1.0):
    tuned = ocp.retuned(R=[weight, weight])
    runs[f"R = {weight:g}"] = simulate(Rti(tuned), tuned.phi(), eight, samples=375)
print(compare(runs))
if len(sys.argv) > 1:
    draw(runs, sys.argv[1])
