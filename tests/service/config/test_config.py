# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.rti.qp.osqp import Solver
from rti_mpc.rti.qp.qpsolvers import ForeignSolver
from rti_mpc.rti.terminal import lqr_weight
from rti_mpc.wire.bus import BusSettings
from rti_mpc_service.check import check
from rti_mpc_service.config import toml
from rti_mpc_service.config.build import (
    build_model,
    build_observer,
    build_ocp,
    build_rti,
    build_signals,
    bus_settings,
    guard_limits,
    robot_settings,
    solver_settings,
    stage_parameters,
)
from rti_mpc_service.config.config import load
from rti_mpc_service.config.fit import check_period, check_stop
from rti_mpc_service.config.schema import Config
from rti_mpc_service.controller import daemon
from rti_mpc_service.demo import demo
from rti_mpc_service.entry import status_of
from rti_mpc_service.faults import run as faults
from rti_mpc_sim.settings import RobotSettings

ROOT = Path(__file__).parents[3]
SHIPPED = ROOT / "deploy" / "pioneer_3dx.toml"
MINIMAL = """
robot = "r"
model = { name = "pioneer_3dx" }
ocp.N = 3
ocp.dt_s = 0.1
ocp.integrator = "euler"
ocp.weights = { Q = { x = 1, y = 2, psi = 0 }, R = { u_c = 1, omega_c = 3 }, delta = [1, 2, 3], lambda = 0.5 }
"""

pytestmark = pytest.mark.usefixtures("interpreted")

HERE = "tests.service.config.test_config"
DISC = "[[ocp.obstacles]]\ncentre_m = [1.0, 0.5]\n"
OBSERVED = "[observer.disturbances]\nx = { "

