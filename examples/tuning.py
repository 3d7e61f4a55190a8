# SPDX-License-Identifier: Apache-2.0
"""Tune by hand: one problem with several weights, each in closed loop, in a table."""

import numpy as np

from rti_mpc import Rti, compare, simulate
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


runs = {}
for weight in (1e-4, 1e-2, 1.0):
    tuned = ocp.retuned(R=[weight, weight])
    runs[f"R = {weight:g}"] = simulate(Rti(tuned), tuned.phi(), eight, samples=375)
print(compare(runs))
