# SPDX-License-Identifier: Apache-2.0
"""Robots of a user's own, beside their configuration in a folder of his, driven by the command that he runs from anywhere."""

from __future__ import annotations

import csv
import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rti_mpc_service.host.hold_up import Host
from tests.in_time import on_time
from tests.processes.system import STATE, begun_ns, command_line

pytest.importorskip("matplotlib")

ARM = """
import casadi as ca
from rti_mpc import Model, Signal

def robot():
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    lag_s = 0.2
    joints = (Signal("shoulder", "rad", angle=True), Signal("elbow", "rad", angle=True))
    return Model(
        name="own_arm", x=x, u=u, f_expl_expr=ca.vertcat(x[2], u[1], (u[0] - x[2]) / lag_s), y_expr=x[:2],
        states=(*joints, Signal("w", "rad/s")), inputs=(Signal("w_1", "rad/s", commands="w"), Signal("w_2", "rad/s")), outputs=joints,
    )
"""
ROVER = """
from dataclasses import replace
from rti_mpc import find_model

def robot():
    pioneer = find_model("pioneer_3dx")
    x, y, psi = pioneer.outputs
    return replace(pioneer, name="turned", y_expr=pioneer.y_expr[[2, 0, 1]], outputs=(psi, x, y))
"""
CAR = """
import casadi as ca
from rti_mpc import Model, Signal

def robot():
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 2)
    return Model(
        name="car", x=x, u=u, y_expr=x[:2],
        f_expl_expr=ca.vertcat(x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), x[3] * u[1], u[0]),
        states=(Signal("x", "m", role="x"), Signal("y", "m", role="y"), Signal("psi", "rad", angle=True, role="heading"), Signal("v", "m/s")),
        inputs=(Signal("a", "m/s^2"), Signal("kappa", "1/m")),
        outputs=(Signal("x", "m", role="x"), Signal("y", "m", role="y")),
    )
"""
TIP = """
import casadi as ca
from rti_mpc import Model, Signal

def robot():
    q, w = ca.SX.sym("q", 2), ca.SX.sym("w", 2)
    tip = ca.vertcat(ca.cos(q[0]) + ca.cos(q[0] + q[1]), ca.sin(q[0]) + ca.sin(q[0] + q[1]))
    return Model(
        name="tip", x=q, u=w, f_expl_expr=w, y_expr=tip, states=(Signal("q_1", "rad"), Signal("q_2", "rad")), inputs=("w_1", "w_2"),
        outputs=(Signal("tip_x", "m", role="x"), Signal("tip_y", "m", role="y")), x_nominal=(0.0, 1.57),
    )
"""
TOML = """
robot = "own"
model = {{ name = "my_robot:robot" }}
[ocp]
N = 20
dt_s = 0.1
weights = {{ Q = {{ {Q} }}, R = {{ {R} }}, lambda = 0.01 }}
bounds = {{ inputs = {{ {inputs} }}, increments = {{ {increments} }} }}
"""


ARM_TABLES = {
    "Q": "shoulder = 1.0, elbow = 1.0",
    "R": "w_1 = 1.0, w_2 = 1.0",
    "inputs": "w_2 = [-1.0, 1.0], w_1 = [-1.0, 1.0]",
    "increments": "w_1 = [-0.2, 0.2], w_2 = [-0.2, 0.2]",
}


def run(folder: Path, command: str, module: str, *options: str, **tables: str) -> subprocess.CompletedProcess[str]:
    """Run a command with a robot, from another folder, without `PYTHONPATH`."""
    (folder / "own").mkdir()
    (folder / "elsewhere").mkdir()
    (folder / "own" / "my_robot.py").write_text(module)
    (folder / "own" / "robot.toml").write_text(TOML.format(**tables))
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"STATE_DIRECTORY": str(STATE)}
    arguments = command_line(command, "../own/robot.toml", *options)
    return subprocess.run(arguments, cwd=folder / "elsewhere", env=environment, capture_output=True, text=True, timeout=600)


def punctual(host: Host, folder: Path) -> bool:
    """Whether the host left a demo alone while it drove: less than a second, which these errors bear, was lost of any four."""
    return on_time(host, "the drive", 2000.0, begun_ns(folder / "elsewhere" / "out" / "logs"))


def driven(folder: Path, module: str, *options: str, **tables: str) -> Any:
    """Run a demo of a robot; return its summary."""
    done = run(folder, "demo", module, "--out", "out", *options, **tables)
    assert done.returncode == 0, done.stdout + done.stderr
    out = folder / "elsewhere" / "out"
    assert (out / "run.png").read_bytes().startswith(b"\x89PNG")
    assert "Traceback" not in "".join(path.read_text() for path in (out / "logs").glob("*.log"))
    return json.loads((out / "summary.json").read_text())


@pytest.mark.slow
def test_arm_is_driven_along_references_of_its_outputs_behind_a_guard(tmp_path: Path, host: Host) -> None:
    (tmp_path / "wave.csv").write_text("t,elbow,shoulder\n0,0,0\n10,0.5,-0.5\n20,0,0\n")
    summary = driven(
        tmp_path,
        ARM,
        *("--guard", "--scenario", "../wave.csv", "--speed", "4", "--duration", "20"),
        **ARM_TABLES,
    )
    assert (summary["scenario"], summary["heading"], summary["driven"], summary["final_error_mm"]) == ("wave", None, True, None)
    assert {name: error["unit"] for name, error in summary["outputs"].items()} == {"shoulder": "rad", "elbow": "rad"}
    largest = max(error["rms"] for error in summary["outputs"].values())
    assert largest < 0.1 or not punctual(host, tmp_path), f"{largest} rad, of 0.5"
    assert summary["applied_inputs_in_bounds"]


