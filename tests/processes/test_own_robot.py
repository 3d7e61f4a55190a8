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

from tests.processes.system import STATE, command_line

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
    return subprocess.run(arguments, cwd=folder / "elsewhere", env=environment, capture_output=True, text=True, timeout=240)


def driven(folder: Path, module: str, *options: str, **tables: str) -> Any:
    """Run a demo of a robot; return its summary."""
    done = run(folder, "demo", module, "--out", "out", *options, **tables)
    assert done.returncode == 0, done.stdout + done.stderr
    out = folder / "elsewhere" / "out"
    assert (out / "run.png").read_bytes().startswith(b"\x89PNG")
    assert "Traceback" not in "".join(path.read_text() for path in (out / "logs").glob("*.log"))
    return json.loads((out / "summary.json").read_text())


@pytest.mark.slow
def test_arm_is_driven_along_references_of_its_outputs_behind_a_guard(tmp_path: Path) -> None:
    (tmp_path / "wave.csv").write_text("t,elbow,shoulder\n0,0,0\n10,0.5,-0.5\n20,0,0\n")
    summary = driven(
        tmp_path,
        ARM,
        *("--guard", "--scenario", "../wave.csv", "--speed", "4", "--duration", "20"),
        **ARM_TABLES,
    )
    assert (summary["scenario"], summary["heading"], summary["driven"], summary["final_error_mm"]) == ("wave", None, True, None)
    assert {name: error["unit"] for name, error in summary["outputs"].items()} == {"shoulder": "rad", "elbow": "rad"}
    assert max(error["rms"] for error in summary["outputs"].values()) < 0.1  # rad, of 0.5, also where the host holds processes up for a second
    assert summary["applied_inputs_in_bounds"]


@pytest.mark.slow
def test_robot_whose_outputs_are_heading_x_and_y_is_driven_along_its_path(tmp_path: Path) -> None:
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
    assert np.median(beside_m) < 1e-3, "the host may hold processes up for a while, but never half of the time"
    assert summary["outputs"].keys() == {"psi", "x", "y"}


@pytest.mark.slow
def test_faults_of_an_arm_are_measured_by_its_outputs(tmp_path: Path) -> None:
    done = run(tmp_path, "faults", ARM, "--only", "controller_killed", "--json", "faults.json", **ARM_TABLES)
    assert done.returncode == 0, done.stdout + done.stderr
    (row,) = json.loads((tmp_path / "elsewhere" / "faults.json").read_text())
    assert (row["unit"], row["kept"], row["robot"]) == ("rad", True, "braked, stood, drove again")
    assert "rad/s" in done.stdout
