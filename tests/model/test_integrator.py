# SPDX-License-Identifier: Apache-2.0
"""One stage of the dynamics, against the formulas and against scipy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rti_mpc.array import Array
from rti_mpc.errors import OcpError
from rti_mpc.model.integrator import integrator
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from tests.problems import double_integrator

MODEL = pioneer_3dx()
P = np.array(MODEL.p_nominal)
X = np.array([0.1, -0.3, 0.8, 0.4, -0.6])
U = np.array([0.45, 0.7])
F = ca.Function("f", [MODEL.x, MODEL.u, MODEL.p], [MODEL.f_expl_expr])


def f(x: Array) -> Array:
    return np.array(F(x, U, P)).ravel()


def step(method: str, dt: float, substeps: int = 1) -> Array:
    return np.array(integrator(MODEL, method, substeps)(X, U, P, dt)).ravel()


def truth(dt: float) -> Array:
    return solve_ivp(lambda _, x: f(x), (0.0, dt), X, rtol=1e-12, atol=1e-13).y[:, -1]


def test_euler_is_equation_11_of_the_paper() -> None:
    np.testing.assert_allclose(step("euler", 0.1), X + 0.1 * f(X), atol=1e-15)


def test_rk4_is_the_classical_scheme() -> None:
    h = 0.1
    k_1 = f(X)
    k_2 = f(X + h / 2 * k_1)
    k_3 = f(X + h / 2 * k_2)
    k_4 = f(X + h * k_3)
    np.testing.assert_allclose(step("rk4", h), X + h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + k_4), atol=1e-15)


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("rk4", 4)])
def test_error_shrinks_with_the_order_of_the_scheme(method: str, order: int) -> None:
    coarse, fine = (np.abs(step(method, 0.2, substeps) - truth(0.2)).max() for substeps in (4, 8))
    assert coarse / fine == pytest.approx(2**order, rel=0.15)  # the leading term is not all of it


def test_substeps_are_equal_steps_one_after_the_other() -> None:
    phi = integrator(MODEL, "rk4")
    x = phi(phi(X, U, P, 0.05), U, P, 0.05)
    np.testing.assert_allclose(step("rk4", 0.1, 2), np.array(x).ravel(), atol=1e-15)


def test_stepping_back_undoes_a_step() -> None:
    phi = integrator(MODEL, "rk4")
    back = phi(phi(X, U, P, 0.02), U, P, -0.02)
    np.testing.assert_allclose(np.array(back).ravel(), X, atol=1e-7)  # RK4 is reversible to its fifth order only


def test_rk4_is_exact_for_a_double_integrator() -> None:
    phi = double_integrator().phi()
    np.testing.assert_allclose(np.array(phi([1.0, 2.0], [3.0], [])).ravel(), [1.0 + 0.2 + 0.015, 2.3], atol=1e-15)


def test_unknown_method_and_no_steps_are_refused() -> None:
    with pytest.raises(OcpError, match="integrator must be one of euler, rk4, got 'rk5'"):
        integrator(MODEL, "rk5")
    with pytest.raises(OcpError, match="substeps must be a whole number of at least 1, got 0"):
        integrator(MODEL, "rk4", 0)