@pytest.mark.slow
def test_car_of_the_readme_drives_a_recorded_track(tmp_path: Path, host: Host) -> None:
    """An ellipse of 12 m by 8 m, recorded with an error of 2 cm, at 1 m/s from a standstill."""
    turn, noise_m = np.linspace(0.0, 2 * np.pi, 240), 0.02 * np.random.default_rng(1).standard_normal((240, 2))
    track_m = np.column_stack([6 * np.sin(turn), 4 * (1 - np.cos(turn))]) + noise_m
    (tmp_path / "track.csv").write_text("x,y\n" + "".join(f"{x:.4f},{y:.4f}\n" for x, y in track_m))
    options = "--scenario ../track.csv --waypoint-speed 1 --waypoint-smoothing 1.5 --duration 30 --speed 2 --out out".split()
    tables = {"Q": "x = 1.0, y = 1.0", "R": "a = 1.0, kappa = 10.0", "inputs": "a = [-2.0, 2.0], kappa = [-0.5, 0.5]", "increments": ""}
    done = run(tmp_path, "demo", CAR, *options, **tables)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "averaged over 1.5 m of path" in done.stdout
    with (tmp_path / "elsewhere" / "out" / "robot.csv").open(newline="") as file:
        x, y = np.array([(float(row["x"]), float(row["y"])) for row in csv.DictReader(file)]).T
    beside_m = np.abs((x / 6) ** 2 + (y / 4 - 1) ** 2 - 1) / np.hypot(x / 18, (y / 4 - 1) / 2)  # zero on the ellipse, over its gradient
    assert np.median(beside_m) < 0.02 or not punctual(host, tmp_path), "less than the track's error"
    assert np.ptp(x) > 11.0, "it has been at both ends of the ellipse"


@pytest.mark.slow
def test_tip_of_an_arm_which_is_no_state_is_driven_along_waypoints_and_recorded(tmp_path: Path, host: Host) -> None:
    reader = pytest.importorskip("rerun.chunk").RrdReader
    (tmp_path / "line.csv").write_text("x,y\n1,1\n1.2,1\n1.2,0.8\n0.8,0.8\n")
    tables = {"Q": "tip_x = 1.0, tip_y = 1.0", "R": "w_1 = 1.0, w_2 = 1.0", "inputs": "w_1 = [-1.0, 1.0], w_2 = [-1.0, 1.0]", "increments": ""}
    summary = driven(tmp_path, TIP, *("--scenario", "../line.csv", "--speed", "2", "--duration", "6"), **tables)
    assert (summary["driven"], summary["heading"]) == (True, None)
    scalars: dict[str, list[float]] = {"/output/tip_x": [], "/error/position": []}
    others = set()
    for chunk in reader(tmp_path / "elsewhere" / "out" / "run.rrd").stream().to_chunks():
        if chunk.entity_path in scalars and not chunk.is_static:
            batch = chunk.to_record_batch()
            scalars[chunk.entity_path] += [value for (value,) in batch.column(batch.num_columns - 1).to_pylist()]
        others.add(chunk.entity_path)
    assert {"/world/reference", "/world/output"} <= others
    assert "/world/robot" not in others
    assert len(scalars["/output/tip_x"]) > 20
    near = 0.7 < min(scalars["/output/tip_x"]) <= max(scalars["/output/tip_x"]) < 1.3 and np.median(scalars["/error/position"]) < 100.0  # m, mm
    assert near or not punctual(host, tmp_path)


@pytest.mark.slow
def test_robot_whose_outputs_are_heading_x_and_y_is_driven_along_its_path(tmp_path: Path, host: Host) -> None:
    """Rows in the order of a path, not of the outputs, would drive it metres aside; in lockstep it is within a millimetre (`test_roles.py`)."""
    summary = driven(
        tmp_path,
        ROVER,
        *("--speed", "4", "--duration", "20"),
        Q="psi = 0.05, x = 1.0, y = 1.0",
        R="u_c = 1.0, omega_c = 1.0",
        inputs="u_c = [-0.5, 0.5], omega_c = [-0.745, 0.745]",
        increments="u_c = [-0.25, 0.25], omega_c = [-0.4, 0.4]",
    )
    assert (summary["scenario"], summary["heading"], summary["driven"]) == ("eight", "consistent", True)
    with (tmp_path / "elsewhere" / "out" / "robot.csv").open(newline="") as file:
        x, y = np.array([(float(row["x"]), float(row["y"])) for row in csv.DictReader(file)])[100:].T
    beside_m = np.abs(y**2 - 4 * x**2 * (1 - x**2)) / np.hypot(2 * y, 8 * x - 16 * x**3)  # zero on the eight, over its gradient
    assert np.median(beside_m) < 1e-3 or not punctual(host, tmp_path)
    assert summary["outputs"].keys() == {"psi", "x", "y"}


@pytest.mark.slow
def test_faults_of_an_arm_are_measured_by_its_outputs(tmp_path: Path) -> None:
    done = run(tmp_path, "faults", ARM, "--only", "controller_killed", "--json", "faults.json", **ARM_TABLES)
    assert done.returncode == 0, done.stdout + done.stderr
    (row,) = json.loads((tmp_path / "elsewhere" / "faults.json").read_text())
    assert (row["unit"], row["kept"], row["robot"]) == ("rad", True, "braked, stood, drove again")
    assert "rad/s" in done.stdout
