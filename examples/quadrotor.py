# SPDX-License-Identifier: Apache-2.0
"""
Fly a quadrotor that ships to a point and back: its configuration and a loop without a bus.

    python examples/quadrotor.py [quadrotor.png]
"""

import sys

import numpy as np

from rti_mpc import Rti, plot, simulate
from rti_mpc_service.config.build import build_ocp
from rti_mpc_service.config.config import load
from rti_mpc_service.shipped import robot_file

ocp = build_ocp(load(robot_file("quadrotor")))


def there_and_back(t: np.ndarray) -> np.ndarray:
    """Rows x, y, z, psi: to a point 1 m ahead and 0.5 m up, and after 2 s back."""
    away = (t < 2.0)[:, None]
    return np.where(away, [1.0, 0.0, 0.5, 0.0], [0.0, 0.0, 0.0, 0.0])


run = simulate(Rti(ocp), ocp.phi(), there_and_back, samples=400)  # 4 s at 100 Hz; the model plays the robot
print(
    f"{1e3 * np.linalg.norm(run.error[-1, :3]):.1f} mm from where it began, tilted by at most {np.degrees(np.abs(run.x[:, 3:5]).max()):.0f} degrees"
)
if len(sys.argv) > 1:
    plot(run).savefig(sys.argv[1], dpi=75)
