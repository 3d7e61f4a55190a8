# SPDX-License-Identifier: Apache-2.0
"""The plant against an independent integrator."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.model.model import Model
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc_sim.plant import Plant, SampledPlant, lagging, plant, step

MODEL = pioneer_3dx().with_parameters(theta_1=0.3, a=0.15)
X0 = np.array([0.5, -0.2, 0.3, 0.1, -0.4])
U = np.array([0.4, 0.6])


def solved(model, x0: Array, u: Array, duration_s: float) -> Array:
    from scipy.integrate import solve_ivp

    f = ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr])
    return solve_ivp(lambda t, x: f(x, u, model.p_nominal).full().ravel(), (0.0, duration_s), x0, rtol=1e-11, atol=1e-12).y[:, -1]


@pytest.mark.parametrize("duration_s", [0.0031, 0.1, 0.75])
def test_plant_agrees_with_solve_ivp(duration_s: float) -> None:
    """Also over intervals longer than one call covers."""
    plant = Plant(MODEL, X0, 0.1, 20)
    plant.advance(U, duration_s)
    np.testing.assert_allclose(plant.x, solved(MODEL, X0, U, duration_s), atol=1e-9)


@pytest.mark.parametrize("lag_s", [0.002, 0.08])
def test_plant_with_lagging_inputs_agrees_with_solve_ivp(lag_s: float) -> None:
    plant = Plant(MODEL, X0, 0.1, 20, lag_s)
    plant.advance(U, 0.25)
    expected = solved(lagging(MODEL, lag_s), np.concatenate([X0, [0.0, 0.0]]), U, 0.25)
    np.testing.assert_allclose(np.concatenate([plant.x, plant.u]), expected, atol=2e-4 if lag_s < 0.01 else 1e-7)


def test_lagging_inputs_reach_63_percent_after_one_time_constant() -> None:
    plant = Plant(MODEL, X0, 0.1, 20, 0.05)
    plant.advance(U, 0.05)
    np.testing.assert_allclose(plant.u, (1 - np.exp(-1)) * U, rtol=1e-6)


def test_inputs_of_a_model_with_a_nominal_state_may_lag() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    lagged = lagging(Model("tank", x, u, u - ca.sqrt(x), x, "h", "q", "h", x_nominal=1.0, u_rest=1.0), 0.1)
    assert lagged.x_nominal == (1.0, 1.0)


def test_cutting_an_interval_changes_nothing() -> None:
    whole, cut = Plant(MODEL, X0, 0.1, 20), Plant(MODEL, X0, 0.1, 20)
    whole.advance(U, 0.1)
    for duration_s in (0.0137, 0.05, 0.0363):
        cut.advance(U, duration_s)
    np.testing.assert_allclose(cut.x, whole.x, atol=1e-11)


@pytest.mark.parametrize("lag_s", [0.0, 0.05])
def test_plants_of_one_model_share_its_equations_and_no_state(lag_s: float) -> None:
    """As robots that are started many times in lockstep: to build the expressions takes as long as to drive for seconds."""
    alone = Plant(replace(MODEL), X0, 0.1, 20, lag_s)  # of another object
    one, other = (Plant(MODEL, x0, 0.1, 20, lag_s) for x0 in (X0, -X0))
    for sign in (1.0, -1.0):
        alone.advance(sign * U, 0.03)
        one.advance(sign * U, 0.03)
        other.advance(-2.0 * sign * U, 0.07)
    np.testing.assert_array_equal(one.x, alone.x)
    assert step(MODEL, 20, lag_s) is step(MODEL, 20, lag_s)
    assert step(MODEL, 20, lag_s) is not step(MODEL, 10, lag_s)


def test_plant_does_not_grow_the_heap() -> None:
    plant = Plant(MODEL, X0, 0.1, 20)
    plant.advance(U, 0.1)
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    for _ in range(200):
        plant.advance(U, 0.1)
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 1024


def sampled(lag_s: float = 0.0) -> SampledPlant:
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    after = [x[0] + 0.1 * x[1], 0.5 * x[1] + u]
    model = Model(name="d", x=x, u=u, disc_dyn_expr=after, dt=0.1, y_expr=x, states=("r", "v"), inputs="a", outputs=("r", "v"))
    made = plant(model, np.array([1.0, 2.0]), 0.1, 20, lag_s)
    assert isinstance(made, SampledPlant)
    return made


def test_plant_in_discrete_time_is_exact_after_periods_however_they_are_cut_and_interpolated_within() -> None:
    one = sampled()
    one.advance(np.array([3.0]), 0.05)
    np.testing.assert_allclose(one.x, [1.1, 3.0], atol=1e-15)
    for duration_s in (0.0137, 0.0363, 0.1):
        one.advance(np.array([3.0]), duration_s)
    np.testing.assert_allclose(one.x, [1.6, 5.0], atol=1e-14)


def test_plant_in_discrete_time_takes_the_mean_of_inputs_that_change_within_a_period() -> None:
    one = sampled()
    for u, duration_s in ((3.0, 0.03), (-1.0, 0.07)):
        one.advance(np.array([u]), duration_s)
    np.testing.assert_allclose(one.x, [1.2, 1.0 + 0.3 * 3.0 - 0.7], atol=1e-14)


def test_inputs_of_a_plant_in_discrete_time_lag_as_those_of_another() -> None:
    one = sampled(lag_s=0.05)
    one.advance(np.array([1.0]), 0.05)
    np.testing.assert_allclose(one.u, 1 - np.exp(-1), atol=1e-14)
    one.advance(np.array([1.0]), 0.05)
    mean = 1 - 0.5 * (1 - np.exp(-2))  # of 1 - exp(-t / 0.05) over 0.1 s
    np.testing.assert_allclose(one.x[1], 1.0 + mean, atol=1e-14)