# What a user may write into the shipped file, and what the one line must tell them.
WRONG = [
    ("[ocp]", "[solver]\niterations = 0\n[ocp]", ["solver.iterations", "at least 1", "0"]),
    ("dt_s = 0.1", "dt_ms = 100", ["ocp.dt_ms", "dt_s", "in seconds", "100"]),
    ("dt_s = 0.1", "dt_s = 100.0", ["ocp.dt_s", "in seconds", "at most 10", "100.0"]),
    ("dt_s = 0.1", 'dt_s = "0.1"', ["ocp.dt_s", "must be a number", "'0.1'"]),
    ("dt_s = 0.1", "dt_s = nan", ["ocp.dt_s", "finite", "nan"]),
    ("dt_s = 0.1", "", ["ocp.dt_s", "missing", "in seconds"]),
    ("N = 20", "N = 20.5", ["ocp.N", "whole number", "20.5"]),
    ("N = 20", "N = true", ["ocp.N", "whole number", "True"]),
    ("N = 20", "N = 20\nblocks = [1, 2, 18]", ["ocp.blocks", "ocp.N = 20", "21 in [1, 2, 18]"]),
    ("N = 20", "N = 20\nblocks = [20, 0]", ["ocp.blocks", "at least 1", "0"]),
    ("N = 20", "N = 20\nblocks = []", ["ocp.blocks", "at least 1"]),
    ("N = 20", "N = 20\nN_u = 2\nblocks = [1, 19]", ["ocp", "N_u or blocks, not both"]),
    ("N = 20", "N = 20\nN_u = 21", ["ocp.N_u", "at most ocp.N = 20", "21"]),
    ("N = 20", "N = 20\nstale_s = 0.1", ["ocp.stale_s", "timing.stale_s"]),
    ("N = 20", "N = 20\nhorizon = 7", ["ocp.horizon", "N, N_u, blocks, dt_s"]),
    ("N = 20", "n = 20", ["ocp.n is unknown", "perhaps ocp.N is meant", "in stages", "20"]),
    ('integrator = "rk4"', 'integrator = "rk4"\nsim_method_num_stages = 3', ["ocp.sim_method_num_stages", 'ocp.integrator be "irk"', "3"]),
    ('integrator = "rk4"', 'integrator = "rk5"', ["ocp.integrator", "'rk4', 'euler' or 'irk'", "'rk5'"]),
    ("psi = 0.05", "psi = -0.05", ["ocp.weights.Q.psi", "at least 0", "-0.05"]),
    ("psi = 0.05", "phi = 0.05", ["ocp.weights.Q.phi", "no output", "psi [rad]"]),
    (", psi = 0.05", "", ["ocp.weights.Q", "psi [rad]", "missing"]),
    ("delta = 28.0", "delta = [28.0, 28.0]", ["ocp.weights.delta", "20", "[28.0, 28.0]"]),
    ("delta = 28.0", "delta = [28.0, -1.0]", ["ocp.weights.delta[1]", "at least 0", "-1.0"]),
    ("lambda = 0.8", "lamda = 0.8", ["ocp.weights.lamda", "ocp.weights.lambda", "0.8"]),
    ("u_c = [-0.5, 0.5]", "u_c = 0.5", ["ocp.bounds.inputs.u_c", "[lower, upper]", "0.5"]),
    ("u_c = [-0.5, 0.5]", "u_c = [0.5, -0.5]", ["ocp.bounds.inputs.u_c", "lower < upper", "[0.5, -0.5]"]),
    ("u_c = [-0.5, 0.5]", "u_c = [nan, 0.5]", ["ocp.bounds.inputs.u_c", "nan"]),
    ("u_c = [-0.25, 0.25]", "u_c = [0.1, 0.25]", ["ocp.bounds.increments.u_c", "lower < 0 < upper", "0.1"]),
    ("u_c = [-0.25, 0.25]", "u_c = [0.0, 0.25]", ["ocp.bounds.increments.u_c", "lower < 0 < upper", "brought to rest"]),
    ("u_c = [-0.5, 0.5]", "u_c = [0.2, 0.3]", ["ocp.bounds", "bounds of input u_c must hold its rest, 0 m/s", "[0.2, 0.3]"]),
    ("omega_c = [-0.745, 0.745]", "omega_c = [-inf, -0.1]", ["input omega_c must hold its rest, 0 rad/s", "[-inf, -0.1]"]),
    ("u_c = [-0.5, 0.5]", "u_c = [inf, inf]", ["ocp.bounds.inputs.u_c", "lower < upper"]),
    ('name = "pioneer_3dx"', 'name = "pioneer_4dx"', ["model.name", "pioneer_4dx", "pioneer_3dx"]),
    ('robot = "pioneer"', 'robot = "two words"', ["robot", "letters, digits", "'two words'"]),
    ('robot = "pioneer"', "robot = 3", ["robot", "must be text", "3"]),
    ("[ocp]", "[bus]\nconnect = ['127.0.0.1:7447']\n[ocp]", ["bus.connect[0]", "tcp/127.0.0.1:7447", "'127.0.0.1:7447'"]),
    ("[ocp]", "[bus]\nconfig = 'none.json5'\n[ocp]", ["bus.config", "file", "none.json5"]),
    ("[ocp]", "[sim]\nx0 = { z = 1.0 }\n[ocp]", ["sim.x0.z", "no state", "x [m]"]),
    ("[ocp]", "[sim]\nparameters = { theta_7 = 1.0 }\n[ocp]", ["sim.parameters.theta_7", "no parameter", "theta_6"]),
    ("[ocp]", "[observer.disturbances]\nv = { drift = 0.1, limit = 0.2 }\n[ocp]", ["observer.disturbances.v", "no input or state", "u_c [m/s]"]),
    ("[ocp]", "[observer.disturbances]\nu_c = { drift = 0.0, limit = 0.2 }\n[ocp]", ["observer.disturbances.u_c.drift", "greater than 0", "0.0"]),
    ("[ocp]", "[observer.disturbances]\nu_c = { drift = 0.1 }\n[ocp]", ["observer.disturbances.u_c.limit", "missing"]),
    ("[ocp]", "[observer]\nmeasured = ['x', 'z']\n[ocp]", ["observer.measured.z", "no state", "x [m]"]),
    ("[ocp]", "[guard]\ntick_s = 0.1\n[ocp]", ["guard.tick_s", "at most 0.01", "0.1"]),
    ("[ocp]", '[guard]\nstates = ["x", "y", "psi", "omega", "u"]\n[ocp]', ["guard.states is unknown"]),
    ("[ocp]", "[solver]\nname = 'dapq'\n[ocp]", ["solver.name", "'dapq'", "riccati, osqp", "daqp", "pip install 'qpsolvers[NAME]'"]),
    ("[ocp]", "[solver]\nname = 'daqp'\nrho = 2.0\n[ocp]", ["solver.rho", "osqp", "'daqp'", "2.0"]),
    ("soft_weight = 1e3", "soft_weight = -1.0", ["ocp.bounds.soft_weight", "L1", "at least 0", "-1.0"]),
    ("soft_weight = 1e3", "soft_weight_l2 = 1.0", ["ocp.bounds.soft_weight_l2", "soft_weight_L2"]),
    ("soft_weight = 1e3", "constraints = { power = [0, 1] }", ["ocp.bounds.constraints.power", "no constraint", "none"]),
    ("[ocp.bounds]", "[ocp.terminal]\nQ = { x = 1.0, y = 1.0 }\n[ocp.bounds]", ["ocp.terminal.Q", "psi [rad]", "missing"]),
    ("[ocp.bounds]", "[ocp.terminal]\nQ = { x = 1.0, y = -1.0 }\n[ocp.bounds]", ["ocp.terminal.Q.y", "at least 0", "-1.0"]),
    ("[ocp.bounds]", "[ocp.terminal]\nlqr.states = { v = 0.2 }\n[ocp.bounds]", ["ocp.terminal.lqr.states.v", "no state", "u [m/s]"]),
    ("[ocp.bounds]", "[ocp.terminal]\nlqr = {}\n[ocp.bounds]", ["stabilizable", "terminal weight"]),
    ("[ocp.bounds]", "[ocp.terminal]\nlqr = {}\nQ = { x = 1, y = 1, psi = 0 }\n[ocp.bounds]", ["ocp.terminal", "Q or lqr, not both"]),
    ("[model]", DISC + "radius_m = -0.3\n[model]", ["ocp.obstacles[0].radius_m", "in m", "greater than 0", "-0.3"]),
    ("[model]", DISC + "[model]", ["ocp.obstacles[0].radius_m", "missing", "in m"]),
    ("[model]", DISC + "radius = 0.3\n[model]", ["ocp.obstacles[0].radius", "perhaps ocp.obstacles[0].radius_m is meant (radius", "in m"]),
    ("[model]", DISC + "radius_m = 0.3\nvelocity_m_s = 0.1\n[model]", ["ocp.obstacles[0].velocity_m_s", "[x, y]", "m/s", "0.1"]),
    ("[model]", DISC + "radius_m = 0.3\nmargin_m = -0.1\n[model]", ["ocp.obstacles[0].margin_m", "in m", "at least 0", "-0.1"]),
    (
        "[model]",
        DISC.replace("0.5]", "0.5, 0.1]") + "radius_m = 0.3\n[model]",
        ["ocp.obstacles[0].centre_m", "[x, y], two numbers", "0.1]"],
    ),
    ("[model]", "[ocp.obstacles]\nradius_m = 0.3\n[model]", ["must be a list of tables, each with centre_m, radius_m,", ": [[ocp.obstacles]], got"]),
    ("[model]", "guard = true\n[model]", ["guard", "must be a table with enabled, tick_s, got True"]),
    ("[model]", OBSERVED + "limit = 0.4, std = 0.1 }\n[model]", ["observer.disturbances.x.std is unknown, known: drift, limit, got 0.1"]),
    ("[model]", OBSERVED + "limit = 0.4 }\n[model]", ["observer.disturbances.x.drift is missing: intensity of its random walk, in"]),
    ("[model]", OBSERVED + "limt = 0.4 }\n[model]", ["perhaps observer.disturbances.x.limit is meant (largest magnitude"]),
    ("[model]", "[observer]\ndrift = 0.1\n[model]", ["perhaps observer.disturbances.NAME.drift is meant (intensity"]),
    ("[model]", "[observer]\ndisturbances = 0.1\n[model]", ["must be a table of tables by name, each with drift, limit, got 0.1"]),
    ("[model]", "[observer.disturbances]\ndrift = 0.1\n[model]", ["observer.disturbances.drift", "must be a table with drift, limit, got 0.1"]),
    ("[model]", DISC + "radius_m = inf\n[model]", ["ocp.obstacles[0].radius_m", "in m", "finite", "inf"]),
    ("[ocp.bounds]", "[ocp.obstacles]\nradius_m = 0.3\n[ocp.bounds]", ["ocp.obstacles", "discs to stay out of", "list"]),
    ('name = "pioneer_3dx"', 'name = "nowhere:car"', ["model.name", "nowhere", "package.module:function"]),
    ('name = "pioneer_3dx"', 'name = "tests.robots:glidr"', ["model.name", "has no function glidr", "perhaps glider is meant"]),
    ('name = "pioneer_3dx"', 'name = "tests.robots"', ["model.name", "package.module:function", "'tests.robots'"]),
    (
        'name = "pioneer_3dx"',
        f'name = "{HERE}:raising"',
        ["model.name", "it raised ValueError", "test_config.py, line", "no wheels"],
    ),
    ('name = "pioneer_3dx"', f'name = "{HERE}:of_numbers"', ["model.name", "model numbers: x must consist of symbols"]),
    ('name = "pioneer_3dx"', f'name = "{HERE}:nothing"', ["model.name", "must return a rti_mpc.Model, got NoneType"]),
    ('name = "pioneer_3dx"', f'name = "{HERE}:singular"', ["model.name", "x_nominal must be a state at which model pioneer_3dx is finite"]),
    (
        'name = "pioneer_3dx"',
        f'name = "{HERE}:stiff"',
        ["ocp.dt_s", "at most 0.000278 s", "stiff: omega settles with a time constant of 0.0001"],
    ),
    ('name = "pioneer_3dx"', f'name = "{HERE}:nowhere_finite"', ["model.name", "give one, x_nominal, got none, and none was found"]),
    ('name = "pioneer_3dx"', "parameters = { a = 0.1 }", ["model.name", "missing", "a shipped model"]),
    ('name = "pioneer_3dx"', 'name = "pioneer_3dx"\nparameters = { b = 1.0 }', ["model.parameters.b", "no parameter", "theta_1 [s]"]),
    ('name = "pioneer_3dx"', 'name = "pioneer_3dx"\nparameters = { a = "0.1" }', ["model.parameters.a", "must be a number", "'0.1'"]),
    ('name = "pioneer_3dx"', 'name = "pioneer_3dx"\nstop = "brakes"', ["model.stop", "'rests' or 'coasts'", "'brakes'"]),
    ("N = 20", "N = 1001", ["ocp.N", "in stages", "at most 1000", "1001"]),
    ("N = 20", "N = 20\nN_u = 0", ["ocp.N_u", "at least 1", "0"]),
    ("N = 20", 'N = 20\nformulation = "condensed"', ["ocp.formulation", "'auto', 'simultaneous' or 'sequential'", "'condensed'"]),
    ("dt_s = 0.1", "dt_s = [0.1]", ["ocp.dt_s", "must be a number", "[0.1]"]),
    ("delta = 28.0", 'delta = "28"', ["ocp.weights.delta (", "must be a number", "'28'"]),
    ("lambda = 0.8", "lambda = [0.8, 0.8, 0.8]", ["ocp.weights.lambda", "list of 20", "[0.8, 0.8, 0.8]"]),
    ("u_c = [-0.5, 0.5]", "u_c = [-0.5, 0.0, 0.5]", ["ocp.bounds.inputs.u_c", "two numbers", "[-0.5, 0.0, 0.5]"]),
    ("u_c = [-0.5, 0.5]", "v_c = [-0.5, 0.5]", ["ocp.bounds.inputs.v_c", "no input", "perhaps u_c [m/s]"]),
    ("omega_c = [-0.40, 0.40]", "omega_c = 0.4", ["ocp.bounds.increments.omega_c", "[lower, upper]", "0.4"]),
    ("u = [-0.5, 0.5]", "u = [0.5, 0.5]", ["ocp.bounds.states.u", "lower < upper", "[0.5, 0.5]"]),
    ("u = [-0.5, 0.5]", "speed = [-0.5, 0.5]", ["ocp.bounds.states.speed", "no state", "u [m/s]"]),
    ("soft_weight = 1e3", "soft_weight = true", ["ocp.bounds.soft_weight", "must be a number", "True"]),
    ("[ocp.bounds]", "[ocp.terminal]\nlqr.inputs = { v = 0.2 }\n[ocp.bounds]", ["ocp.terminal.lqr.inputs.v", "no input", "u_c [m/s]"]),
    ("[ocp]", "[solver]\nsecond_opinion = -1\n[ocp]", ["solver.second_opinion", "at least 0", "-1"]),
    ("[ocp]", "[solver]\nsecond_opinion = true\n[ocp]", ["solver.second_opinion", "whole number", "True"]),
    ("[ocp]", "[solver]\neps = 0.0\n[ocp]", ["solver.eps", "at least 0.000000000001", "0.0"]),
    ("[ocp]", "[solver]\nmax_iter = 1.5\n[ocp]", ["solver.max_iter", "whole number", "1.5"]),
    ("[ocp]", "[solver]\niterations = 101\n[ocp]", ["solver.iterations", "at most 100", "101"]),
    ("[ocp]", "[solver]\ntolerance = -0.1\n[ocp]", ["solver.tolerance", "at least 0", "-0.1"]),
    ("[ocp]", "[solver]\nname = ['osqp']\n[ocp]", ["solver.name", "must be text", "['osqp']"]),
    ("[ocp]", "[timing]\ndelay_s = 'auto'\n[ocp]", ["timing.delay_s (", "must be a number or 'measured'", "'auto'"]),
    ("[ocp]", "[timing]\ndelay_s = -0.01\n[ocp]", ["timing.delay_s (", "at least 0 or 'measured'", "-0.01"]),
    ("[ocp]", "[timing]\nvalid_s = 0.5\n[ocp]", ["timing.valid_s", "in seconds", "at most 0.3", "0.5"]),
    ("[ocp]", "[timing]\nstale_s = 0\n[ocp]", ["timing.stale_s", "at least 0.0001", "0"]),
    (
        "[ocp]",
        "[timing]\nstale_s = 0.3\n[ocp]",
        ["timing.stale_s must be at most 0.225 s, 0.025 s less than timing.valid_s = 0.25 s", "got 0.3 s: lower it, or leave it out"],
    ),
    ("[ocp]", "[timing]\nstale_s = 0.23\n[ocp]", ["timing.stale_s must be at most 0.225 s", "got 0.23 s"]),
    ("[ocp]", "[timing]\nstale_s = 0.12\nvalid_s = 0.13\n[ocp]", ["timing.stale_s must be at most 0.105 s", "timing.valid_s = 0.13 s", "got 0.12 s"]),
    (
        "[ocp]",
        "[timing]\nstale_s = 0.05\n[ocp]",
        ["timing.stale_s must be at least 0.1 s", "ocp.dt_s where sim.state_period_s is left out", "got 0.05 s: raise it, or say"],
    ),
    (
        "[ocp]",
        "[timing]\nstale_s = 0.05\n[sim]\nstate_period_s = 0.06\n[ocp]",
        ["sim.state_period_s must be at most timing.stale_s = 0.05 s", "got 0.06 s"],
    ),
    ("[ocp]", "[sim]\nstate_period_s = 0.3\n[ocp]", ["sim.state_period_s must be at most timing.stale_s, left out, = 0.225 s", "got 0.3 s"]),
    ("[ocp]", "[observer]\nmeasured = 'x'\n[ocp]", ["observer.measured", "states that are measured", "list", "'x'"]),
    ("[ocp]", "[observer]\nnoise = { x = 0.0 }\n[ocp]", ["observer.noise.x", "greater than 0", "0.0"]),
    ("[ocp]", "[observer]\nprocess = { w = 0.1 }\n[ocp]", ["observer.process.w", "no state", "x [m]"]),
    ("[ocp]", "[guard]\nenabled = 'yes'\n[ocp]", ["guard.enabled", "must be true or false", "'yes'"]),
    ("live = false", "live = 1", ["params.live", "must be true or false", "1"]),
    ("[ocp]", "[bus]\nmode = 'router'\n[ocp]", ["bus.mode", "'peer' or 'client'", "'router'"]),
    ("[ocp]", "[bus]\nconnect = 'tcp/127.0.0.1:7447'\n[ocp]", ["bus.connect", "list", "'tcp/127.0.0.1:7447'"]),
    ("[ocp]", "[realtime]\npriority = 100\n[ocp]", ["realtime.priority", "at most 99", "100"]),
    ("[ocp]", "[realtime]\ncores = [-1]\n[ocp]", ["realtime.cores[0]", "at least 0", "-1"]),
    ("[ocp]", "[sim]\nsubsteps = 0\n[ocp]", ["sim.substeps", "at least 1", "0"]),
    ("[ocp]", "[sim]\ndropout = 1.0\n[ocp]", ["sim.dropout", "less than 1", "1.0"]),
    ("[ocp]", "[sim]\nnoise_std = { x = -0.1 }\n[ocp]", ["sim.noise_std.x", "at least 0", "-0.1"]),
    ("[ocp]", "[sim]\nseed = 1.0\n[ocp]", ["sim.seed", "whole number", "1.0"]),
    ("[ocp]", "[sim]\nactuator_lag_s = 11.0\n[ocp]", ["sim.actuator_lag_s", "in seconds", "at most 10", "11.0"]),
    ('robot = "pioneer"', 'robot = "pioneer"\nprefix = "/fleet"', ["prefix", "first part of all keys", "'/fleet'"]),
    ('robot = "pioneer"', "", ["robot", "missing", "the robot's name in keys"]),
    ("[model]", "[modle]", ["modle", "model"]),
    ("[model]", "[model", ["TOML", "line"]),
]


