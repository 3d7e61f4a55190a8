# SPDX-License-Identifier: Apache-2.0
"""A robot follows a path, with the processes that a user runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.processes.system import System

pytestmark = pytest.mark.slow

ROBOT = """
from rti_mpc import find_model
from rti_mpc.model.path_following import path_following

def robot():
    return path_following(find_model("pioneer_3dx"))
"""
TOML = """
robot = "follower"
model = { name = "my_robot:robot" }
[ocp]
N = 15
dt_s = 0.1
weights = { Q = { contour = 5.0, lag = 20.0, pace_error = 1.0 }, R = { u_c = 1.0, omega_c = 1.0, pace_c = 0.1 } }
[ocp.bounds]
inputs = { u_c = [-0.5, 0.5], omega_c = [-1.0, 1.0], pace_c = [0.0, 0.5] }
increments = { u_c = [-0.25, 0.25], omega_c = [-0.4, 0.4], pace_c = [-0.25, 0.25] }
constraints = { left = [0.1, inf], right = [0.1, inf] }
"""
TRACK = "x_m,y_m,w_tr_right_m,w_tr_left_m\n0,0,0.3,0.3\n1,0,0.3,0.3\n2,1,0.3,0.3\n3,1,0.3,0.3\n"


def test_robot_follows_a_file_to_its_end_and_stops_without_its_path(tmp_path: Path) -> None:
    (tmp_path / "my_robot.py").write_text(ROBOT)
    (tmp_path / "robot.toml").write_text(TOML)
    (tmp_path / "track.csv").write_text(TRACK)
    path = ("reference", "--path", tmp_path / "track.csv", "--path-limits", 0.4, 0.3, 0.3, 0.3)
    with System(tmp_path, tmp_path / "robot.toml", robot=("sim", "--speed", 2), reference=path) as system:
        system.start("robot", "controller", "reference")
        moving = system.state(lambda state: state.x[3] > 0.2 and state.x[0] > 0.5)
        assert 0.3 < moving.x[5] < 3.0  # m of progress
        end = system.state(lambda state: np.hypot(state.x[0] - 3.0, state.x[1] - 1.0) < 0.08 and abs(state.x[3]) < 0.02)
        assert end.x[5] == pytest.approx(3.5, abs=0.2)  # m of progress: the polyline is 3.41 m long, the curve through its points longer
        assert system.interrupt("reference") == 0
        stopped = system.event("mode", "controller")
        assert stopped.text.endswith("the reference ended with STOP")
