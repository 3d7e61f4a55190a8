# SPDX-License-Identifier: Apache-2.0
"""One stage of the dynamics, against the formulas and against scipy."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.errors import OcpError
from rti_mpc.model.integrator import integrator, sensitivities
from rti_mpc.model.model import Model
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
    from scipy.integrate import solve_ivp

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


def stiff(stages: int, tau: float = 0.01) -> Model:
    """A mass whose force lags so far behind that a stage is ten of its time constants, with friction that is not linear."""
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u")
    f = [x[1], x[2] - ca.tanh(3 * x[1]), (u - x[2]) / tau]
    return Model("stiff", x, u, f, x[0], ("r", "v", "F"), "F_c", "r", method="irk", sim_method_num_stages=stages)


@pytest.mark.parametrize(("stages", "order"), [(1, 1), (2, 3), (3, 5)])
def test_error_of_radau_shrinks_with_its_order(stages: int, order: int) -> None:
    model = replace(MODEL, method="irk", sim_method_num_stages=stages)
    coarse, fine = (np.abs(np.array(integrator(model, substeps=n)(X, U, P, 0.2)).ravel() - truth(0.2)).max() for n in (2, 4))
    assert coarse / fine == pytest.approx(2**order, rel=0.25)  # the leading term is not all of it


@pytest.mark.parametrize(("stages", "error"), [(1, 0.03), (2, 6e-3), (3, 4e-4)])
def test_radau_follows_a_stiff_model_over_ten_time_constants(stages: int, error: float) -> None:
    from scipy.integrate import solve_ivp

    model, x, u = stiff(stages), np.array([0.3, -0.2, 0.7]), np.array([1.0])
    f = ca.Function("f", [model.x, model.u], [model.f_expl_expr])
    true = solve_ivp(lambda _, x: np.array(f(x, u)).ravel(), (0.0, 0.1), x, method="Radau", rtol=1e-10, atol=1e-12).y[:, -1]
    found = np.array(integrator(model, substeps=4)(x, u, [], 0.1)).ravel()
    np.testing.assert_allclose(found, true, rtol=0, atol=error)  # four steps of 2.5 time constants each


@pytest.mark.parametrize("method", ["rk4", "irk"])
@pytest.mark.parametrize("substeps", [1, 3])
def test_sensitivities_are_those_of_finite_differences(method: str, substeps: int) -> None:
    """Of the implicit function theorem, where they are implicit: Newton's steps are not differentiated."""
    model = replace(MODEL, method=method)
    linear = ca.Function("linear", [model.x, model.u, model.p], sensitivities(model, 0.1, substeps=substeps)[1:])
    phi = integrator(model, substeps=substeps)
    for found, i in zip(linear(X, U, P), range(3), strict=True):
        at = [X, U, P]

        def moved(z: Array, i: int = i, at: list[Array] = at) -> Array:
            return np.array(phi(*at[:i], z, *at[i + 1 :], 0.1)).ravel()

        differences = [(moved(at[i] + e) - moved(at[i] - e)) / 2e-5 for e in 1e-5 * np.eye(len(at[i]))]
        np.testing.assert_allclose(np.array(found), np.array(differences).T, rtol=0, atol=1e-8)


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
def test_model_that_newton_does_not_solve_is_not_finite_in_any_unit(unit: float) -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    model = Model("wild", x, u, unit * 20 * (1 + (x / unit) ** 2) + u, x, "x", "u", "x", method="irk")  # at its end there is no state
    assert np.isnan(float(integrator(model)(0.3 * unit, 0.0, [], 0.1)))


def test_implicit_step_whose_terms_overflow_is_not_taken_for_solved() -> None:
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    model = Model("fast", x, u, ca.vertcat(ca.exp(x[0]), u), x, ("x", "y"), "u", ("x", "y"), method="irk")
    assert np.isnan(np.array(integrator(model)([709.0, 0.0], 0.0, [], 1.0))).any()


@pytest.mark.parametrize("unit", [1e-12, 1e12])
@pytest.mark.parametrize("x", [[0.3, -0.2, 0.7], [0.0, 0.0, 0.0]])
def test_implicit_steps_are_the_same_in_any_unit(x: list[float], unit: float) -> None:
    """From rest as well, where the state says nothing of what is small."""
    model = stiff(3)
    scaled = {"x": model.x, "f_expl_expr": unit * ca.substitute(model.f_expl_expr, model.x, model.x / unit)}
    steps, theirs = integrator(model), integrator(replace(model, **scaled))
    for u in (0.0, 1.0):
        np.testing.assert_allclose(np.array(theirs(unit * np.array(x), u, [], 0.02)) / unit, np.array(steps(x, u, [], 0.02)), rtol=1e-12, atol=1e-15)


def test_implicit_step_back_does_not_blow_errors_up() -> None:
    """To go back by three time constants of a lag would make 20 of each; the step forwards is mirrored instead."""
    back = np.array(integrator(stiff(3))([0.0, 0.5, 1.0], [0.0], [], -0.036)).ravel()
    assert np.abs(back - [0.0, 0.5, 1.0]).max() < 1.1


def test_discrete_model_is_its_own_integrator_and_interpolated_within_a_period() -> None:
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    model = Model(
        x=x, u=u, name="d", disc_dyn_expr=[x[0] + 0.1 * x[1], 0.5 * x[1] + u], dt=0.1, y_expr=x, states=("r", "v"), inputs="a", outputs=("r", "v")
    )
    phi = integrator(model)
    np.testing.assert_allclose(np.array(phi([1.0, 2.0], 3.0, [], 0.1)).ravel(), [1.2, 4.0], atol=1e-15)
    np.testing.assert_allclose(np.array(phi([1.0, 2.0], 3.0, [], 0.05)).ravel(), [1.1, 3.0], atol=1e-15)
    np.testing.assert_allclose(np.array(integrator(model, substeps=2)([1.0, 2.0], 3.0, [], 0.2)).ravel(), [1.6, 5.0], atol=1e-15)


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
    with pytest.raises(OcpError, match="integrator must be one of euler, rk4, irk, got 'rk5'"):
        integrator(MODEL, "rk5")
    with pytest.raises(OcpError, match="substeps must be a whole number of at least 1, got 0"):
        integrator(MODEL, "rk4", 0)
