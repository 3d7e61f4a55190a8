# SPDX-License-Identifier: Apache-2.0
"""Transcription of the QP of one sample: every number against finite differences of the OCP, every pattern against all possible nonzero entries."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.rti.linearization import damping
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.qp import Qp
from rti_mpc.rti.qp.transcription import INFINITY, SLACK_UNIT
from rti_mpc.rti.rti import Rti
from tests.problems import INF, beacon, double_integrator, fenced, pioneer
from tests.slow import slow_but

PROBLEMS: dict[str, Callable[[], Ocp]] = {
    "pioneer_euler": lambda: pioneer(method="euler", delta=[1, 2, 3, 4, 5, 6, 28]),
    "pioneer_rk4": lambda: pioneer(lambda_=[0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2]),
    "pioneer_with_held_inputs": lambda: pioneer(N=9, N_u=4, Q=[[1.0, 0.2, 0.0], [0.2, 1.0, 0.1], [0.0, 0.1, 0.05]], R=[[1.0, 0.3], [0.3, 2.0]]),
    "pioneer_bounded_on_one_side": lambda: pioneer(ubu=[0.5, INF], lbu=-INF, lbdu=[-0.1, -INF], ubx=[2.0, INF, INF, 0.4, INF], z=7.0, Z=3.0),
    "fenced": fenced,
    "fenced_with_held_inputs": lambda: fenced(N=6, N_u=3, ubx=INF, lbx=-INF),
    "beacon_euler": lambda: beacon(method="euler", delta=[1, 2, 3, 4, 5, 6]),
    "beacon_rk4": lambda: beacon(N_u=1),
    "fenced_in_blocks": lambda: fenced(N=6, blocks=[2, 1, 3]),
    "double_integrator": lambda: double_integrator(lbx=[-INF, -0.5]),
}

NAMES = slow_but(
    PROBLEMS, "pioneer_rk4", "pioneer_bounded_on_one_side", "fenced_with_held_inputs", "beacon_rk4", "fenced_in_blocks", "double_integrator"
)


@functools.cache
def built(name: str, formulation: str, compile: bool) -> Rti:
    return Rti(PROBLEMS[name](), formulation=formulation, solver="osqp", compile=compile)


def at_random(name: str, seed: int, *, formulation: str = "simultaneous", compile: bool = False, away: float = 1.0) -> Rti:
    """Linearize everything, state bounds included, at a guess, reference and parameters that are nowhere special; `away` times as far a reference."""
    rng = np.random.default_rng(seed)
    rti = built(name, formulation, compile)
    rti.reset(np.zeros(rti.ocp.model.nx), np.array(rti.ocp.model.u_rest))
    rti.x[:] = rng.normal(size=rti.x.shape)
    rti.u[:] = rng.normal(size=rti.u.shape)
    p = np.array(rti.ocp.model.p_nominal) * rng.uniform(0.8, 1.2, size=rti.p.shape)
    rti.prepare(away * rng.normal(size=rti.y_ref.shape), p, shift=False, u_prev=rng.normal(size=rti.ocp.model.nu))
    for solver in rti.solvers:
        solver.load()
    return rti


def whole(rti: Rti) -> Qp:
    """The QP with every bound."""
    return rti.solvers[-1].qp


class ByHand:
    """The OCP as functions of all variables, ``v = (x, u, s / SLACK_UNIT)``, as its documentation writes it: nothing of it is differentiated."""

    def __init__(self, rti: Rti) -> None:
        self.ocp = ocp = rti.ocp
        self._rti = rti
        model = ocp.model
        self._phi = ocp.phi()
        self._h = ca.Function("h", [model.x, model.p], [model.y_expr])
        self._g = ca.Function("g", [model.x, model.u, model.p], [ca.vertcat(model.x[list(ocp.soft), 0], ocp.h_expr)])
        self.guess = np.concatenate([rti.x.ravel(), rti.u.ravel(), np.zeros(ocp.N * len(ocp.lg))])

    def _split(self, v: Array) -> tuple[Array, Array, Array]:
        x, u = self._rti.x, self._rti.u
        return v[: x.size].reshape(x.shape), v[x.size : x.size + u.size].reshape(u.shape), v[x.size + u.size :].reshape(self.ocp.N, -1)

    def residuals(self, v: Array) -> Array:
        """Residuals whose squared norm is the normalised Gauss-Newton cost, without slacks."""
        ocp, rti = self.ocp, self._rti
        x, u, _ = self._split(v)
        root_Q, root_R = (np.linalg.cholesky(W).T for W in (ocp.Q, ocp.R))
        e = [np.array(self._h(x[i], rti.p[i])).ravel() - rti.y_ref[i - 1] for i in range(1, ocp.N + 1)]
        du = np.diff(np.vstack([rti.u_prev, u]), axis=0)
        outputs = [np.sqrt(d) * root_Q @ e_i for d, e_i in zip(ocp.delta, e, strict=True)]
        if ocp.Q_e.any():
            outputs.append(np.linalg.cholesky(ocp.Q_e).T @ e[-1])
        return np.sqrt(rti.cost_scale) * np.concatenate([*outputs, (np.sqrt(ocp.lambda_)[:, None] * (du @ root_R.T)).ravel()])

    def rows(self, v: Array) -> Array:
        """Left-hand sides of all constraints, in the order the transcription documents."""
        ocp, rti = self.ocp, self._rti
        x, u, s = self._split(v)
        held = np.repeat(np.arange(ocp.N_u), ocp.blocks)
        phi = [np.array(self._phi(x[k], u[held[k]], rti.p[k])).ravel() for k in range(ocp.N)]
        du = np.diff(np.vstack([rti.u_prev, u]), axis=0)
        g = np.array([np.array(self._g(x[i], u[held[i - 1]], rti.p[i])).ravel() for i in range(1, ocp.N + 1)])
        return np.concatenate(
            [
                x[0],
                (np.array(phi) - x[1:]).ravel(),
                u[:, present(ocp.lbu, ocp.ubu)].ravel(),
                du[:, present(ocp.lbdu, ocp.ubdu)].ravel(),
                (g - SLACK_UNIT * s)[:, present(ocp.ug)].ravel(),
                (g + SLACK_UNIT * s)[:, present(ocp.lg)].ravel(),
                s.ravel(),
            ]
        )

    def bounds(self) -> tuple[Array, Array]:
        """Bounds of `rows`, the initial state's left at the guess."""
        ocp, x = self.ocp, self._rti.x
        N, N_u, slacks = ocp.N, ocp.N_u, ocp.N * len(ocp.lg)
        upper, lower = present(ocp.ug), present(ocp.lg)
        inputs, increments = present(ocp.lbu, ocp.ubu), present(ocp.lbdu, ocp.ubdu)
        lb = [x[0], np.zeros(x[1:].size), np.tile(ocp.lbu[inputs], N_u), np.tile(ocp.lbdu[increments], N_u)]
        ub = [x[0], np.zeros(x[1:].size), np.tile(ocp.ubu[inputs], N_u), np.tile(ocp.ubdu[increments], N_u)]
        lb += [np.full(N * upper.sum(), -INF), np.tile(ocp.lg[lower], N), np.zeros(slacks)]
        ub += [np.tile(ocp.ug[upper], N), np.full(N * lower.sum(), INF), np.full(slacks, INF)]
        return np.concatenate(lb), np.concatenate(ub)


