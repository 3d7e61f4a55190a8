# SPDX-License-Identifier: Apache-2.0
"""Robots that ship, as models."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.model.find import SHIPPED_MODELS, find_model
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import Model


def derivative(model: Model, x: Array, u: Array) -> Array:
    f = ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr])
    return np.array(f(x, u, model.p_nominal)).ravel()


@pytest.mark.parametrize("name", SHIPPED_MODELS)
def test_robot_is_finite_and_differentiable_where_it_starts(name: str) -> None:
    model = find_model(name)
    assert model.name == name
    x, u = np.array(model.x_nominal or np.zeros(model.nx)), np.array(model.u_rest)
    J = ca.Function("J", [model.x, model.u, model.p], [ca.jacobian(model.f_expl_expr, ca.vertcat(model.x, model.u))])
    assert np.isfinite(derivative(model, x, u)).all()
    assert np.isfinite(np.array(J(x, u, model.p_nominal))).all()


def settled(model: Model, speed: float, delta: float) -> Array:
    """State of the dynamic bicycle after four seconds at a steering angle, its speed kept."""
    phi, x = integrator(model, "rk4", 1), np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0, delta])
    for _ in range(400):
        x = np.array(phi(x, [0.0, 0.0], model.p_nominal, 0.01)).ravel()
        x[3] = speed
    return x


def test_dynamic_bicycle_turns_as_its_geometry_says_until_its_tyres_give_way() -> None:
    model = find_model("dynamic_bicycle")
    p = dict(zip((signal.name for signal in model.parameters), model.p_nominal, strict=True))
    slow, fast = settled(model, 0.5, 0.2), settled(model, 6.0, 0.3)
    assert slow[5] == pytest.approx(0.5 * np.tan(0.2) / (p["l_f"] + p["l_r"]), rel=0.02), "rad/s, v tan(delta) / wheelbase"
    sideways = 6.0 * fast[5] / 9.81
    assert 0.9 * p["mu"] < sideways < p["mu"], "in g: friction limits it, geometry alone would ask for 3.4"
