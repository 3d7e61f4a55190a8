# SPDX-License-Identifier: Apache-2.0
"""What differs from stage to stage, in a robot's file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rti_mpc.control.tuning import Tuning
from rti_mpc.errors import ConfigError
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.info import Info
from rti_mpc_service.config.build import build_ocp, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.controller.params import changed_problem
from rti_mpc_service.description import controller_info
from rti_mpc_service.replay.plan import cost_terms

FILE = """
robot = "r"
model = { name = "pioneer_3dx" }
params.live = true
ocp.N = 4
ocp.blocks = [1, 1, 2]
ocp.dt_s = 0.1
ocp.weights = { Q = { x = 1, y = 2, psi = 0.1 }, R = { u_c = 1, omega_c = 3 }, delta = [1, 2, 3, 4], lambda = 0.5, R_u = { omega_c = 0.1 } }
ocp.bounds = { inputs = { u_c = [-0.5, 0.5], omega_c = [-0.7, 0.7] }, states = { u = [-0.6, 0.6] } }
[ocp.stages]
delta = { x = [1, 0, 1, 2] }
lambda = { omega_c = [1, 2, 4] }
R_u = { u_c = [0, 0.5, 2] }
inputs = { u_c = [[-0.5, 0.4], [-0.5, 0.3], [-0.8, 0.2]] }
increments = { u_c = [[-0.2, 0.3], [-0.2, 0.3], [-inf, inf]] }
states = { omega = [[-inf, inf], [-0.6, 0.6], [-0.5, 0.5], [-0.4, 0.4]] }
soft_weight = { u = [0, 1, 2, 50] }
"""


def written(tmp_path: Path, text: str = FILE) -> Config:
    path = tmp_path / "robot.toml"
    path.write_text(text)
    return load(path)


def test_tables_of_stages_scale_weights_and_narrow_bounds(tmp_path: Path) -> None:
    config = written(tmp_path)
    ocp = build_ocp(config)
    np.testing.assert_array_equal(ocp.delta, [[1, 1, 1], [0, 2, 2], [3, 3, 3], [8, 4, 4]])
    np.testing.assert_array_equal(ocp.lambda_, [[0.5, 0.5], [0.5, 1.0], [0.5, 2.0]])
    np.testing.assert_array_equal(ocp.R_u, [[0.0, 0.1], [0.5, 0.1], [2.0, 0.1]])
    np.testing.assert_array_equal(ocp.ubu, [[0.4, 0.7], [0.3, 0.7], [0.2, 0.7]])
    np.testing.assert_array_equal(ocp.lbu[:, 0], [-0.5, -0.5, -0.5])  # no wider than the robot's own
    np.testing.assert_array_equal(ocp.lbdu[:, 0], [-0.2, -0.2, -np.inf])
    np.testing.assert_array_equal(ocp.z[:, 3:], [[0, 1000], [1, 1000], [2, 1000], [50, 1000]])
    np.testing.assert_array_equal([*ocp.Z, *ocp.zddu], 1000.0)
    np.testing.assert_array_equal(ocp.ubx[:, 3:], [[0.6, np.inf], [0.6, 0.6], [0.6, 0.5], [0.6, 0.4]])
    assert robot_settings(config)["ubu"] == [0.5, 0.7], "the robot itself keeps the bounds of all stages"
    told = Info.from_json({"role": "controller", **controller_info(ocp, 0)})
    assert told.weights is not None
    assert told.weights.delta == tuple(map(tuple, ocp.delta.tolist()))
    assert told.weights.lambda_ == tuple(map(tuple, ocp.lambda_[ocp.held].tolist()))
    assert told.ubu == (0.4, 0.7)


def test_cost_by_term_has_the_slack_weights_of_each_stage(tmp_path: Path) -> None:
    narrow = "terminal = { u = [-0.1, 0.1] }, states = { u = [-0.6, 0.2] }"
    config = written(tmp_path, FILE.replace("states = { u = [-0.6, 0.6] }", narrow, 1))
    rti = Rti(build_ocp(config), compile=False)
    x = np.array([0.0, 0.0, 0.0, 0.45, 0.0])  # m/s, faster than it may be
    rti.reset(x, np.zeros(2))
    rti.prepare(np.zeros((4, 3)))
    assert rti.feedback(x).usable
    terms = cost_terms(rti, config)
    assert terms["bounds of u"] > 0.1  # 0.44
    assert sum(terms.values()) == pytest.approx(rti.cost, rel=1e-9)


def test_weights_are_changed_while_it_runs_and_tables_of_stages_are_not(tmp_path: Path) -> None:
    config = written(tmp_path)
    ocp = build_ocp(config)
    tuning = Tuning(Rti(ocp, compile=False))
    tuning.change(changed_problem(config, ocp, {"ocp.weights.R.u_c": 2.0, "ocp.bounds.inputs.u_c": [-0.3, 0.3]})[1], 1)
    np.testing.assert_array_equal(tuning.wanted.ubu[:, 0], [0.3, 0.3, 0.2])
    tuning.change(changed_problem(config, ocp, {"ocp.bounds.soft_weight": 7.0})[1], 2)
    np.testing.assert_array_equal(tuning.wanted.z[:, 3:], [[0, 7], [1, 7], [2, 7], [50, 7]])
    with pytest.raises(ConfigError, match=r"ocp\.stages\.delta\.x"):
        changed_problem(config, ocp, {"ocp.stages.delta.x": [1, 1, 1, 1]})


@pytest.mark.parametrize(
    ("given", "wrong", "told"),
    [
        ("x = [1, 0, 1, 2]", "x = [1, 2]", r"ocp\.stages\.delta\.x must be a list of 4, one per stage, got 2"),
        ("[1, 2, 4]", "[1, 2, 4, 8]", r"ocp\.stages\.lambda\.omega_c must be a list of 3, one per block of inputs, got 4"),
        ("[0, 0.5, 2]", "[0, 0.5]", r"ocp\.stages\.R_u\.u_c must be a list of 3, one per block of inputs, got 2"),
        ("[0, 0.5, 2]", "[0, 0.5, -2]", r"ocp\.stages\.R_u\.u_c"),
        (
            "u_c = [0, 0.5, 2]",
            "omega_c = [0, 0.5, 2]",
            r"ocp\.stages\.R_u has the weights of omega_c in each block, which ocp\.weights\.R_u must",
        ),
        ("x = [1, 0, 1, 2]", "z = [1, 0, 1, 2]", r"ocp\.stages\.delta\.z"),
        ("[-0.5, 0.4], ", "", r"ocp\.stages\.inputs\.u_c must be a list of 3, one per block of inputs, got 2"),
        ("[-0.5, 0.4]", "[0.4, -0.5]", r"ocp\.stages\.inputs\.u_c.* must be \[lower, upper\]"),
        ("[0, 1, 2, 50]", "[0, 1, 2]", r"ocp\.stages\.soft_weight\.u must be a list of 4, one per stage, got 3"),
        ("u = [0, 1, 2, 50]", "psi = [0, 1, 2, 50]", r"ocp\.stages\.soft_weight\.psi must be left out, or psi bounded"),
        ("u = [0, 1, 2, 50]", "v = [0, 1, 2, 50]", r"ocp\.stages\.soft_weight\.v .*"),
        ("x = [1, 0, 1, 2]", "x = 3", r"ocp\.stages\.delta\.x"),
        ("[-0.2, 0.3], [-inf, inf]", "[0.2, 0.3], [-inf, inf]", r"ocp\.stages\.increments\.u_c.* must hold lower < 0 < upper"),
    ],
)
def test_wrong_table_of_stages_is_refused_by_its_key(tmp_path: Path, given: str, wrong: str, told: str) -> None:
    assert given in FILE
    with pytest.raises(ConfigError, match=told):
        written(tmp_path, FILE.replace(given, wrong))
