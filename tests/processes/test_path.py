# SPDX-License-Identifier: Apache-2.0
"""A robot follows a path, with the processes that a user runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command import command
from tests.processes.system import System, rti_mpc

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


def robot_in(folder: Path) -> Path:
    """Write a robot that follows a path, and a track; return its TOML file."""
    (folder / "my_robot.py").write_text(ROBOT)
    (folder / "robot.toml").write_text(TOML)
    (folder / "track.csv").write_text(TRACK)
    return folder / "robot.toml"


@pytest.mark.slow  # compiles a problem of its own
def test_robot_follows_a_file_to_its_end_and_stops_without_its_path(tmp_path: Path) -> None:
    config = robot_in(tmp_path)
    path = ("reference", "--path", tmp_path / "track.csv", "--path-limits", 0.4, 0.3, 0.3, 0.3)
    with System(tmp_path, config, robot=("sim", "--speed", 2), reference=path) as system:
        system.start("robot", "controller", "reference")
        moving = system.state(lambda state: state.x[3] > 0.2 and state.x[0] > 0.5)
        assert 0.3 < moving.x[5] < 3.0  # m of progress
        end = system.state(lambda state: np.hypot(state.x[0] - 3.0, state.x[1] - 1.0) < 0.08 and abs(state.x[3]) < 0.02)
        assert end.x[5] == pytest.approx(3.5, abs=0.2)  # m of progress: the polyline is 3.41 m long, the curve through its points longer
        assert system.interrupt("reference") == 0
        stopped = system.event("mode", "controller")
        assert stopped.text.endswith("the reference ended with STOP")


@pytest.mark.slow
def test_demo_drives_a_path_as_the_whole_system(tmp_path: Path) -> None:
    """To its end, inside its edges, with a summary and a figure."""
    config, out = robot_in(tmp_path), tmp_path / "out"
    done = rti_mpc("demo", config, "--path", tmp_path / "track.csv", "--path-limits", 0.4, 0.3, 0.3, 0.3, "--speed", 2, "--out", out)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads((out / "summary.json").read_text())
    path = summary["path"]
    assert summary["driven"]
    assert path["driven_m"] == pytest.approx(path["length_m"], abs=0.05), done.stdout
    assert path["laps_s"] == []
    assert 90.0 < path["closest_to_edge_mm"] < 300.0, "100 mm are to be kept"
    assert f"{path['driven_m']:.1f} m of {path['length_m']:.1f} m" in done.stdout
    assert (out / "run.png").stat().st_size > 20_000


def test_path_and_robot_that_do_not_fit_are_refused_before_anything_starts(tmp_path: Path) -> None:
    config = robot_in(tmp_path)
    for options, said in (
        ((config,), "model pioneer_3dx follows a path: --path must say which, hairpin, chicane, oval or a FILE.csv"),
        ((config, "--path", "spiral"), "--path must be one of hairpin, chicane, oval or a FILE.csv of a path, got 'spiral'"),
        (
            (config, "--path", "oval", "--scenario", "eight"),
            "--path is followed in place of a scenario and says nothing of time: --scenario must be left out",
        ),
        (
            ("--path", "oval"),
            "model pioneer_3dx must be made by path_following for --path, see docs/paths.md: it has no parameter whose role is path_start",
        ),
        (("--path-limits", 1, 1, 1, 1), "--path-limits are those of a --path, which must be given as well"),
    ):
        done = command("demo", *options, "--out", tmp_path / "out")
        assert (done.returncode, done.stderr) == (2, f"rti-mpc: {said}\n")
    assert not (tmp_path / "out").exists()