def raising() -> Model:
    """A function of a user's that fails."""
    raise ValueError("no wheels\non this robot")


def nothing() -> None:
    """A function of a user's that returns no model."""


def of_numbers() -> Model:
    """A model without symbols."""
    return Model("numbers", x=[1.0], u=ca.SX.sym("u"), f_expl_expr=0.0, y_expr=0.0, states="x", inputs="u", outputs="x")  # type: ignore[arg-type]


def singular() -> Model:
    """The robot, its nominal state where its speed has no root."""
    model = pioneer_3dx()
    return replace(model, f_expl_expr=model.f_expl_expr * ca.sqrt(model.x[3]), x_nominal=(0.0, 0.0, 0.0, -1.0, 0.0))


def nowhere_finite() -> Model:
    """The robot, with a root of what is never positive."""
    model = pioneer_3dx()
    return replace(model, f_expl_expr=model.f_expl_expr * ca.sqrt(-1.0 - model.x[3] ** 2))


def stiff() -> Model:
    """The robot, its rate of turn at once what is commanded, nearly."""
    model = pioneer_3dx()
    rates = ca.vertsplit(model.f_expl_expr)
    return replace(model, f_expl_expr=ca.vertcat(*rates[:4], 1e4 * (model.u[1] - model.x[4])))


