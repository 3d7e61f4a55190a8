# SPDX-License-Identifier: Apache-2.0
"""The file of signals: `check` writes it, a guard goes by it without the user's model, `run` refuses one that is outdated."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import ConfigError
from rti_mpc.rotation import Rotations
from rti_mpc_service.check import check
from rti_mpc_service.check.agreement import Agreement
from rti_mpc_service.cli import app
from rti_mpc_service.config import signals_file
from rti_mpc_service.config.build import build_ocp, build_signals, guard_limits
from rti_mpc_service.config.config import load
from rti_mpc_service.controller import daemon
from rti_mpc_service.shipped import ROBOTS, SHIPPED

MODEL = """
import casadi as ca
from rti_mpc import Model, Signal

def car():
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 2)
    pose = (Signal("x", "m", role="x"), Signal("y", "m", role="y"), Signal("psi", "rad", angle=True, role="heading"))
    return Model(
        name="car", x=x, u=u, f_expl_expr=ca.vertcat(x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), x[3] * u[1], u[0]), y_expr=x[:3],
        states=(*pose, Signal("v", "m/s")), inputs=(Signal("a", "m/s^2"), Signal("kappa", "1/m")), outputs=pose,
    )
"""
TOML = """
robot = "car"
model = { name = "my_robot:car" }
[ocp]
N = 10
dt_s = 0.05
[ocp.weights]
Q = { x = 1.0, y = 1.0, psi = 0.05 }
R = { a = 0.1, kappa = 0.1 }
[ocp.bounds]
inputs = { kappa = [-0.5, 0.5], a = [-2.0, 2.0] }
states = { v = [0.0, 3.0] }
[guard]
enabled = true
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "my_robot.py").write_text(MODEL)
    (tmp_path / "robot.toml").write_text(TOML)
    return tmp_path / "robot.toml"


@pytest.fixture
def checked(path: Path) -> Path:
    """The same, as after `check`."""
    signals_file.write(path, build_signals(load(path)))
    return path


def test_guard_knows_a_model_from_the_file_that_check_writes_and_does_without_the_users_code(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    times = np.array([1.0])
    report = check.CheckReport(times, times, Counter({QpStatus.SOLVED: 1}), "daqp", [Agreement(0.0, 0.0)], 0.0, 0, [])
    monkeypatch.setattr(check, "check", lambda *_: report)
    monkeypatch.setattr(check, "stop_from_everywhere", lambda ocp, law, **_: "")
    path.write_text(TOML.replace("enabled = true", "enabled = false"))
    assert check.main(path) == 0
    assert capsys.readouterr().out.endswith(f"the model's signals, for a guard or an adapter: {path.parent}/robot.signals.json\n")
    path.write_text(TOML)
    (path.parent / "my_robot.py").unlink()
    config = load(path, with_model=False)
    limits = guard_limits(config, signals_file.read(path, config))
    assert (limits.rotations, limits.u_rest.tolist()) == (Rotations(4, (2,)), [0.0, 0.0])
    assert (limits.lbu.tolist(), limits.ubu.tolist()) == ([-2.0, -0.5], [2.0, 0.5]), "in the model's order, not in that of the file"


def test_guard_knows_a_quaternion_from_the_file(tmp_path: Path) -> None:
    path = tmp_path / "quadrotor.toml"
    shutil.copy(ROBOTS["quadrotor_quaternion"], path)
    config = load(path)
    file = signals_file.write(path, build_signals(config))
    assert guard_limits(config, signals_file.read(path, config)).rotations == build_ocp(config).model.rotations("states")
    for wrong in ('["q_w", "q_x", "q_y"]', '["q_w", "q_x", "q_y", "q"]', "3"):
        content = json.loads(file.read_text())
        file.write_text(json.dumps(content | {"quaternions": [json.loads(wrong)]}))
        with pytest.raises(ConfigError, match="must be what rti-mpc check writes, version 1"):
            signals_file.read(path, config)


def test_check_writes_no_file_that_nobody_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a robot whose inputs ramp to rest, without a guard: its folder may be one that cannot be written."""
    monkeypatch.setattr(signals_file, "write", lambda *_: pytest.fail("was to be written"))
    monkeypatch.setattr(check, "stop_from_everywhere", lambda ocp, law, **_: "")
    times = np.array([1.0])
    monkeypatch.setattr(check, "check", lambda *_: check.CheckReport(times, times, Counter(), "daqp", [Agreement(0.0, 0.0)], 0.0, 0, []))
    assert check.main(SHIPPED) == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda file: file.unlink(), "must be a readable file, got No such file or directory"),
        (lambda file: file.write_text("{"), "must be what rti-mpc check writes, version 1"),
        (lambda file: file.write_text('{"version": 1, "model": "my_robot:car", "states": [3], "inputs": []}'), "must be what rti-mpc check writes"),
        (lambda file: file.write_text(file.read_text().replace('"version": 1', '"version": 2')), "must be what rti-mpc check writes, version 1"),
        (lambda file: file.write_text(file.read_text().replace(":car", ":boat")), "must be of model.name = 'my_robot:car', got 'my_robot:boat'"),
        (lambda file: file.write_text(file.read_text().replace('"a"', '"b"')), "must have the inputs of ocp.weights.R, a, kappa, got b, kappa"),
        (lambda file: file.write_text(file.read_text().replace('"v"', '"w"')), "must have the states of ocp.bounds.states, v is missing"),
        (
            lambda file: file.write_text(file.read_text().replace('"rest": 0.0', '"rest": 1.0')),
            "kappa rests at 1, which ocp.bounds.inputs.kappa = [-0.5, 0.5] must hold",
        ),
    ],
)
def test_file_that_is_missing_none_or_of_another_model_is_refused_by_its_name_with_the_cure(checked: Path, change: object, said: str) -> None:
    file = signals_file.file_beside(checked)
    change(file)  # type: ignore[operator]
    refused = CliRunner().invoke(app, ["guard", str(checked)]).exception
    assert isinstance(refused, ConfigError)
    assert str(refused).startswith(f"{file}: {said}")
    assert str(refused).endswith(f"; run rti-mpc check {checked} where the model is, and copy both files")
    assert "\n" not in str(refused)


def test_run_refuses_a_file_of_the_model_as_it_was(checked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The guard would take one state for another; where there is no file, the guard and its own are elsewhere."""
    monkeypatch.setattr(daemon, "main", lambda *_, **__: 0)
    file = signals_file.file_beside(checked)
    file.write_text(file.read_text().replace('"angle": true', '"angle": false'))
    refused = CliRunner().invoke(app, ["run", str(checked)]).exception
    assert isinstance(refused, ConfigError)
    assert str(refused) == f"{file}: must be of the model as it is now; run rti-mpc check {checked}, and copy the file to the guard"
    file.unlink()
    assert CliRunner().invoke(app, ["run", str(checked)]).exit_code == 0


def test_file_is_written_only_where_it_differs_and_a_disk_that_is_full_is_one_line(checked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, signals = signals_file.file_beside(checked), build_signals(load(checked))

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert signals_file.write(checked, signals) == file
    file.write_text("{}")
    with pytest.raises(
        ConfigError,
        match=rf"^{file} must be a file that can be written, a guard reads the model's signals there: No space left on device; check a copy",
    ):
        signals_file.write(checked, signals)
    assert json.loads(file.read_text()) == {}, "what was there is not destroyed"
