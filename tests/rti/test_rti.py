# SPDX-License-Identifier: Apache-2.0
"""The real-time iteration: where it converges, what it preserves, and how it fails."""

from __future__ import annotations

import os
import re
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import OcpError, ShapeError
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import Model, Signal
from rti_mpc.rti.certificate import certificate
from rti_mpc.rti.construction import FORMULATIONS, natives
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.places import places
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.qp.simultaneous import simultaneous
from rti_mpc.rti.rti import Rti
from tests.memory import PARTS, anonymous_bytes, leaked_bytes
from tests.oracle import nlp
from tests.problems import INF, arc, beacon, double_integrator, pioneer
from tests.rti.test_recursion import needs_compiler
from tests.slow import slow_but

TIGHT = SolverSettings(eps=1e-9, max_iter=200_000)
NARROW = {"lbx": [-INF, -INF, -INF, -0.3, -0.4], "ubx": [INF, INF, INF, 0.3, 0.4]}  # so that state bounds are active, and exceeded


def near_the_eight(ocp: Ocp, seed: int, count: int) -> Iterator[tuple[Array, Array, Array]]:
    """States around a reference, references and previous inputs, such that every kind of bound is active in many of them."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        y_ref = arc(rng.uniform(0, 60) + ocp.dt * np.arange(1, ocp.N + 1))
        x0 = np.concatenate([y_ref[0] + rng.normal(size=3) * [0.2, 0.2, 0.4], rng.uniform([-0.6, -0.9], [0.6, 0.9])])
        yield x0, y_ref, rng.uniform([-0.5, -0.745], [0.5, 0.745])


def iterate(rti: Rti, x0: Array, y_ref: Array, u_prev: Array, iterations: int, change: float = 0.0) -> None:
    """Iterate from a cold start on a held state, reference and previous input, until inputs change no more."""
    rti.reset(x0, u_prev)
    for _ in range(iterations):
        before = rti.u.copy()
        rti.prepare(y_ref, shift=False)
        assert rti.feedback(x0).usable
        if np.abs(rti.u - before).max() < change:
            break


def unmoving(rti: Rti) -> tuple[Array, ...]:
    return rti.x.copy(), rti.u.copy(), rti.u_prev.copy()


# Where it converges.


@pytest.mark.parametrize(
    ("formulation", "solver", "changes", "states"),
    [
        ("sequential", "riccati", {"method": "euler"}, 50),
        pytest.param("simultaneous", "riccati", NARROW, 50, marks=pytest.mark.slow),
        pytest.param("simultaneous", "riccati", {"N": 10, "N_u": 4} | NARROW, 50, marks=pytest.mark.slow),
        ("simultaneous", "osqp", {"N": 10, "N_u": 4} | NARROW, 10),
        pytest.param("simultaneous", "osqp", {"N": 10, "N_u": 4} | NARROW, 50, marks=pytest.mark.slow),
    ],
    ids=["paper_euler", "rk4_with_state_bounds", "held_inputs_with_state_bounds", "osqp", "osqp at more states"],
)
def test_rti_converges_to_the_nonlinear_solution_when_the_state_is_held(formulation: str, solver: str, changes: dict[str, Any], states: int) -> None:
    ocp = pioneer(**changes)
    rti = Rti(ocp, replace(TIGHT, scaling=10), formulation=formulation, solver=solver, compile=False)
    solve = nlp(ocp)
    active = np.zeros(3)
    for x0, y_ref, u_prev in near_the_eight(ocp, seed=1, count=states):
        rti.reset(x0, u_prev)
        x, u, cost = solve(x0, u_prev, y_ref, rti.x, rti.u)
        iterate(rti, x0, y_ref, u_prev, iterations=150, change=1e-7)
        np.testing.assert_allclose(rti.u, u, rtol=0, atol=1e-5)
        assert rti.cost == pytest.approx(cost, rel=1e-5)
        du = np.diff(np.vstack([u_prev, u]), axis=0)
        at = (np.abs(u) - ocp.ubu, np.abs(du) - ocp.ubdu, (np.abs(x[1:]) - ocp.ubx)[:, 3:])
        active += [bool(np.any(a > -1e-6)) for a in at]
    assert active[0] >= 0.2 * states
    assert active[1] >= 0.2 * states
    assert active[2] >= (0.8 * states if "ubx" in changes else 1)


def test_one_full_step_solves_a_linear_quadratic_ocp_exactly() -> None:
    """Against the normal equations of the same problem, written down in the inputs alone."""
    ocp = double_integrator(delta=[1, 2, 3, 4, 5, 6, 7, 8, 9, 10], lambda_=0.3)
    rng = np.random.default_rng(2)
    x0, u_prev, y_ref = rng.normal(size=2), rng.normal(size=1), rng.normal(size=(10, 2))
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    free = np.concatenate([np.linalg.matrix_power(A, i) @ x0 for i in range(1, 11)])
    forced = np.block([[np.linalg.matrix_power(A, i - j) @ B if j <= i else np.zeros((2, 1)) for j in range(10)] for i in range(10)])
    W = np.kron(np.diag(ocp.delta), ocp.Q)
    D = np.eye(10) - np.eye(10, k=-1)
    H = forced.T @ W @ forced + 0.3 * ocp.R[0, 0] * D.T @ D
    g = forced.T @ W @ (y_ref.ravel() - free) + 0.3 * ocp.R[0, 0] * D.T @ (np.eye(10)[:, 0] * u_prev)
    rti = Rti(ocp, TIGHT, compile=False)
    rti.x[:] = rng.normal(size=rti.x.shape)  # a guess that satisfies nothing
    rti.u[:] = rng.normal(size=rti.u.shape)
    rti.prepare(y_ref, shift=False, u_prev=u_prev)
    assert rti.feedback(x0) is QpStatus.SOLVED
    np.testing.assert_allclose(rti.u.ravel(), np.linalg.solve(H, g), atol=1e-6)
    np.testing.assert_allclose(rti.x[1:].ravel(), free + forced @ rti.u.ravel(), atol=1e-6)


def test_inputs_are_held_after_the_control_horizon() -> None:
    ocp = pioneer(N=10, N_u=3)
    rti = Rti(ocp, TIGHT, compile=False)
    ((x0, y_ref, u_prev),) = near_the_eight(ocp, seed=3, count=1)
    iterate(rti, x0, y_ref, u_prev, iterations=40)
    phi = ocp.phi()
    x = x0
    for k in range(10):
        x = np.array(phi(x, rti.u[min(k, 2)], rti.p[0])).ravel()
        np.testing.assert_allclose(rti.x[k + 1], x, atol=1e-6)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_cost_and_violation_are_those_of_the_plan(formulation: str) -> None:
    """Checked on a plan that is not converged, and from a state outside its bounds."""
    ocp = pioneer(N=10, N_u=4, delta=np.linspace(1, 28, 10), lambda_=[0.8, 0.7, 0.6, 0.5], **NARROW)
    rti = Rti(ocp, TIGHT, formulation=formulation, compile=False)
    ((x0, y_ref, u_prev),) = near_the_eight(ocp, seed=4, count=1)
    x0[3:] = 0.8, -0.9
    rti.reset(x0 + 0.1, u_prev)
    rti.prepare(y_ref, shift=False)
    assert rti.feedback(x0) is QpStatus.SOLVED
    e = rti.x[1:, :3] - y_ref
    du = np.diff(np.vstack([u_prev, rti.u]), axis=0)
    s = np.maximum(0.0, np.maximum(rti.x[1:] - ocp.ubx, ocp.lbx - rti.x[1:]))
    cost = ocp.delta @ (e @ ocp.Q * e).sum(1) + ocp.lambda_ @ (du @ ocp.R * du).sum(1) + (1e3 * s + 0.5e3 * s**2).sum()
    assert s.max() > 0.1
    assert rti.cost == pytest.approx(cost, rel=1e-12)
    assert rti.violation == pytest.approx(s.max(), rel=1e-12)


@pytest.mark.parametrize(
    "changes",
    [{}, NARROW, pytest.param({"N": 12, "N_u": 5} | NARROW, marks=pytest.mark.slow)],
    ids=["bounds", "state_bounds", "held_inputs"],
)
def test_both_formulations_give_the_same_plan(changes: dict[str, Any]) -> None:
    ocp = pioneer(**changes)
    sparse, dense = (Rti(ocp, replace(TIGHT, rho=5.0), formulation=formulation, compile=False) for formulation in FORMULATIONS)
    for x0, y_ref, u_prev in near_the_eight(ocp, seed=21, count=5):
        for rti in (sparse, dense):
            iterate(rti, x0, y_ref, u_prev, iterations=3)
        np.testing.assert_allclose(dense.u, sparse.u, rtol=0, atol=1e-6)
        np.testing.assert_allclose(dense.x, sparse.x, rtol=0, atol=1e-6)


def test_formulation_is_chosen_by_the_control_horizon_and_an_unknown_one_refused() -> None:
    assert Rti(double_integrator(N=5), compile=False).formulation == "sequential"
    assert Rti(double_integrator(N=50), compile=False).formulation == "simultaneous"
    with pytest.raises(OcpError, match="formulation must be one of auto, simultaneous, sequential, got 'dense'"):
        Rti(double_integrator(), formulation="dense", compile=False)


# How often it iterates.


def test_many_iterations_a_sample_are_converged_nmpc() -> None:
    """In closed loop with a robot that is not the model: IPOPT, converged at each sample, drives the same way."""
    ocp = pioneer(N=10, method="euler")
    rti = Rti(ocp, iterations=300, tolerance=1e-9, compile=False)
    solve, plant, p = nlp(ocp), integrator(ocp.model, "rk4", 20), np.array(ocp.model.p_nominal)
    start = arc(np.array([7.0]))[0]
    driven = {}
    for name in ("rti", "ipopt"):
        x0, u_prev = np.array([start[0] - 0.1, start[1] + 0.05, start[2] + 0.3, 0.0, 0.0]), np.zeros(2)
        rti.reset(x0, u_prev)
        x, u = rti.x.copy(), rti.u.copy()
        states = []
        for k in range(30):
            y_ref = arc(7.0 + 0.1 * np.arange(k + 1, k + 11), psi0=start[2])
            if name == "rti":
                rti.prepare(y_ref, shift=k > 0, u_prev=u_prev)
                assert rti.feedback(x0) is QpStatus.SOLVED
                u_prev = rti.u[0].copy()
            else:
                x, u, _ = solve(x0, u_prev, y_ref, x, u)
                u_prev = u[0].copy()
            x0 = np.array(plant(x0, u_prev, p, 0.1)).ravel()
            states.append(x0)
        driven[name] = np.array(states)
    np.testing.assert_allclose(driven["rti"], driven["ipopt"], rtol=0, atol=1e-6)


def test_sample_is_iterated_on_only_while_the_step_is_large() -> None:
    ocp = pioneer()
    rti, plain = Rti(ocp, iterations=2, tolerance=1e-6), Rti(ocp, iterations=1)
    ((x0, y_ref, u_prev),) = near_the_eight(ocp, seed=24, count=1)
    for one in (rti, plain):
        one.reset(x0, u_prev)
        one.prepare(y_ref, shift=False)
        one.feedback(x0)
    assert rti.taken == 2
    assert plain.taken == 1
    plain.prepare(y_ref, shift=False)
    plain.feedback(x0)
    np.testing.assert_array_equal(rti.u, plain.u)  # bit for bit what two samples without a shift are: from the third iteration on, guesses are ahead
    rti.tolerance = 0.01
    for _ in range(10):
        rti.prepare(y_ref, shift=False)
        rti.feedback(x0)
    assert rti.taken == 1


def test_iteration_that_fails_leaves_the_plan_of_the_one_before(monkeypatch: pytest.MonkeyPatch) -> None:
    ocp = pioneer()
    rti, plain = Rti(ocp), Rti(ocp, iterations=1)
    ((x0, y_ref, u_prev),) = near_the_eight(ocp, seed=24, count=1)
    assert rti.active_set is not None
    solve, solved = rti.active_set.solve, iter((True, False))
    monkeypatch.setattr(rti.active_set, "solve", lambda: next(solved) and solve())
    monkeypatch.setattr(rti, "solve_qp", lambda: QpStatus.FAILED)
    for one in (rti, plain):
        one.reset(x0, u_prev)
        one.prepare(y_ref, shift=False)
        assert one.feedback(x0) is (QpStatus.INACCURATE if one is rti else QpStatus.SOLVED)
    assert rti.taken == 1
    for array, same in zip(unmoving(rti), unmoving(plain), strict=True):
        np.testing.assert_array_equal(array, same)


@pytest.mark.parametrize("finds_a_way", [(False, True, False, True), (True, False, True, False)])
def test_iterations_are_the_same_whichever_solver_makes_them(finds_a_way: tuple[bool, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    ocp = pioneer(N=15)
    rti, recursion = (Rti(ocp, TIGHT, iterations=4, tolerance=0.0, compile=False) for _ in range(2))
    ((x0, y_ref, u_prev),) = near_the_eight(ocp, seed=25, count=1)
    assert rti.active_set is not None
    solve, ways = rti.active_set.solve, iter(finds_a_way)
    monkeypatch.setattr(rti.active_set, "solve", lambda: next(ways) and solve())
    for one in (rti, recursion):
        one.reset(x0, u_prev)
        one.prepare(y_ref, shift=False)
        assert one.feedback(x0).usable
        assert one.taken == 4
    assert rti.status is (QpStatus.SOLVED if finds_a_way[-1] else QpStatus.INACCURATE), "what the backup solves to its tolerance is not certified"
    np.testing.assert_allclose(rti.u, recursion.u, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"iterations": 0}, "iterations must be a whole number of at least 1, got 0"),
        ({"tolerance": -1.0}, "tolerance must not be negative, got -1.0"),
        ({"tolerance": np.nan}, "tolerance must not be negative, got nan"),
    ],
)
def test_limits_of_iterations_that_make_no_sense_are_refused(limits: dict[str, Any], message: str) -> None:
    with pytest.raises(OcpError, match=message):
        Rti(double_integrator(), compile=False, **limits)


# What it preserves.


@pytest.mark.parametrize("settings", [TIGHT, SolverSettings()], ids=["tight", "default"])
def test_mirrored_state_and_reference_give_the_mirrored_command(settings: SolverSettings) -> None:
    """Mirrored at the x axis: y, psi, omega and omega_c change sign. The model's cross terms are even in omega, or odd with it."""
    ocp = pioneer(N=20)
    rti = Rti(ocp, settings, compile=False)
    for x0, y_ref, u_prev in near_the_eight(ocp, seed=5, count=10):
        iterate(rti, x0, y_ref, u_prev, iterations=3)
        u = rti.u.copy()
        iterate(rti, x0 * [1, -1, -1, 1, -1], y_ref * [1, -1, -1], u_prev * [1, -1], iterations=3)
        np.testing.assert_allclose(rti.u, u * [1, -1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("turn_rad", [0.7, np.pi, -2.5])
def test_state_and_reference_rotated_and_shifted_give_the_same_command(turn_rad: float) -> None:
    ocp = pioneer(N=20)
    rti = Rti(ocp, TIGHT, compile=False)
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    turn = np.array([[c, -s], [s, c]])

    def moved(rows: Array) -> Array:
        rows = rows.copy()
        rows[..., :2] = rows[..., :2] @ turn.T + [0.4, -0.3]
        rows[..., 2] += turn_rad
        return rows

    for x0, y_ref, u_prev in near_the_eight(ocp, seed=6, count=10):
        iterate(rti, x0, y_ref, u_prev, iterations=3)
        u = rti.u.copy()
        iterate(rti, moved(x0), moved(y_ref), u_prev, iterations=3)
        np.testing.assert_allclose(rti.u, u, rtol=0, atol=1e-6)


def test_headings_a_full_turn_on_change_nothing() -> None:
    """In state and reference alike: no angle is wrapped inside."""
    ocp = pioneer()
    rti = Rti(ocp, TIGHT)
    ((x0, y_ref, u_prev),) = near_the_eight(ocp, seed=7, count=1)
    iterate(rti, x0, y_ref, u_prev, iterations=3)
    u = rti.u.copy()
    iterate(rti, x0 + np.array([0, 0, 2 * np.pi, 0, 0]), y_ref + np.array([0, 0, 2 * np.pi]), u_prev, iterations=3)
    np.testing.assert_allclose(rti.u, u, rtol=0, atol=1e-7)


@pytest.mark.parametrize("max_iter", slow_but([1, 5, 4000], 1))
def test_inputs_are_exactly_inside_bounds_and_increments_whatever_the_solvers_tolerance(max_iter: int) -> None:
    ocp = pioneer(N=20)
    rti = Rti(ocp, SolverSettings(eps=1e-2, max_iter=max_iter, check_termination=1))
    touched = 0
    for x0, y_ref, u_prev in near_the_eight(ocp, seed=8, count=100):
        rti.reset(x0, u_prev)
        for _ in range(3):
            rti.prepare(y_ref, shift=False)
            assert rti.feedback(x0).usable
            lowest, highest = np.maximum(ocp.lbu, -INF), ocp.ubu
            assert np.all(rti.u >= lowest)
            assert np.all(rti.u <= highest)
            last = u_prev
            for u in rti.u:
                assert np.all(u <= last + ocp.ubdu)
                assert np.all(u >= last + ocp.lbdu)
                touched += bool(np.any((u == lowest) | (u == highest) | (u == last + ocp.ubdu) | (u == last + ocp.lbdu)))
                last = u
    assert touched > 100


def test_same_inputs_give_the_same_bits() -> None:
    """Two controllers side by side, one of them started later."""
    ocp = pioneer(N=20)
    first, second = Rti(ocp), Rti(ocp)
    for x0, y_ref, u_prev in near_the_eight(ocp, seed=9, count=5):
        for rti in (first, second):
            rti.reset(x0, u_prev)
            for shift in (False, True, True):
                rti.prepare(y_ref, shift=shift)
                rti.feedback(x0)
        for one, other in zip(unmoving(first), unmoving(second), strict=True):
            np.testing.assert_array_equal(one, other)


def test_past_is_forgotten_by_a_reset() -> None:
    ocp = pioneer(N=20)
    used, new = Rti(ocp), Rti(ocp)
    *earlier, (x0, y_ref, u_prev) = near_the_eight(ocp, seed=10, count=4)
    for sample in earlier:
        iterate(used, *sample, iterations=3)
    for rti in (used, new):
        iterate(rti, x0, y_ref, u_prev, iterations=2)
    for one, other in zip(unmoving(used), unmoving(new), strict=True):
        np.testing.assert_array_equal(one, other)


def test_compiled_and_interpreted_plans_are_equal_to_rounding() -> None:
    ocp = pioneer()
    compiled, interpreted = Rti(ocp, TIGHT), Rti(ocp, TIGHT, compile=False)
    for x0, y_ref, u_prev in near_the_eight(ocp, seed=11, count=5):
        for rti in (compiled, interpreted):
            iterate(rti, x0, y_ref, u_prev, iterations=2)
        np.testing.assert_allclose(compiled.u, interpreted.u, rtol=0, atol=1e-8)  # rounding, as ADMM passes it on at eps 1e-9


# The two phases.


def test_shift_moves_the_guess_on_by_one_stage() -> None:
    ocp = pioneer(N=6, N_u=3)
    rti = Rti(ocp, compile=False)
    ((x0, y_ref, u_prev),) = near_the_eight(ocp, seed=12, count=1)
    iterate(rti, x0, y_ref, u_prev, iterations=2)
    x, u, _ = unmoving(rti)
    rti.shift()
    np.testing.assert_array_equal(rti.u_prev, u[0])
    np.testing.assert_array_equal(rti.u, u[[1, 2, 2]])
    np.testing.assert_array_equal(rti.x[:-1], x[1:])
    np.testing.assert_allclose(rti.x[-1], np.array(ocp.phi()(x[-1], u[-1], rti.p[-1])).ravel(), atol=1e-15)


def test_previous_input_may_be_another_than_the_plans() -> None:
    """Increments are bounded relative to it."""
    ocp = pioneer()
    rti = Rti(ocp, TIGHT)
    ((x0, y_ref, _),) = near_the_eight(ocp, seed=13, count=1)
    rti.reset(x0, np.array([0.4, 0.0]))
    rti.prepare(y_ref, shift=True, u_prev=np.array([-0.3, 0.1]))
    rti.feedback(x0)
    assert -0.55 <= rti.u[0, 0] <= -0.05 + 1e-15  # of rounding


def test_stage_parameters_act_and_stay_until_others_come() -> None:
    ocp = beacon()
    rti, fresh = Rti(ocp, TIGHT, compile=False), Rti(ocp, TIGHT, compile=False)
    y_ref, x0 = np.tile([4.0, 0.3], (ocp.N, 1)), np.array([0.1, 0.2, 0.3])
    p = np.tile([2.0, 4.0], (ocp.N + 1, 1))
    rti.reset(x0, np.zeros(2))
    rti.prepare(y_ref, p, shift=False)
    rti.feedback(x0)
    u = rti.u.copy()
    fresh.reset(x0, np.zeros(2))
    fresh.prepare(y_ref, shift=False)
    fresh.feedback(x0)
    assert np.abs(fresh.u - u).max() > 0.1
    rti.reset(x0, np.zeros(2))
    rti.prepare(y_ref, shift=False)
    rti.feedback(x0)
    np.testing.assert_array_equal(rti.u, u)


def test_shapes_that_do_not_fit_are_refused_by_name() -> None:
    rti = Rti(pioneer())
    with pytest.raises(ShapeError, match=r"y_ref must be an array of shape \(7, 3\), got float64 of shape \(8, 3\)"):
        rti.prepare(np.zeros((8, 3)))
    with pytest.raises(ShapeError, match=r"p must be .* \(8, 7\), got float64 of shape \(7, 7\)"):
        rti.prepare(np.zeros((7, 3)), np.zeros((7, 7)))


@pytest.mark.parametrize("kind", [np.float32, np.int64])
def test_references_of_other_types_and_layouts_are_read_right(kind: Any) -> None:
    """They are copied into owned memory: what reaches OSQP is never the caller's array."""
    ocp = pioneer()
    one, other = Rti(ocp), Rti(ocp)
    y_ref = np.round(4 * arc(np.arange(1, 8) * 5.0)).astype(kind)
    x0 = np.zeros(10)[::2]
    for rti, rows in ((one, y_ref.astype(np.float64)), (other, np.asfortranarray(y_ref))):
        rti.prepare(rows, shift=False)
        rti.feedback(x0)
    np.testing.assert_array_equal(one.u, other.u)


# How it fails.


def fails_and_recovers(rti: Rti, bad: Any, good: Any) -> None:
    """A failed sample leaves the plan, and after good data two samples are as if nothing had happened."""
    u_prev = rti.u_prev.copy()
    good(rti)
    x0 = rti.x[0].copy()
    rti.reset(x0, u_prev)
    for _ in range(3):
        good(rti)
    without = rti.u.copy()
    rti.reset(x0, u_prev)
    good(rti)
    before = unmoving(rti)
    status = bad(rti)
    assert not status.usable
    assert rti.status is status
    for now, then in zip(unmoving(rti), before, strict=True):
        np.testing.assert_array_equal(now, then)
    for _ in range(2):
        assert good(rti).usable
    np.testing.assert_allclose(rti.u, without, rtol=0, atol=1e-6)


def held(x0: Array, y_ref: Array) -> Any:
    def good(rti: Rti) -> QpStatus:
        rti.prepare(y_ref, shift=False)
        return rti.feedback(x0)

    return good


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_state_that_is_not_finite_or_beyond_all_reason_fails_and_is_forgotten(formulation: str) -> None:
    ocp = pioneer()
    ((x0, y_ref, _),) = near_the_eight(ocp, seed=14, count=1)
    rti = Rti(ocp, TIGHT, formulation=formulation)
    for value in (np.nan, INF, -INF, 1e100, 1e200, 1e308):
        for entry in (0, 2, 4):
            broken = x0.copy()
            broken[entry] = value

            def bad(rti: Rti, broken: Array = broken) -> QpStatus:
                rti.prepare(y_ref, shift=False)
                return rti.feedback(broken)

            fails_and_recovers(rti, bad, held(x0, y_ref))


def test_parameters_out_of_all_proportion_fail_without_a_word_on_stdout(capfd: pytest.CaptureFixture[str]) -> None:
    """OSQP prints a message if it cannot factorize, and a pipe without a reader would block the sample."""
    ocp = pioneer()
    ((x0, y_ref, _),) = near_the_eight(ocp, seed=21, count=1)
    huge = np.tile(1e200 * np.array(ocp.model.p_nominal), (ocp.N + 1, 1))

    def bad(rti: Rti) -> QpStatus:
        rti.prepare(y_ref, huge, shift=False)
        return rti.feedback(x0)

    def good(rti: Rti) -> QpStatus:
        rti.prepare(y_ref, 1e-200 * huge, shift=False)
        return rti.feedback(x0)

    fails_and_recovers(Rti(ocp, TIGHT, solver="osqp", formulation="simultaneous", compile=False), bad, good)
    assert not "".join(capfd.readouterr())


def test_reference_that_is_not_finite_fails_and_is_forgotten() -> None:
    ocp = pioneer()
    ((x0, y_ref, _),) = near_the_eight(ocp, seed=15, count=1)

    def bad(rti: Rti) -> QpStatus:
        broken = y_ref.copy()
        broken[3, 1] = np.nan
        rti.prepare(broken, shift=False)
        return rti.feedback(x0)

    fails_and_recovers(Rti(ocp, TIGHT), bad, held(x0, y_ref))


def test_model_that_returns_nan_fails_and_is_forgotten() -> None:
    """The square root of what a parameter may make negative: in the matrices too."""
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
    model = Model(
        "root", x, u, u - x * ca.sqrt(p), x, (Signal("x", "m"),), (Signal("u", "m/s"),), (Signal("x", "m"),), p, (Signal("p", "1"),), (0.25,)
    )
    ocp = Ocp(model, N=5, dt=0.1, Q=[1.0], R=[0.1], lbu=-1.0, ubu=1.0)
    x0, y_ref, good_p = np.zeros(1), np.ones((5, 1)), np.full((6, 1), 0.25)

    def good(rti: Rti) -> QpStatus:
        rti.prepare(y_ref, good_p, shift=False)
        return rti.feedback(x0)

    def bad(rti: Rti) -> QpStatus:
        rti.prepare(y_ref, -good_p, shift=False)
        return rti.feedback(x0)

    fails_and_recovers(Rti(ocp, TIGHT), bad, good)


def test_model_that_is_finite_nowhere_is_refused() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    model = Model("pole", x, u, u / ca.sqrt(-1 - x**2), x, (Signal("x", "m"),), (Signal("u", "m/s"),), (Signal("x", "m"),))
    with pytest.raises(OcpError, match="model pole must be finite and differentiable at a nominal state: give one, x_nominal"):
        Rti(Ocp(model, N=5, dt=0.1, Q=[1.0], R=[0.1]))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_infeasible_qp_leaves_the_plan_and_the_next_solve_is_right(formulation: str) -> None:
    """Bounds that contradict each other cannot be built: they are forced into the QP."""
    ocp = pioneer()
    ((x0, y_ref, _),) = near_the_eight(ocp, seed=16, count=1)

    def bad(rti: Rti) -> QpStatus:
        rti.prepare(y_ref, shift=False)
        contradict(rti)
        return rti.feedback(x0)

    fails_and_recovers(Rti(ocp, TIGHT, formulation=formulation, solver="osqp", compile=False), bad, held(x0, y_ref))


def test_failed_solve_never_seeds_the_next() -> None:
    """The next samples are those after a cold start, bit for bit."""
    ocp = pioneer()
    ((x0, y_ref, _),) = near_the_eight(ocp, seed=16, count=1)
    failed, cold = (Rti(ocp, solver="osqp", compile=False) for _ in range(2))
    good = held(x0, y_ref)
    for rti in (failed, cold):
        good(rti)
        rti.prepare(y_ref, shift=False)
    contradict(failed)
    assert failed.feedback(x0) is QpStatus.INFEASIBLE
    cold.solver.cold = True
    for rti in (failed, cold):
        good(rti)
    np.testing.assert_array_equal(failed.u, cold.u)
    assert failed.solver.iterations == cold.solver.iterations


def contradict(rti: Rti) -> None:
    """Ask inputs to stay, and to jump: the rows of their bounds come first, then those of their increments."""
    qp, n = rti.qp, rti.u.size
    rows = np.flatnonzero(qp.l < qp.u)
    inputs, increments = rows[:n], rows[n : 2 * n]
    qp.l[inputs] = qp.u[inputs] = 0.0
    qp.l[increments] = qp.u[increments] = 1.0


def test_feedback_touches_only_the_initial_state_rows() -> None:
    ocp = pioneer()
    rti = Rti(ocp, formulation="simultaneous", solver="osqp", iterations=1, compile=False)
    ((x0, y_ref, _),) = near_the_eight(ocp, seed=17, count=1)
    x0[3:] = 0.1, 0.2
    rti.reset(x0 - 0.01, np.zeros(2))
    rti.prepare(y_ref, shift=False)
    before = {name: getattr(rti.qp, name).copy() for name in ("q", "l", "u")} | {name: getattr(rti.qp, name).data.copy() for name in "PA"}
    deviation = x0 - rti.x[0]
    rti.feedback(x0)
    initial = slice(0, ocp.model.nx)
    for name in "lu":
        np.testing.assert_array_equal(getattr(rti.qp, name)[initial], deviation)
        before[name][initial] = deviation
        np.testing.assert_array_equal(getattr(rti.qp, name), before[name])
    np.testing.assert_array_equal(rti.qp.q, before["q"])
    np.testing.assert_array_equal(rti.qp.P.data, before["P"])
    np.testing.assert_array_equal(rti.qp.A.data, before["A"])


def test_arrays_never_move() -> None:
    """Compiled code keeps their addresses."""
    ocp = pioneer()
    rti = Rti(ocp)
    arrays = (rti.x, rti.u, rti.u_prev, rti.y_ref, rti.p)
    addresses = [array.ctypes.data for array in arrays]
    for sample in near_the_eight(ocp, seed=18, count=3):
        iterate(rti, *sample, iterations=2)
    assert [a.ctypes.data for a in (rti.x, rti.u, rti.u_prev, rti.y_ref, rti.p)] == addresses


def test_prepare_and_feedback_do_not_grow_the_heap() -> None:
    ocp = pioneer()
    rti = Rti(ocp)
    ((x0, y_ref, u_prev),) = near_the_eight(ocp, seed=19, count=1)
    iterate(rti, x0, y_ref, u_prev, iterations=20)
    tracemalloc.start()
    for _ in range(5):
        rti.prepare(y_ref)
        rti.feedback(x0)
    before, _ = tracemalloc.get_traced_memory()
    for _ in range(200):
        rti.prepare(y_ref)
        rti.feedback(x0)
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 1024


@pytest.mark.parametrize(
    ("solver", "samples"),
    [
        ("riccati", 8_000),
        pytest.param("riccati", 100_000 if "CI" in os.environ else 1_000_000, marks=pytest.mark.slow),
        pytest.param("osqp", 20_000 if "CI" in os.environ else 200_000, marks=pytest.mark.slow),
    ],
)
def test_resident_memory_stays_flat(solver: str, samples: int) -> None:
    """Memory that tracemalloc does not see: that of compiled code and OSQP, with failures and cold starts."""
    ocp = pioneer()
    rti = Rti(ocp, SolverSettings(eps=1e-3, max_iter=50), solver=solver)
    known = list(near_the_eight(ocp, seed=20, count=50))
    bad = np.full(5, np.nan)
    looks, looked = np.linspace(2_000, samples - 1, PARTS + 1).astype(int).tolist(), []
    for i in range(samples):
        x0, y_ref, u_prev = known[i // 20 % 50]
        if i % 20 == 0:
            rti.reset(x0, u_prev)
        rti.prepare(y_ref, u_prev=u_prev)
        rti.feedback(bad if i % 100 == 7 else x0)
        if i in looks:
            looked.append(anonymous_bytes())
    assert leaked_bytes(looked) < 1 << 20, looked


@pytest.mark.parametrize("solver", ["riccati", "osqp"])
def test_kept_guess_becomes_the_plan(solver: str) -> None:
    rti = Rti(pioneer(N=5), solver=solver, compile=False)
    rti.prepare(np.tile([1.0, 0.5, 0.0], (5, 1)), shift=False)
    assert rti.feedback(np.zeros(5)).usable
    guess = {name: rti.guess.sample[name].copy() for name in ("x", "u")}
    assert np.abs(rti.u - guess["u"]).max() > 1e-3, "the plan is another one"
    rti.keep_guess()
    np.testing.assert_array_equal(rti.x, guess["x"])
    np.testing.assert_array_equal(rti.u, guess["u"])


def test_whole_qp_is_the_one_with_softened_bounds_until_the_next_start() -> None:
    rti = Rti(pioneer(N=5, lbx=[-INF, -INF, -INF, -0.2, -INF], ubx=[INF, INF, INF, 0.2, INF]), solver="osqp", compile=False)
    assert len(rti.solvers) == 2
    rti.use_whole_qp()
    rti.prepare(np.zeros((5, 3)), shift=False)
    assert rti.solve_qp().usable
    assert rti.qp is rti.solvers[1].qp
    rti.reset(np.zeros(5), np.zeros(2))
    assert rti.qp is rti.solvers[0].qp


def test_list_of_what_is_compiled_leaves_the_qp_behind_an_active_set_out() -> None:
    ocp = pioneer(N=5)
    transcription = simultaneous(ocp, softened=False)
    assert natives([transcription], None) == [transcription.data, transcription.embed, transcription.step]
    listed = [re.sub("_[0-9a-f]{16}$", "", function.name()) for function in natives([transcription], (places(ocp), certificate(ocp)))]
    of_qp = ["linearize", "advance", "gains", "roll_out", "roll_out_again", "move_on", "refine", "begin", "enter", "step"]
    assert listed == [*of_qp, "certificate"]


def test_robot_whose_horizon_is_much_shorter_than_its_way_comes_to_its_path() -> None:
    """Inputs that act for 20 ms move it by millimetres, and hardly lower the cost of what it is away: damped by all of that it would creep."""
    dt, delta = 0.001, np.full(20, 28.0)
    delta[-1] += 28.0 / dt  # for the second after the horizon
    rti = Rti(pioneer(N=20, dt=dt, delta=delta, ubx=INF, lbx=-INF), iterations=1, compile=False)
    plant, x, u = rti.ocp.phi(), np.array([0.0, 0.3, 0.0, 0.25, 0.0]), np.array([0.25, 0.0])
    rti.reset(x, u)
    for k in range(round(1.0 / dt)):
        t = dt * np.arange(k + 1, k + 21)
        rti.prepare(np.column_stack([0.25 * t, 0 * t, 0 * t]), shift=k > 0, u_prev=u)
        assert rti.feedback(x) is QpStatus.SOLVED
        u = rti.u[0].copy()
        x = np.array(plant(x, u, rti.ocp.model.p_nominal)).ravel()
    assert abs(x[1]) < 0.15  # half of it in a second; undamped it is at 0.12


@needs_compiler
def test_reference_that_costs_nothing_but_rounding_is_met_by_compiled_code() -> None:
    """With a weight on one combination of outputs the cost may be as little as -1e-14, which has no root."""
    combination = np.array([1.0, 3.0, 0.0])
    rti, costs = Rti(pioneer(N=3, Q=np.outer(combination, combination), ubx=INF, lbx=-INF)), []
    x0 = np.zeros(5)
    for seed in range(40):
        away = 10.0 * np.random.default_rng(seed).normal(size=3)
        rti.reset(x0, np.zeros(2))
        rti.prepare(np.column_stack([3.0 * away, -away, 0.0 * away]))
        assert rti.feedback(x0) is QpStatus.SOLVED
        costs.append(rti.cost)
    assert min(costs) < 0.0 < max(costs) < 1e-8  # rounding of distances of tens of metres


@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("beside_m", [0.02, 1.0])
def test_metres_behind_its_reference_a_robot_does_not_swing(iterations: int, beside_m: float) -> None:
    """Undamped, full steps turn it at the slew limit, to and fro, at nine samples of ten; converged NMPC hardly turns it."""
    ocp = pioneer(N=20, method="rk4")
    rti = Rti(ocp, iterations=iterations, compile=False)
    plant, x, turns = ocp.phi(), np.array([-4.0, beside_m, 0.0, 0.0, 0.0]), []
    rti.reset(x, np.zeros(2))
    for k in range(50):
        t = 0.1 * np.arange(k + 1, k + 21)
        rti.prepare(np.column_stack([0.5 * t, 0 * t, 0 * t]), shift=k > 0)
        assert rti.feedback(x).usable
        turns.append(rti.u[0, 1])
        x = np.array(plant(x, rti.u[0], ocp.model.p_nominal)).ravel()
    assert np.abs(np.diff(turns[10:])).max() < 0.05  # of a slew limit of 0.4