def loaded(folder: Path, text: str, *, with_model: bool = True) -> Config:
    path = folder / "robot.toml"
    path.write_text(text)
    return load(path, with_model=with_model)


@pytest.mark.parametrize(("right", "wrong", "told"), WRONG, ids=[wrong.replace("\n", " ") or f"no {right}" for right, wrong, _ in WRONG])
def test_wrong_value_is_refused_in_one_line_that_says_what_would_be_right(
    right: str, wrong: str, told: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = SHIPPED.read_text()
    assert right in text
    path = tmp_path / "robot.toml"
    path.write_text(text.replace(right, wrong, 1))
    assert status_of([lambda: load(path)]) == 2, "as the command line does, which systemd does not restart"
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"rti-mpc: {path}: ")
    for words in told:
        assert words in line, line


def test_file_that_is_not_there_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=re.escape(str(tmp_path / "none.toml"))):
        load(tmp_path / "none.toml")


def test_blocks_of_held_inputs_are_those_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(
        SHIPPED.read_text().replace("N = 20", "N = 20\nblocks = [1, 1, 2, 4, 12]", 1).replace("lambda = 0.8", "lambda = [5, 4, 3, 2, 1]", 1)
    )
    ocp = build_ocp(load(path))
    assert (ocp.blocks, ocp.N_u) == ((1, 1, 2, 4, 12), 5)
    np.testing.assert_array_equal(ocp.lambda_, [5, 4, 3, 2, 1])
    path.write_text(path.read_text().replace("lambda = [5, 4, 3, 2, 1]", "lambda = [5, 4]"))
    with pytest.raises(ConfigError, match=r"ocp\.weights\.lambda must be a number or a list of 5, one per block, got \[5\.0, 4\.0\]"):
        load(path)