def present(*bounds: Array) -> np.ndarray[Any, Any]:
    return np.any(np.isfinite(bounds), axis=0)


def jacobian(function: Callable[[Array], Array], v: Array, h: float = 1e-6) -> Array:
    """Central differences."""
    return np.stack([(function(v + h * e) - function(v - h * e)) / (2 * h) for e in np.eye(len(v))], axis=1)


def hessian(qp: Qp) -> Array:
    upper = qp.P.toarray()
    return upper + np.triu(upper, k=1).T


@pytest.mark.parametrize("name", NAMES)
def test_constraint_matrix_is_the_jacobian_of_the_constraints(name: str) -> None:
    """With it every A_k and B_k, and where each of them lies."""
    rti = at_random(name, seed=1)
    problem = ByHand(rti)
    difference = jacobian(problem.rows, problem.guess)
    np.testing.assert_allclose(whole(rti).A.toarray(), difference, atol=2e-8)  # h^2 and rounding over h


@pytest.mark.parametrize("name", NAMES)
def test_bounds_of_the_qp_are_what_the_guess_leaves_of_the_bounds(name: str) -> None:
    """In deviations: lb - g <= A z <= ub - g. With it the defects b_k."""
    rti = at_random(name, seed=2)
    problem = ByHand(rti)
    lb, ub = problem.bounds()
    g = problem.rows(problem.guess)
    nx = rti.ocp.model.nx  # the rows of the initial state are the feedback's
    np.testing.assert_allclose(whole(rti).l[nx:], np.where(np.isfinite(lb), lb - g, -INFINITY)[nx:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(whole(rti).u[nx:], np.where(np.isfinite(ub), ub - g, INFINITY)[nx:], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_gradient_is_half_that_of_the_cost(name: str) -> None:
    rti = at_random(name, seed=3)
    ocp, problem = rti.ocp, ByHand(rti)
    difference = jacobian(lambda v: np.atleast_1d(0.5 * (problem.residuals(v) ** 2).sum()), problem.guess)[0]
    slacks = ocp.N * len(ocp.lg)
    difference[len(difference) - slacks :] = 0.5 * rti.cost_scale * SLACK_UNIT * np.tile([*ocp.z[list(ocp.soft)], *ocp.zh], ocp.N)
    np.testing.assert_allclose(whole(rti).q, difference, rtol=1e-7, atol=1e-6)  # costs of 1e3 over h


@pytest.mark.parametrize("name", NAMES)
def test_hessian_is_the_gauss_newton_approximation_and_the_damping(name: str) -> None:
    """Outputs that are not linear included: their Hessian follows the guess. Steps in inputs are damped in proportion to the cost within reach."""
    for seed, away in ((4, 1.0), (5, 1.0), (6, 30.0)):
        rti = at_random(name, seed=seed, away=away)
        ocp, problem = rti.ocp, ByHand(rti)
        nx = ocp.model.nx
        J = jacobian(problem.residuals, problem.guess)
        expected = J.T @ J
        slacks = len(problem.guess) - ocp.N * len(ocp.lg)
        steps = range(slacks - rti.u.size, slacks)
        residuals = problem.residuals(problem.guess)
        cost, within_reach = residuals @ residuals, np.diag(expected)[nx : (ocp.N + 1) * nx] @ np.tile(rti.scale[-nx:], ocp.N) ** 2
        expected[steps, steps] += np.tile(damping(ocp) / rti.scale_u**2, ocp.N_u) * min(cost, np.sqrt(cost * within_reach))
        expected[slacks:, slacks:] = np.diag(0.5 * rti.cost_scale * SLACK_UNIT**2 * np.tile([*ocp.Z[list(ocp.soft)], *ocp.Zh], ocp.N))
        np.testing.assert_allclose(hessian(whole(rti)), expected, rtol=1e-7, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_no_entry_is_stored_that_is_never_nonzero(name: str) -> None:
    """Dense blocks would be right, and slow; the condensed problem is dense by its nature."""
    for matrix in "PA":
        qps = [whole(at_random(name, seed=seed, formulation="simultaneous")) for seed in range(10, 13)]
        assert np.all(sum(abs(getattr(qp, matrix).data) for qp in qps) > 0)


@pytest.mark.parametrize("name", slow_but(["pioneer_rk4", "beacon_rk4"], "beacon_rk4"))
@pytest.mark.parametrize("formulation", ["simultaneous", "sequential"])
def test_compiled_and_interpreted_functions_fill_the_same_qp(name: str, formulation: str) -> None:
    compiled, interpreted = (whole(at_random(name, seed=7, formulation=formulation, compile=compile)) for compile in (True, False))
    for attribute in "qluPA":
        ours, theirs = (getattr(qp, attribute) if attribute in "qlu" else getattr(qp, attribute).data for qp in (compiled, interpreted))
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_sequential_qp_is_the_simultaneous_one_with_the_states_eliminated(name: str) -> None:
    """Number by number: Hessian, gradient, rows and bounds, the initial state embedded in both."""
    sparse, dense = (at_random(name, seed=9, formulation=formulation) for formulation in ("simultaneous", "sequential"))
    x0 = np.random.default_rng(9).normal(size=sparse.ocp.model.nx)
    for rti in (sparse, dense):
        rti.x0[:] = x0
        whole(rti).embed()
    full, reduced = whole(sparse), whole(dense)
    scale = dense.cost_scale / sparse.cost_scale
    k = sparse.x.size
    A, P = full.A.toarray(), hessian(full)
    offset = np.linalg.solve(A[:k, :k], full.l[:k])  # states where the inputs do not change
    response = np.vstack([-np.linalg.solve(A[:k, :k], A[:k, k:]), np.eye(len(full.q) - k)])
    at = np.concatenate([offset, np.zeros(len(full.q) - k)])
    np.testing.assert_allclose(hessian(reduced), scale * response.T @ P @ response, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(reduced.q, scale * response.T @ (P @ at + full.q), rtol=1e-9, atol=1e-9)

    def rows(matrix: Array, lower: Array, upper: Array) -> Array:
        """Rows and bounds, in an order that depends on nothing but them."""
        table = np.column_stack([matrix, lower, upper]).round(9) + 0.0
        return table[np.lexsort(table.T)]

    finite = np.where(np.abs(full.l[k:]) < INFINITY, A[k:] @ at, 0.0), np.where(np.abs(full.u[k:]) < INFINITY, A[k:] @ at, 0.0)
    expected = rows(A[k:] @ response, full.l[k:] - finite[0], full.u[k:] - finite[1])
    if len(expected):
        np.testing.assert_allclose(rows(reduced.A.toarray(), reduced.l, reduced.u), expected, atol=1e-8)


def test_sequential_qp_without_bounds_has_the_row_that_osqp_wants() -> None:
    qp = whole(at_random("beacon_rk4", seed=1, formulation="sequential"))
    assert (qp.A.shape[0], qp.l[0], qp.u[0]) == (1, -INFINITY, INFINITY)


def test_defects_vanish_on_a_trajectory_of_the_model() -> None:
    rti = Rti(pioneer(), formulation="simultaneous", solver="osqp", compile=False)
    rng = np.random.default_rng(8)
    rti.u[:] = rng.uniform(-0.4, 0.4, rti.u.shape)
    phi = rti.ocp.phi()
    for k in range(rti.ocp.N):
        rti.x[k + 1] = np.array(phi(rti.x[k], rti.u[k], rti.p[k])).ravel()
    rti.prepare(rti.y_ref.copy(), shift=False)
    dynamics = slice(5, 5 + 5 * rti.ocp.N)
    np.testing.assert_allclose(rti.qp.l[dynamics], 0.0, atol=1e-15)
