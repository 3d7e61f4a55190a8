# SPDX-License-Identifier: Apache-2.0
"""Models: their properties, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.errors import OcpError
from rti_mpc.model.find import find_model
from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pioneer_3dx import NOMINAL_PARAMETERS


def mass(**changes: Any) -> Model:
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    fields: dict[str, Any] = {
        "name": "mass",
        "x": x,
        "u": u,
        "p": p,
        "f_expl_expr": ca.vertcat(x[1], u / p),
        "y_expr": x[0],
        "states": (Signal("r", "m"), Signal("v", "m/s")),
        "inputs": (Signal("force", "N"),),
        "outputs": (Signal("r", "m"),),
        "parameters": (Signal("m", "kg"),),
        "p_nominal": (2.0,),
    }
    return Model(**(fields | changes))


def right_hand_side(model: Model, x: list[float], u: list[float]) -> list[float]:
    f = ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr])
    return list(np.array(f(x, u, model.p_nominal)).ravel())


def test_pioneer_is_equation_9_of_the_paper() -> None:
    """Written down again, number by number, in plain Python."""
    x, y, psi, u, omega, u_c, omega_c = 0.3, -0.2, 0.7, 0.4, -0.5, 0.3, 0.6
    t = list(NOMINAL_PARAMETERS.values())
    assert t == [0.24089, 0.2424, -0.00093603, 0.99629, -0.0037256, 1.0915, 0.2]
    expected = [
        u * math.cos(psi) - 0.2 * omega * math.sin(psi),
        u * math.sin(psi) + 0.2 * omega * math.cos(psi),
        omega,
        t[2] / t[0] * omega**2 - t[3] / t[0] * u + u_c / t[0],
        -t[4] / t[1] * u * omega - t[5] / t[1] * omega + omega_c / t[1],
    ]
    assert right_hand_side(find_model("pioneer_3dx"), [x, y, psi, u, omega], [u_c, omega_c]) == pytest.approx(expected, abs=1e-15)


def test_pioneer_names_its_signals_with_units_and_says_which_are_angles() -> None:
    model = find_model("pioneer_3dx")
    assert [(s.name, s.unit, s.angle) for s in model.states] == [
        ("x", "m", False),
        ("y", "m", False),
        ("psi", "rad", True),
        ("u", "m/s", False),
        ("omega", "rad/s", False),
    ]
    assert [(s.name, s.unit) for s in model.inputs] == [("u_c", "m/s"), ("omega_c", "rad/s")]
    assert [s.name for s in model.outputs if s.angle] == ["psi"]
    assert (model.nx, model.nu, model.ny, model.np_) == (5, 2, 3, 7)


def test_robot_rests_at_zero_input_unless_the_model_says_otherwise() -> None:
    assert mass().u_rest == (0.0,)
    assert mass(u_rest=(9.81,)).u_rest == (9.81,)


def test_parameters_change_by_name_and_the_original_stays() -> None:
    model = mass()
    heavier = model.with_parameters(m=4.0)
    assert right_hand_side(heavier, [0.0, 1.0], [1.0]) == [1.0, 0.25]
    assert model.p_nominal == (2.0,)
    with pytest.raises(OcpError, match="mass has parameters m, got mm"):
        model.with_parameters(mm=1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": (Signal("r", "m"),)}, "states must have 2 entries"),
        ({"f_expl_expr": None}, "f_expl_expr must be given in continuous time, or disc_dyn_expr and dt in discrete time, got neither"),
        ({"disc_dyn_expr": ca.SX(2, 1), "dt": 0.1}, "f_expl_expr must be given in continuous time, or disc_dyn_expr and dt .*, got both"),
        ({"f_expl_expr": None, "disc_dyn_expr": ca.SX(2, 1)}, "dt must be the period of disc_dyn_expr in s, given with it only, got None"),
        ({"f_expl_expr": None, "disc_dyn_expr": ca.SX(3, 1), "dt": 0.1}, "disc_dyn_expr must have 2 entries, as x has, got 3"),
        ({"f_expl_expr": None, "disc_dyn_expr": ca.SX(2, 1), "dt": -0.1}, "dt must be a positive number of seconds, got -0.1"),
        ({"quaternions": ("r", "v", "w", "z")}, "quaternions must be names of four outputs or of four states each, w, x, y, z, no angles"),
        ({"quaternions": "r"}, "quaternions must be names of four outputs or of four states each"),
        ({"method": "euler"}, "method must be one of rk4, irk, got 'euler'"),
        ({"sim_method_num_stages": 4}, "sim_method_num_stages must be at most 3, got 4"),
        ({"sim_method_num_steps": 1001}, "sim_method_num_steps must be at most 1000, got 1001"),
        ({"sim_method_num_steps": 0}, "sim_method_num_steps must be a whole number of at least 1, got 0"),
        ({"f_expl_expr": ca.SX(3, 1)}, "f_expl_expr must have 2 entries, as x has, got 3"),
        ({"x": ca.SX.sym("x", 1, 2)}, r"x must be a column, of shape \(2, 1\), got shape \(1, 2\)"),
        ({"y_expr": ca.SX(2, 1)}, "outputs must have 2 entries, as y_expr has, got 1"),
        ({"p_nominal": (1.0, 2.0)}, "p_nominal must have 1 entries, as p has, got 2"),
        ({"u_rest": (0.0, 0.0)}, "u_rest must have 1 entries"),
        ({"states": (Signal("r", "m"), Signal("r", "m/s"))}, "names must be unique within a vector"),
        ({"f_expl_expr": ca.vertcat(ca.SX.sym("wind"), 0)}, "f_expl_expr must depend only on x, u, p, also has wind"),
        ({"stop_expr": ca.SX(2, 1)}, "stop_expr must have 1 entries, as u has, got 2"),
        ({"stop_expr": ca.SX.sym("wind")}, "stop_expr must depend only on x, u, p, also has wind"),
        ({"y_expr": ca.SX.sym("wind")}, "y_expr must depend only on x, u, p, also has wind"),
    ],
)
def test_what_does_not_fit_together_is_refused_by_name(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(OcpError, match=message):
        mass(**changes)


def test_outputs_may_depend_on_inputs_unless_they_are_angles() -> None:
    """An angle is kept in one turn with the reference before an input is known."""
    model = mass()
    of_inputs = {"x": model.x, "u": model.u, "p": model.p, "f_expl_expr": model.f_expl_expr, "y_expr": model.x[0] + 2 * model.u, "u_rest": 0.5}
    taken = mass(**of_inputs)
    assert (taken.outputs_of_inputs, model.outputs_of_inputs) == (True, False)
    p = taken.p_nominal
    assert float(taken.outputs_at()([1.0, 0.0], 0.2, p)) == pytest.approx(1.4)
    assert float(taken.h()([1.0, 0.0], p)) == pytest.approx(2.0)  # at rest
    with pytest.raises(OcpError, match="output bearing is an angle and must not depend on u"):
        mass(**of_inputs, outputs=(Signal("bearing", "rad", angle=True),))


def test_model_of_ones_own_is_found_by_module_and_function() -> None:
    assert find_model("rti_mpc.model.robots.pioneer_3dx:pioneer_3dx").name == "pioneer_3dx"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("pioneer", "must be one of pioneer_3dx, .*, chain or an importable package.module:function of your own, got 'pioneer'"),
        ("rti_mpc.nowhere:model", "No module named"),
        ("rti_mpc.model.model:nothing", "has no function nothing"),
        ("numpy:zeros_like", r"numpy:zeros_like must return a model, it raised TypeError: "),
        ("numpy:errstate", "numpy:errstate must return a rti_mpc.Model, got errstate"),
        ("numpy:__version__", "has no function __version__"),
        *(
            (name, "package.module:function of your own, got")
            for name in ("", ":", ":x", "a:", ".os:system", "os/x:y", "a b:c", "a:b:c", "..:x", "a.:b")
        ),
        *((name, f"{name.partition(':')[0]} is Python's own") for name in ("sys:exit", "os:abort", "os:fork", "builtins:dict", "antigravity:x")),
    ],
)
def test_model_that_does_not_exist_is_refused_with_what_would_be_right(name: str, message: str) -> None:
    with pytest.raises(OcpError, match=message):
        find_model(name)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("def model(:\n", "{module} must be importable, it raised SyntaxError in {file}, line 1: "),
        ("x = 1\nraise ValueError('two\\nlines')", "{module} must be importable, it raised ValueError in {file}, line 2: two lines"),
        ("import sys\nsys.exit()", "{module} must be importable, it raised SystemExit in {file}, line 2: nothing said"),
        ("import rti_mpc.nowhere", "{module} must be importable, it raised ModuleNotFoundError in {file}, line 1: No module named 'rti_mpc.nowhere'"),
        ("import sys\ndef model():\n    sys.exit(0)", "{module}:model must return a model, it raised SystemExit in {file}, line 3: 0"),
        ("import numpy\ndef model():\n    numpy.zeros(-1)", "{module}:model must return a model, it raised ValueError in {file}, line 3: "),
        ("def model():\n    return model()", "{module}:model must return a model, it raised RecursionError in {file}, line 2: "),
        ("def model(x):\n    pass", "{module}:model must return a model, it raised TypeError in {file}, line 1: "),
        ("def model():\n    pass", "{module}:model must return a rti_mpc.Model, got NoneType"),
        ("model = 1", "of your own, got '{module}:model' ({file} has no function model)"),
        ("\0", "{module} must be importable, it raised "),
    ],
)
def test_what_a_users_module_raises_is_one_line_with_its_own_file_and_line(
    text: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = f"theirs_{abs(hash(text))}"  # a module that was imported stays so
    file = tmp_path / f"{module}.py"
    file.write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(OcpError) as refusal:
        find_model(f"{module}:model")
    assert told.format(module=module, file=file) in str(refusal.value)
    assert "\n" not in str(refusal.value)
