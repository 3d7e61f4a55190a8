# SPDX-License-Identifier: Apache-2.0
"""
Pass two discs that lie on the way, and say how near they are passed.

    python examples/obstacles.py [obstacles.png]
"""

import sys

import numpy as np

from rti_mpc import Ocp, Rti, find_model, simulate
from rti_mpc.model.obstacle import with_obstacles
from rti_mpc.rti.simulation import Simulation

DISCS = [(1.0, 0.05, 0.3), (2.2, -0.1, 0.3)]  # x, y and radius, m
robot = with_obstacles(find_model("pioneer_3dx"), DISCS)
bounds = {"lbu": [-0.5, -0.745], "ubu": [0.5, 0.745], "lbdu": [-0.25, -0.4], "ubdu": [0.25, 0.4]}
ocp = Ocp(robot, N=20, dt=0.1, Q=[1, 1, 0], R=[1, 1], delta=28, lambda_=0.8, lh=0.0, **bounds)


def line(t: np.ndarray) -> np.ndarray:
    """Rows x, y, psi: along the x axis at 0.25 m/s, through both discs, to x = 3 m."""
    return np.column_stack([np.minimum(0.25 * t, 3.0), 0 * t, 0 * t])


def draw(run: Simulation, file: str) -> None:
    """Draw the discs and the way around them."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    page = Figure(figsize=(8.4, 3.2), layout="constrained")
    axes = page.subplots()
    for x, y, radius in DISCS:
        axes.add_patch(Circle((x, y), radius, color="0.8"))
    axes.plot(*run.y_ref[:, :2].T, linewidth=4.0, alpha=0.4, label="reference")
    axes.plot(*run.x[:, :2].T, label="robot")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="The nearest way around two discs", aspect="equal")
    axes.legend(loc="upper right", ncols=2)
    page.savefig(file, dpi=90)


run = simulate(Rti(ocp), find_model("pioneer_3dx"), line, samples=180)
nearest = min(np.hypot(run.x[:, 0] - x, run.x[:, 1] - y).min() - radius for x, y, radius in DISCS)
print(f"no nearer than {1e3 * nearest:.0f} mm to a disc, {1e3 * np.hypot(*run.error[-1, :2]):.1f} mm off in the end")
if len(sys.argv) > 1:
    draw(run, sys.argv[1])
