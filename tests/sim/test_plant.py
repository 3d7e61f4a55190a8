# SPDX-License-Identifier: Apache-2.0
"""The plant against an independent integrator."""

from __future__ import annotations

import tracemalloc

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rti_mpc.array import Array
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc_sim.plant import Plant, lagging

MODEL = pioneer_3dx().with_parameters(theta_1=0.3, a=0.15)
X0 = np.array([0.5, -0.2, 0.3, 0.1, -0.4])
U = np.array([0.4, 0.6])


def solved(model, x0: Array, u: Array, duration_s: float) -> Array:
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


def test_cutting_an_interval_changes_nothing() -> None:
    whole, cut = Plant(MODEL, X0, 0.1, 20), Plant(MODEL, X0, 0.1, 20)
    whole.advance(U, 0.1)
    for duration_s in (0.0137, 0.05, 0.0363):
        cut.advance(U, duration_s)
    np.testing.assert_allclose(cut.x, whole.x, atol=1e-11)


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