def test_configuration_becomes_the_ocp_it_describes(tmp_path: Path) -> None:
    ocp = build_ocp(loaded(tmp_path, MINIMAL))
    assert (ocp.N, ocp.N_u, ocp.dt, ocp.method) == (3, 3, 0.1, "euler")
    np.testing.assert_array_equal(np.diag(ocp.Q), [1, 2, 0])
    np.testing.assert_array_equal(np.diag(ocp.R), [1, 3])
    np.testing.assert_array_equal(ocp.delta, [1, 2, 3])
    np.testing.assert_array_equal(ocp.lambda_, [0.5, 0.5, 0.5])
    assert np.all(np.isinf(ocp.ubu)), "a bound left out is no bound"


def test_integrator_of_the_file_is_that_of_problem_observer_and_simulated_robot(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    irk = 'ocp.integrator = "irk"\nocp.sim_method_num_stages = 3\nocp.sim_method_num_steps = 2\n'
    disturbed = "[observer.disturbances.u_c]\ndrift = 0.1\nlimit = 0.1\n"
    path.write_text(MINIMAL.replace('ocp.integrator = "euler"\n', irk) + disturbed)
    config = load(path)
    observer = build_observer(config)
    assert observer is not None
    assert build_ocp(config).method == "irk"
    for model in (build_ocp(config).model, observer.model, robot_settings(config)["model"]):
        assert (model.method, model.sim_method_num_stages, model.sim_method_num_steps) == ("irk", 3, 2)


def test_equal_bounds_fix_an_input_and_a_terminal_set_bounds_the_end_alone(tmp_path: Path) -> None:
    ocp = build_ocp(loaded(tmp_path, MINIMAL + "[ocp.bounds]\ninputs = { u_c = [0, 0], omega_c = [-1, 1] }\nterminal = { omega = [-0.1, inf] }\n"))
    assert (ocp.lbu.tolist(), ocp.ubu.tolist()) == ([0.0, -1.0], [0.0, 1.0])
    assert (ocp.lbx_e.tolist(), ocp.ubx_e.tolist()) == ([-math.inf] * 4 + [-0.1], [math.inf] * 5)


def test_weights_of_inputs_count_from_their_references(tmp_path: Path) -> None:
    ocp = build_ocp(loaded(tmp_path, MINIMAL.replace("delta =", "R_u = { u_c = 0.5 }, u_ref = { u_c = 0.2 }, delta =")))
    assert ocp.R_u.tolist() == [0.5, 0.0]
    np.testing.assert_array_equal(np.array(ca.DM(ocp.u_ref)).ravel(), [0.2, 0.0])


def test_softened_bounds_constraints_and_obstacles_become_those_of_the_ocp(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    bounds = "[ocp.bounds]\nstates = { u = [-1, 1] }\nconstraints = { power = [-inf, 0.1] }\nsoft_weight = 5.0\nsoft_weight_L2 = 6.0\n"
    path.write_text(MINIMAL.replace("pioneer_3dx", "tests.service.config.test_config:limited") + bounds + DISC + "radius_m = 0.3\nmargin_m = 0.2\n")
    ocp = build_ocp(load(path))
    assert ocp.h_expr.numel() == 2, "the constraint that is bounded, and the disc"
    h = ca.Function("h", [ocp.model.x, ocp.model.u, ocp.model.p], [ocp.h_expr])
    value = np.array(h([1.0, 0.0, 0.0, 0.4, 0.0], [0.5, 0.0], ocp.model.p_nominal)).ravel()
    np.testing.assert_allclose(value, [0.2, 0.0], rtol=0, atol=1e-8)  # 0.4 * 0.5; half a metre from the centre is where the disc begins
    np.testing.assert_array_equal(ocp.lh, [-math.inf, 0.0])
    np.testing.assert_array_equal(ocp.uh, [0.1, math.inf])
    for l1, l2 in ((ocp.z, ocp.Z), (ocp.zh, ocp.Zh)):
        assert set(l1) == {5.0}
        assert set(l2) == {6.0}


def limited() -> Model:
    """The paper's robot, which says how much power it takes."""
    model = pioneer_3dx()
    power, other = model.x[3] * model.u[0], model.x[4]
    return replace(model, h_expr=ca.vertcat(other, power), constraints=(Signal("other", "rad/s"), Signal("power", "m^2/s^2")))


def test_terminal_weight_is_the_one_given_or_the_regulators(tmp_path: Path) -> None:
    given = loaded(tmp_path, MINIMAL + "[ocp.terminal]\nQ = { psi = 3.0, x = 1.0, y = 2.0 }\n")
    np.testing.assert_array_equal(np.diag(build_ocp(given).Q_e), [1, 2, 3])
    assert not build_ocp(loaded(tmp_path, MINIMAL)).Q_e.any()
    ocp = build_ocp(loaded(tmp_path, MINIMAL + "[ocp.terminal.lqr]\nstates = { u = 0.25 }\ninputs = { u_c = 0.25 }\n"))
    np.testing.assert_array_equal(ocp.Q_e, lqr_weight(ocp, np.array([0, 0, 0, 0.25, 0]), np.array([0.25, 0])))


def test_moving_obstacles_are_parameters_that_a_reference_carries_row_by_row(tmp_path: Path) -> None:
    discs = DISC + "radius_m = 0.3\n" + DISC + "radius_m = 0.2\nmargin_m = 0.1\n"
    assert stage_parameters(loaded(tmp_path, MINIMAL + discs), np.array([0.0, 2.0])).shape == (2, 0), "none moves: all nominal"
    config = loaded(tmp_path, MINIMAL + discs + "velocity_m_s = [0.0, -0.1]\n")
    rows, nominal = stage_parameters(config, np.array([0.0, 2.0])), build_ocp(config).model.p_nominal
    np.testing.assert_allclose(rows[0], nominal, rtol=1e-15)
    np.testing.assert_allclose(rows[1], [*nominal[:-2], 0.3, 0.3], rtol=1e-15)


@pytest.mark.parametrize("name", ["riccati", "osqp", "daqp"])
def test_solver_is_chosen_by_one_word(name: str, tmp_path: Path) -> None:
    config = loaded(tmp_path, MINIMAL + f'[solver]\nname = "{name}"\nsecond_opinion = 3\n')
    assert config.solver.second_opinion == 3, "of every one, as a number of iterations is"
    rti = build_rti(config)
    assert (rti.active_set is None) is (name != "riccati")
    assert isinstance(rti.solvers[0], Solver if name != "daqp" else ForeignSolver)


def test_bounds_go_to_the_signals_they_name_whatever_their_order() -> None:
    ocp = build_ocp(load(SHIPPED))
    np.testing.assert_array_equal(ocp.ubu, [0.5, 0.745])
    np.testing.assert_array_equal(ocp.lbdu, [-0.25, -0.40])
    np.testing.assert_array_equal(ocp.ubx, [math.inf, math.inf, math.inf, 0.5, 0.745])


def test_parameters_by_name_reach_the_model(tmp_path: Path) -> None:
    assert build_model(loaded(tmp_path, MINIMAL.replace('"pioneer_3dx"', '"pioneer_3dx", parameters = { a = 0.1 }'))).p_nominal[-1] == 0.1


OWN = """
import casadi as ca
from rti_mpc import Model, Signal

def robot():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    s = (Signal("s", "m"),)
    return Model(name="own", x=x, u=u, f_expl_expr=u, y_expr=x, states=s, inputs=(Signal("v", "m/s"),), outputs=s)
"""
OWN_TOML = """
robot = "own"
model = { name = "NAME" }
ocp = { N = 3, dt_s = 0.1, weights = { Q = { s = 1 }, R = { v = 1 } } }
"""


@pytest.mark.parametrize("name", ["my_robot:robot", "my_robot.py:robot"])
def test_model_is_found_beside_its_configuration_wherever_a_copy_of_that_is(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A demo leaves such a copy in a folder of its own, which its processes load."""
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "my_robot.py").write_text(OWN)
    path, copied = tmp_path / "own" / "robot.toml", tmp_path / "copied.toml"
    path.write_text(OWN_TOML.replace("NAME", name))
    monkeypatch.chdir(tmp_path)
    config = load(Path("own/robot.toml"))
    copied.write_text(toml.write(config))
    monkeypatch.chdir("/")
    for again in (load(path), load(copied)):
        assert build_model(again).name == "own"
        assert again.config_hash == config.config_hash == load(path, with_model=False).config_hash, "a standby may have it in another folder"


def test_folder_of_the_model_may_be_another_one(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "my_robot.py").write_text(OWN)
    path = tmp_path / "robot.toml"
    path.write_text(OWN_TOML.replace('"NAME"', '"my_robot:robot", folder = "models"'))
    assert build_model(load(path)).name == "own"
    path.write_text(OWN_TOML.replace("NAME", "my_robot:robot"))
    with pytest.raises(ConfigError, match=rf"model\.name: .* \(No module named 'my_robot', neither in {tmp_path} nor installed\)"):
        load(path)


def test_zenoh_file_is_found_beside_the_configuration(tmp_path: Path) -> None:
    (tmp_path / "zenoh.json5").write_text("{}")
    assert bus_settings(loaded(tmp_path, MINIMAL + '[bus]\nconfig = "zenoh.json5"\n')).config == tmp_path / "zenoh.json5"


def test_staleness_follows_the_period_within_limits(tmp_path: Path) -> None:
    stale_s = [loaded(tmp_path, MINIMAL.replace("dt_s = 0.1", f"dt_s = {dt_s}")).stale_s for dt_s in (0.01, 0.04, 0.2)]
    assert stale_s == [0.05, 0.1, 0.225]


def test_hash_follows_what_decides_a_command_and_nothing_else(tmp_path: Path) -> None:
    def config_hash(text: str) -> int:
        return loaded(tmp_path, text).config_hash

    reference = config_hash(MINIMAL)
    assert 0 <= reference < 2**64
    assert config_hash("# a comment\n" + MINIMAL.replace("x = 1, y = 2", "y = 2.0, x = 1.0")) == reference
    assert config_hash(MINIMAL + "[sim]\nseed = 2\n[bus]\nlisten = ['tcp/127.0.0.1:7448']\n[realtime]\npriority = 1\n") == reference
    assert config_hash(MINIMAL.replace("lambda = 0.5", "lambda = 0.6")) != reference


def test_every_field_says_what_it_is() -> None:
    def fields(schema: dict[str, object]) -> list[str]:
        found = []
        for section in (schema, *schema["$defs"].values()):  # type: ignore[attr-defined]
            found += [name for name, field in section["properties"].items() if "description" not in field]
        return found

    assert fields(Config.model_json_schema()) == []


def test_plant_takes_its_own_parameters_the_rest_from_the_controller(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(
        MINIMAL + "[sim]\nx0 = { psi = 1.5 }\nparameters = { theta_1 = 0.3 }\nseed = 4\n[ocp.bounds]\nincrements = { u_c = [-0.1, 0.2] }\n"
    )
    settings = RobotSettings(**robot_settings(load(path)))
    assert settings.model.p_nominal[0] == 0.3
    assert settings.seed == 4
    assert settings.state_period_s == 0.1
    np.testing.assert_array_equal(settings.x0, [0, 0, 1.5, 0, 0])
    np.testing.assert_allclose(settings.slew, [1.0, math.inf], rtol=1e-15)


def test_limits_of_iterations_reach_the_controller(tmp_path: Path) -> None:
    config = loaded(tmp_path, MINIMAL + "[solver]\niterations = 7\ntolerance = 1e-3\neps = 1e-4\n")
    rti = build_rti(config)
    assert (rti.iterations, rti.tolerance) == (7, 1e-3)
    assert solver_settings(config).eps == 1e-4


def test_guard_must_know_every_limit(tmp_path: Path) -> None:
    text = SHIPPED.read_text().replace(", omega_c = [-0.745, 0.745] }", " }")
    with pytest.raises(ConfigError, match=r"ocp\.bounds\.inputs must bound every input where a guard is enabled, omega_c is missing"):
        loaded(tmp_path, text + "\n[guard]\nenabled = true\n")
    loaded(tmp_path, text)  # nobody else minds


def test_limits_of_the_guard_are_those_of_the_problem_in_the_models_order(tmp_path: Path) -> None:
    bounds = "u_c = [-0.5, 0.5], omega_c = [-0.745, 0.745]"
    turned = SHIPPED.read_text().replace(bounds, "omega_c = [-0.745, 0.745], u_c = [-0.5, 0.5]")
    config = loaded(tmp_path, turned + "\n[guard]\nenabled = true\n")
    limits, ocp = guard_limits(config, build_signals(config)), build_ocp(config)
    for name in ("lbu", "ubu", "lbdu", "ubdu"):
        np.testing.assert_array_equal(getattr(limits, name), getattr(ocp, name))
    np.testing.assert_array_equal(limits.u_rest, ocp.model.u_rest)
    assert limits.rotations == ocp.model.rotations("states")
    np.testing.assert_allclose(limits.slew, [2.5, 4.0])
    assert limits.settling_s == pytest.approx(0.3 + 0.2)
    assert config.config_hash == load(SHIPPED).config_hash


def driven_by(forward: str) -> Model:
    """The robot, its forward speed changed by its input's acceleration, or by nothing."""
    model = pioneer_3dx()
    rates = ca.vertsplit(model.f_expl_expr)
    return replace(model, f_expl_expr=ca.vertcat(*rates[:3], model.u[0] if forward == "acceleration" else 0.0, rates[4]))


def accelerated() -> Model:
    return driven_by("acceleration")


def coasting() -> Model:
    return driven_by("nothing")


def with_model(name: str, folder: Path, stop: str = "rests") -> Config:
    named = SHIPPED.read_text().replace('"pioneer_3dx"', f'"{HERE}:{name}"')
    return loaded(folder, named.replace("[model]", f'[model]\nstop = "{stop}"'))


def test_stop_is_a_ramp_or_a_way_to_rest_that_the_model_leads_to(tmp_path: Path) -> None:
    assert check_stop(load(SHIPPED)) is None
    law = check_stop(with_model("accelerated", tmp_path))
    assert law is not None
    assert not law.holds
    assert check_stop(with_model("coasting", tmp_path, stop="coasts")) is None


def test_robot_that_a_stop_does_not_bring_to_rest_is_refused_with_where_that_is(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refusal:
        check_stop(with_model("coasting", tmp_path))
    assert "\n" not in str(refusal.value)
    for words in ("tests.service.config.test_config:coasting", " s after a stop at x = ", "still moves: x", 'stop = "coasts"'):
        assert words in str(refusal.value)


@pytest.mark.slow  # finds two ways to rest
def test_disturbances_that_go_on_at_rest_are_balanced_by_a_way_to_rest(tmp_path: Path) -> None:
    observed, slip = SHIPPED.read_text() + "[observer]\n", "disturbances = { u_c = { drift = 0.1, limit = 0.1 } }\n"
    assert check_stop(loaded(tmp_path, observed + slip)) is None
    law = check_stop(loaded(tmp_path, observed + "at_rest = true\n" + slip))
    assert law is not None
    assert not law.holds
    assert np.array_equal(law.disturbances, [0.1])
    with pytest.raises(ConfigError, match=r"d_u_c = -?0\.8 m/s it still moves.*lower limits in observer.disturbances to what its inputs can balance"):
        check_stop(loaded(tmp_path, observed + "at_rest = true\n" + slip.replace("0.1 }", "0.8 }")))
    with pytest.raises(ConfigError, match=r"observer\.at_rest says what observer\.disturbances do while the robot stands, and there are none"):
        loaded(tmp_path, observed + "at_rest = true\n")


def test_nothing_is_done_with_a_robot_that_a_stop_does_not_bring_to_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(config: Config) -> None:
        raise ConfigError("it coasts")

    for module in (check, daemon, demo):
        monkeypatch.setattr(module, "check_stop", refuse)
    config = load(SHIPPED)
    for act in (lambda: check.main(SHIPPED), lambda: daemon.main(config, BusSettings()), lambda: demo.main(config, "eight")):
        with pytest.raises(ConfigError, match="it coasts"):
            act()


def test_states_may_come_more_often_than_samples_and_be_stale_after_less_than_a_period(tmp_path: Path) -> None:
    assert loaded(tmp_path, MINIMAL + "[timing]\nstale_s = 0.05\n[sim]\nstate_period_s = 0.01\n", with_model=False).stale_s == 0.05


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ("[sim]\nsensor_delay_s = 0.13\n", ""),
        (
            "[sim]\nsensor_delay_s = 0.14\n",
            "sim.sensor_delay_s must be at most 0.13 s: a command acts until timing.valid_s + timing.delay_s = 0.25",
        ),
        ("[sim]\nsensor_delay_s = 0.14\n[timing]\ndelay_s = 0.14\n", ""),
        ("[sim]\nsensor_delay_s = 0.14\n[timing]\ndelay_s = 'measured'\n", ""),
        ("[sim]\nsensor_delay_s = 0.05\nstate_period_s = 0.2\n", "and the next one comes 0.2 s later, got 0.05 s: raise timing.delay_s"),
    ],
)
def test_states_that_are_measured_longer_ago_than_their_commands_act_are_refused_on_the_bus(tmp_path: Path, changes: str, said: str) -> None:
    config = loaded(tmp_path, MINIMAL + changes, with_model=False)
    if not said:
        check_period(config)
        return
    with pytest.raises(ConfigError, match=re.escape(said)):
        check_period(config)


def test_plan_of_one_stage_is_refused_on_the_bus(tmp_path: Path) -> None:
    """It ends when the next one begins to be computed: the robot's inputs ran out at 48 of 50 samples."""
    with pytest.raises(ConfigError, match=r"^ocp\.N must be at least 2 for a robot on the bus: a plan of one stage lasts for ocp\.dt_s = 0\.1 s"):
        check_period(loaded(tmp_path, MINIMAL.replace("ocp.N = 3", "ocp.N = 1").replace("delta = [1, 2, 3]", "delta = 1"), with_model=False))


@pytest.mark.parametrize(
    ("dt_s", "valid_s", "longest"),
    [(0.2, 0.25, None), (0.23, 0.25, None), (0.28, 0.3, None), (0.25, 0.25, "0.23"), (0.5, 0.3, "0.28"), (0.1, 0.05, "0.03")],
)
def test_period_that_is_longer_than_a_command_acts_is_refused_on_the_bus(tmp_path: Path, dt_s: float, valid_s: float, longest: str | None) -> None:
    """Or the robot would go to rest between any two commands, in the mode TRACKING, three metres behind its reference after a minute."""
    config = loaded(tmp_path, MINIMAL.replace("dt_s = 0.1", f"dt_s = {dt_s}") + f"[timing]\nvalid_s = {valid_s}\n", with_model=False)
    if longest is None:
        check_period(config)
        return
    with pytest.raises(ConfigError, match=rf"^ocp.dt_s must be at most {longest} s for a robot on the bus: .*, got {dt_s:g} s: shorten it"):
        daemon.main(config, BusSettings())


def test_period_that_is_longer_than_a_command_acts_is_refused_before_anything_is_tried(tmp_path: Path) -> None:
    """A file that `check` takes would otherwise be refused by `run`."""
    path = tmp_path / "robot.toml"
    path.write_text(MINIMAL.replace("dt_s = 0.1", "dt_s = 0.25"))
    starts: list[Callable[[], int]] = [lambda: check.main(path), lambda: demo.main(load(path), None), lambda: faults.main(path, [], None)]
    for start in starts:
        with pytest.raises(ConfigError, match=r"^ocp.dt_s must be at most 0.23 s for a robot on the bus: "):
            start()
