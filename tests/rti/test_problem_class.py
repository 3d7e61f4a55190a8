# SPDX-License-Identifier: Apache-2.0
"""
What a problem may have beside bounds and a quadratic cost: each held against IPOPT on the same problem, in every formulation and built-in solver.

Each problem is solved from states around its reference, with a cold start, until inputs
change no more. With the recursion each plan is certified.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import OcpError
from rti_mpc.model.model import Model, Signal
from rti_mpc.rti.construction import FORMULATIONS
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.places import places
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import BUILT_IN_SOLVERS, Rti
from rti_mpc.rti.simulation import simulate
from rti_mpc_service.bench.families import quadrotor_model
from tests.oracle import nlp
from tests.slow import slow_but

EXACT = SolverSettings(eps=1e-6, max_iter=200_000, polish=5)  # of OSQP: once the bounds that act are known, polishing solves the rest exactly
POSE = (Signal("x", "m"), Signal("y", "m"), Signal("psi", "rad", angle=True))
LIMITS: dict[str, Any] = {"N": 8, "dt": 0.1, "Q": [1.0, 1.0, 0.05], "R": [0.2, 0.1], "lbu": [-0.5, -0.8], "ubu": [0.5, 0.8]}
LIMITS |= {"lbdu": [-0.25, -0.4], "ubdu": [0.25, 0.4]}
BENDS: dict[str, Any] = {"lbddu": [-0.06, -0.1], "ubddu": [0.06, 0.12], "zddu": 10.0, "Zddu": 10.0}


def lagging_car(lag_s: float = 0.01, **changes: Any) -> Ocp:
    """A car whose speeds follow within 10 ms, against friction: stiff at stages of 0.1 s."""
    x, u = ca.SX.sym("x", 5), ca.SX.sym("u", 2)
    v, w = x[3], x[4]
    f = [v * ca.cos(x[2]), v * ca.sin(x[2]), w, (u[0] - v - 0.1 * ca.tanh(5 * v)) / lag_s, (u[1] - w - 0.2 * v * w) / lag_s]
    model = Model("lagging_car", x, u, f, x[:3], (*POSE, Signal("v", "m/s"), Signal("w", "rad/s")), ("v_c", "w_c"), POSE)
    narrow = {"lbx": [-np.inf] * 3 + [-0.35, -0.5], "ubx": [np.inf] * 3 + [0.35, 0.5]}
    return Ocp(model, **LIMITS | narrow | changes)


def sampled_car(**changes: Any) -> Ocp:
    """A car in discrete time: it drives an arc in each period, and its speed follows by a half."""
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 2)
    v, turn = 0.5 * (x[3] + u[0]), 0.1 * u[1]
    after = [x[0] + 0.1 * v * ca.cos(x[2] + turn / 2), x[1] + 0.1 * v * ca.sin(x[2] + turn / 2), x[2] + turn, v]
    signals = {"states": (*POSE, Signal("v", "m/s")), "inputs": ("v_c", "w_c"), "outputs": POSE}
    model = Model(name="sampled_car", x=x, u=u, disc_dyn_expr=after, dt=0.1, y_expr=x[:3], **signals)
    return Ocp(model, **LIMITS | {"lbx": [-np.inf] * 3 + [-0.35], "ubx": [np.inf] * 3 + [0.35]} | changes)


def felt_car(**changes: Any) -> Ocp:
    """The same car, whose passengers feel what it does sideways, and whose battery what it draws: outputs of states and inputs together."""
    model = sampled_car().model
    (*_, v), (v_c, w_c) = ca.vertsplit(model.x), ca.vertsplit(model.u)
    y_expr = ca.vertcat(model.y_expr, v * w_c + 0.3 * w_c**3, v_c * (v_c - 0.5 * v), w_c)
    felt = replace(model, y_expr=y_expr, outputs=(*POSE, Signal("sideways", "m/s2"), Signal("drawn", "W"), Signal("turn", "rad/s")))
    Q = np.diag([1.0, 1.0, 0.05, 2.0, 0.5, 0.1])
    Q[3, 0] = Q[0, 3] = 0.3
    return Ocp(felt, **LIMITS | {"Q": Q, "lbx": [-np.inf] * 3 + [-0.35], "ubx": [np.inf] * 3 + [0.35]} | changes)


COUPLED = np.array([[0.2, 0.08], [0.08, 0.1]])
CHANGING = np.column_stack([np.linspace(0.2, 3, 8), [2, 0, 1, 0.5, 0, 4, 0.3, 1]])
NONE = np.inf
FALLING = np.array([0.06, 0.05, NONE, 0.04, 0.03, NONE, NONE, 0.02])
NARROWING = {
    "lbu": np.column_stack([np.linspace(-0.5, -0.3, 8), np.full(8, -0.8)]),
    "ubu": np.column_stack([np.linspace(0.5, 0.3, 8), np.full(8, 0.8)]),
    "lbdu": np.column_stack([np.linspace(-0.25, -0.1, 8), np.full(8, -0.4)]),
}
AT_SOME_STAGES = {
    "lbu": np.column_stack([np.full(8, -0.5), [-NONE, -0.8, -NONE, -0.4, -0.4, -0.4, -0.4, -0.4]]),
    "ubu": np.column_stack([[0.5, NONE, NONE, 0.3, 0.3, 0.3, 0.3, NONE], np.full(8, 0.8)]),
    "lbdu": -NONE,
    "ubdu": np.column_stack([[NONE, NONE, 0.2, 0.2, 0.2, 0.2, NONE, 0.2], np.full(8, NONE)]),
}
PENALTIES = np.column_stack([np.ones((8, 3)), [0.001, 3, 0.003, 0.01, 2, 0.001, 0.02, 5]])  # far below and above the multipliers of hard bounds
SLOWING = {"ubx": np.column_stack([np.full((8, 3), NONE), [NONE, NONE, 0.35, 0.3, NONE, 0.25, 0.3, 0.2]])}


def carried_over_car(**changes: Any) -> Ocp:
    """The car in MX, with its constraint, which the model then has; its rates are a function of CasADi's, as a model that others wrote."""
    x, u = ca.MX.sym("x", 4), ca.MX.sym("u", 2)
    given = {name: ca.SX.sym(name, size) for name, size in (("x", 4), ("u", 2))}
    turn = 0.1 * given["u"][1]
    v = 0.5 * (given["x"][3] + given["u"][0])
    heading = given["x"][2] + turn / 2
    after = given["x"][:2] + 0.1 * v * ca.vertcat(ca.cos(heading), ca.sin(heading))
    moved = ca.Function("moved", [*given.values()], [ca.vertcat(after, given["x"][2] + turn, v)])
    signals = {"states": (*POSE, Signal("v", "m/s")), "inputs": ("v_c", "w_c"), "outputs": POSE, "constraints": "pull"}
    model = Model(name="carried_over_car", x=x, u=u, disc_dyn_expr=moved(x, u), dt=0.1, y_expr=x[:3], h_expr=x[3] * u[1], **signals)
    return Ocp(model, **LIMITS | changes)


def pulled_car(**changes: Any) -> Ocp:
    """The same car, whose sideways acceleration is bounded, a constraint of states and inputs."""
    ocp = sampled_car()
    given = {"model": ocp.model, "lbx": ocp.lbx, "ubx": ocp.ubx, "h_expr": ocp.model.x[3] * ocp.model.u[1]}
    return Ocp(**LIMITS | given | changes)


PROBLEMS: dict[str, Callable[[], Ocp]] = {
    "implicit integrator": lambda: lagging_car(method="irk"),
    "implicit integrator of three stages in two steps": lambda: lagging_car(method="irk", sim_method_num_stages=3, sim_method_num_steps=2, N_u=3),
    "explicit steps": lambda: lagging_car(sim_method_num_steps=8),
    "discrete time": sampled_car,
    "discrete time, held inputs": lambda: sampled_car(N_u=3),
    "weights of inputs": lambda: sampled_car(R_u=[0.8, 0.3], u_ref=[0.1, -0.2]),
    "weights of inputs, held inputs": lambda: sampled_car(R_u=[0.8, 0.0], N_u=3),
    "weights of inputs alone": lambda: lagging_car(method="irk", R_u=[0.05, 0.2], R=[0.0, 0.0]),
    "outputs of inputs": felt_car,
    "outputs of inputs, held inputs, weight at the end": lambda: felt_car(N_u=3, Q_e=[0.5, 0.5, 0.0, 1.0, 0.0, 0.5]),
    "outputs of inputs beside weights of inputs": lambda: felt_car(R_u=[0.05, 0.2], u_ref=[0.1, -0.1], N_u=5),
    "weights by stage": lambda: sampled_car(delta=np.column_stack([np.linspace(0.2, 3, 8), np.linspace(2, 0.1, 8), [0, 0, 0, 1, 0, 4, 0, 8]])),
    "weights by stage of outputs of inputs, held inputs": lambda: felt_car(delta=np.linspace(0.1, 2, 48).reshape(8, 6), N_u=3),
    "blocks": lambda: sampled_car(blocks=[1, 1, 2, 4]),
    "blocks, implicit integrator": lambda: lagging_car(method="irk", blocks=[1, 2, 5]),
    "blocks, the first one longer, weights of inputs": lambda: sampled_car(blocks=[2, 1, 3, 2], R_u=[0.8, 0.3], u_ref=[0.1, -0.2]),
    "blocks, stages of their own between and after them": lambda: sampled_car(blocks=[3, 1, 2, 1, 1], lambda_=[1.0, 0.5, 2.0, 1.5, 0.3]),
    "blocks, outputs of inputs, weights by stage": lambda: felt_car(blocks=[1, 2, 2, 3], delta=np.linspace(0.1, 2, 48).reshape(8, 6)),
    "weights of increments by stage": lambda: sampled_car(R=COUPLED, lambda_=CHANGING),
    "weights of increments and of inputs by block": lambda: sampled_car(blocks=[1, 1, 2, 4], R=COUPLED, lambda_=CHANGING[::2], R_u=CHANGING[::-2]),
    "weights of increments and of inputs by stage, outputs of inputs": lambda: felt_car(N_u=3, lambda_=CHANGING[:3], R_u=0.02 * CHANGING[3:6]),
    "bounds of inputs and increments by stage": lambda: sampled_car(**NARROWING),
    "bounds of states and increments by block and stage": lambda: sampled_car(blocks=[1, 1, 2, 4], lbdu=NARROWING["lbdu"][::2], **SLOWING),
    "bounds at some stages alone": lambda: sampled_car(**AT_SOME_STAGES, **SLOWING),
    "bounds of a constraint by stage, held inputs": lambda: pulled_car(N_u=3, lh=np.array([[-NONE]] * 4 + [[-0.02]] * 4), uh=FALLING[:, None]),
    "bounds of a constraint on both sides": lambda: pulled_car(lh=-0.02, uh=0.02),
    "bounds of a constraint on both sides, held inputs": lambda: pulled_car(N_u=3, lh=-0.02, uh=0.02),
    "bounds of a constraint on both sides, no bounded states": lambda: pulled_car(lh=-0.02, uh=0.02, lbx=-NONE, ubx=NONE),
    "bounds of states and a constraint by stage, a terminal set": lambda: pulled_car(uh=FALLING[:, None], ubx_e=[NONE] * 3 + [0.1], **SLOWING),
    "slack weights by stage": lambda: sampled_car(lbx=-NONE, ubx=[NONE] * 3 + [0.25], z=PENALTIES, Z=PENALTIES[::-1]),
    "slack weights by stage, held inputs": lambda: sampled_car(N_u=3, lbx=-NONE, ubx=[NONE] * 3 + [0.25], z=PENALTIES, Z=0.0),
    "slack weights by stage of a constraint, held inputs": lambda: pulled_car(
        N_u=3, uh=FALLING[:, None], zh=PENALTIES[:, 3:], Zh=1.0, z=10.0, Z=10.0
    ),
    "slack weights by stage of the end alone": lambda: sampled_car(lbx=-NONE, ubx=NONE, ubx_e=[NONE] * 3 + [0.1], z=PENALTIES[::-1], Z=PENALTIES),
    "slack weights by stage beside bounds by stage, blocks": lambda: pulled_car(
        blocks=[1, 1, 2, 4], uh=FALLING[:, None], Zh=PENALTIES[:, 3:], zh=0.01, z=1.0, Z=1.0
    ),
    "slack weights by stage of a constraint, beside second differences, held inputs": lambda: pulled_car(
        N_u=3, uh=FALLING[:, None], zh=PENALTIES[:, 3:], Zh=1.0, z=10.0, Z=10.0, **BENDS
    ),
    "a model in MX": lambda: carried_over_car(N_u=3, uh=FALLING[:, None]),
    "outputs that count at the end alone": lambda: felt_car(Q=[1.0, 1.0, 0.05, 0, 0, 0], Q_e=[0, 0, 0, 2.0, 0.5, 0.1]),
    "fixed input": lambda: sampled_car(lbu=[-0.5, 0.3], ubu=[0.5, 0.3], lbdu=-np.inf, ubdu=np.inf),
    "terminal set": lambda: sampled_car(lbx_e=[-np.inf] * 3 + [-0.05], ubx_e=[np.inf] * 3 + [0.02]),
    "second differences": lambda: sampled_car(N=5, **BENDS),
    "second differences, large penalties": lambda: sampled_car(N=5, **BENDS | {"zddu": 1e3, "Zddu": 1e3}),
    "second differences, held inputs": lambda: sampled_car(N_u=3, **BENDS),
    "second differences, blocks": lambda: sampled_car(blocks=[1, 1, 2, 4], **BENDS),
    "second differences, blocks, the first one longer": lambda: sampled_car(blocks=[2, 1, 5], **BENDS),
    "second differences, implicit integrator, held inputs": lambda: lagging_car(method="irk", N_u=3, **BENDS),
    "second difference of one input, beside a terminal set and outputs of inputs": lambda: felt_car(
        N_u=3, ubx_e=[np.inf] * 3 + [0.02], lbddu=[-np.inf, -0.1], ubddu=[np.inf, 0.1], z=10.0, Z=10.0, zddu=10.0
    ),
    "terminal set, from above alone, held inputs": lambda: sampled_car(ubx_e=[np.inf] * 3 + [0.05], N_u=3, z=[1.0] * 4, Z=[0.0] * 4),
}


def around_a_bend(ocp: Ocp, count: int) -> list[tuple[Array, Array, Array]]:
    """States, references and previous inputs such that bounds of every kind act in some of them."""
    rng, found = np.random.default_rng(5), []
    t = ocp.dt * np.arange(1, ocp.N + 1)
    for _ in range(count):
        psi = rng.uniform(-3, 3) + 0.5 * t
        y_ref = np.column_stack([0.4 * np.cumsum(np.cos(psi)) * ocp.dt, 0.4 * np.cumsum(np.sin(psi)) * ocp.dt, psi])
        x0 = np.zeros(ocp.model.nx)
        x0[:3] = y_ref[0] + rng.normal(size=3) * [0.2, 0.2, 0.5]
        x0[3:] = rng.uniform(-0.3, 0.3, size=ocp.model.nx - 3)
        y_ref = np.pad(y_ref, ((0, 0), (0, ocp.model.ny - 3)))  # nothing is to be felt
        found.append((x0, y_ref, rng.uniform(-0.4, 0.4, size=2)))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("solver", BUILT_IN_SOLVERS)
@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("name", PROBLEMS)
def test_problem_is_solved_as_by_ipopt(name: str, formulation: str, solver: str) -> None:
    ocp = PROBLEMS[name]()
    rti, solve = Rti(ocp, EXACT, formulation=formulation, solver=solver, compile=False), nlp(ocp)
    bound = 0
    for x0, y_ref, u_prev in around_a_bend(ocp, 6):
        u_before = u_prev - [0.04, -0.07]
        rti.reset(x0, u_prev)
        x, u, cost = solve(x0, u_prev, y_ref, rti.x, rti.u, u_before)
        for _ in range(200):
            before = rti.u.copy()
            rti.prepare(y_ref, shift=False, u_before=u_before)
            assert rti.feedback(x0) is QpStatus.SOLVED
            if np.abs(rti.u - before).max() < 1e-9:
                break
        np.testing.assert_allclose(rti.u, u, rtol=0, atol=1e-6)
        np.testing.assert_allclose(rti.x, x, rtol=0, atol=1e-6)
        assert rti.cost == pytest.approx(cost, rel=1e-6)
        du = np.diff(np.vstack([u_prev, u]), axis=0)
        ddu = np.diff(np.vstack([u_prev - u_before, du]), axis=0)
        pairs = ((u, ocp.lbu, ocp.ubu), (du, ocp.lbdu, ocp.ubdu), (x[1:], ocp.lbx, ocp.ubx), (ddu, ocp.lbddu, ocp.ubddu))
        bound += any(bool(np.any(np.isclose(z, lower, atol=1e-6) | np.isclose(z, upper, atol=1e-6))) for z, lower, upper in pairs)
    assert bound >= 2  # in so many of them bounds act


@pytest.mark.parametrize(
    ("formulation", "solver"), slow_but(product(FORMULATIONS, BUILT_IN_SOLVERS), ("sequential", "riccati"), ("simultaneous", "osqp"))
)
def test_state_bound_with_a_large_penalty_is_hard_in_effect_and_what_exceeds_it_is_told(formulation: str, solver: str) -> None:
    """IPOPT has the bound as such, no slack. From outside it, where IPOPT finds no plan at all, the plan comes back as fast as inputs can."""
    ocp = sampled_car(z=1e5, Z=0.0)
    rti = Rti(ocp, EXACT, formulation=formulation, solver=solver, compile=False)
    hard = nlp(ocp, slacks=False)
    bound = 0
    for x0, y_ref, u_prev in around_a_bend(ocp, 4):
        rti.reset(x0, u_prev)
        x, u, _ = hard(x0, u_prev, y_ref, rti.x, rti.u)
        for _ in range(60):
            rti.prepare(y_ref, shift=False)
            assert rti.feedback(x0) is QpStatus.SOLVED
        np.testing.assert_allclose(rti.u, u, rtol=0, atol=1e-6)
        assert rti.violation < 1e-6
        bound += bool(np.any(np.abs(x[1:, 3]) > 0.35 - 1e-6))
    assert bound >= 2
    x0[3] = 1.5  # m/s, a measurement: the bound is 0.35
    rti.reset(x0, u_prev)
    rti.prepare(y_ref, shift=False)
    assert rti.feedback(x0).usable
    np.testing.assert_allclose(rti.violation, 0.5 * (1.5 + rti.u[0, 0]) - 0.35, rtol=0, atol=1e-6)


def test_bounds_at_the_end_alone_do_not_act_before_it() -> None:
    """A mass that must stand at the end of its horizon, and nowhere else."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    model = Model("mass", x, u, [x[1], u], x[0], ("r", "v"), "a", "r")
    rti = Rti(Ocp(model, N=10, dt=0.1, Q=1, R=1e-3, lbu=-2, ubu=2, lbx_e=[-np.inf, -1e-3], ubx_e=[np.inf, 1e-3]), compile=False)
    rti.reset(np.zeros(2), np.zeros(1))
    rti.prepare(np.ones((10, 1)))
    assert rti.feedback(np.zeros(2)) is QpStatus.SOLVED
    assert abs(rti.x[-1, 1]) < 1.1e-3
    assert rti.x[:-1, 1].max() > 0.5
    assert rti.violation < 1e-6


def test_weights_by_stage_are_retuned_as_if_the_problem_had_been_built_with_them() -> None:
    before, after = (np.linspace(*ends, 24).reshape(8, 3) for ends in ((0.5, 1.5), (2.0, 0.1)))
    built, retuned = (Rti(sampled_car(delta=delta), compile=False, iterations=20, tolerance=1e-9) for delta in (after, before))
    retuned.retune({"delta": after})
    x0, y_ref, u_prev = around_a_bend(built.ocp, 1)[0]
    for rti in (built, retuned):
        rti.reset(x0, u_prev)
        rti.prepare(y_ref, shift=False)
        assert rti.feedback(x0) is QpStatus.SOLVED
    np.testing.assert_allclose(retuned.u, built.u, rtol=0, atol=1e-7)  # each is converged in scales of its own
    assert retuned.cost == pytest.approx(built.cost, rel=1e-6)  # 1000 per unit by which a state exceeds its bound in rounding


def test_slack_weights_by_stage_let_a_bound_be_exceeded_where_they_are_small_and_are_retuned_as_if_built_with() -> None:
    """The bound is hard in effect at the end alone, soft before; rows that are all alike are the weights of all nodes."""
    at_the_end = np.full((8, 4), 1e-3)
    at_the_end[-1] = 1e3
    soft = {"lbx": -NONE, "ubx": [NONE] * 3 + [0.1], "Z": 0.0}
    options: dict[str, Any] = {"compile": False, "iterations": 50, "tolerance": 1e-9}
    built, retuned = (Rti(sampled_car(z=z, **soft), **options) for z in (at_the_end, at_the_end[::-1]))
    retuned.retune({"z": at_the_end})
    alike, constant = (Rti(sampled_car(z=z, **soft), **options) for z in (np.full((8, 4), 0.05), 0.05))
    for one, other in ((built, retuned), (alike, constant)):
        for rti in (one, other):
            rti.reset(np.zeros(4), np.zeros(2))
            rti.prepare(np.column_stack([0.04 * np.arange(1, 9), np.zeros((8, 2))]), shift=False)
            assert rti.feedback(np.zeros(4)) is QpStatus.SOLVED
        np.testing.assert_allclose(one.u, other.u, rtol=0, atol=1e-7)  # each is converged in scales of its own
    assert built.x[1:-1, 3].max() > 0.2
    assert built.x[-1, 3] < 0.1 + 1e-6


def test_weights_of_increments_by_stage_are_those_of_a_horizon_whose_stages_are_weighed_alike() -> None:
    """The factors of one input, all alike, are the factor of its weight: the same plan as from a sequence for all inputs."""
    x0, y_ref, u_prev = around_a_bend(sampled_car(), 1)[0]
    plans = []
    for changes in ({"lambda_": np.tile([2.0, 0.5], (8, 1)), "R_u": np.tile([0.3, 0.1], (8, 1))}, {"R": [0.4, 0.05], "R_u": [0.3, 0.1]}):
        rti = Rti(sampled_car(**changes), compile=False, iterations=20, tolerance=1e-9)
        rti.reset(x0, u_prev)
        rti.prepare(y_ref, shift=False)
        assert rti.feedback(x0) is QpStatus.SOLVED
        plans.append((rti.u.copy(), rti.cost))
    np.testing.assert_allclose(plans[0][0], plans[1][0], rtol=0, atol=1e-7)  # each is converged in scales of its own
    assert plans[0][1] == pytest.approx(plans[1][1], rel=1e-6)


def test_bounds_at_some_stages_alone_stay_certified_while_the_plan_is_shifted() -> None:
    """A place at a bound that moves on to a stage without one is a free one there."""
    moved = places(sampled_car(**AT_SOME_STAGES, **SLOWING)).advance(places=np.ones(2 * 16 + 8))["places_next"]
    there = (AT_SOME_STAGES["ubu"], AT_SOME_STAGES["ubdu"], SLOWING["ubx"][:, 3:])
    np.testing.assert_array_equal(np.array(moved).ravel(), np.concatenate([np.isfinite(bounds).ravel() for bounds in there]))
    rti, rng, x = Rti(sampled_car(**AT_SOME_STAGES, **SLOWING), compile=False), np.random.default_rng(7), np.array([0.0, 0.1, 0.2, 0.1])
    rti.reset(x, np.zeros(2))
    acted = False
    for k in range(15):
        psi = 0.05 * (k + np.arange(1, 9))
        rti.prepare(np.column_stack([0.04 * np.cumsum(np.cos(psi)) + 0.04 * k, 0.04 * np.cumsum(np.sin(psi)), psi]))
        assert rti.feedback(x) is QpStatus.SOLVED
        acted |= bool(np.any(rti.x[1:, 3] > SLOWING["ubx"][:, 3] - 1e-6))
        x = rti.x[1] + 0.01 * rng.normal(size=4)
    assert acted


def test_outputs_and_constraints_in_mx_are_those_in_sx() -> None:
    """A model carries its constraint over to SX; a constraint of a problem alone has no symbols there, and is refused with what to do."""
    plans, symbols = [], (ca.SX, ca.MX)
    for kind in symbols:
        x, u = kind.sym("x", 2), kind.sym("u")
        outputs, constraint = ca.vertcat(x[0], x[1] * u), x[1] + 0.5 * u
        model = Model("mass", x, u, ca.vertcat(x[1], u), outputs, ("r", "v"), "a", ("r", "power"), h_expr=constraint, constraints="reserve")
        rti = Rti(Ocp(model, N=6, dt=0.1, Q=[1, 0.1], R=1e-2, Q_e=[5, 0], lh=-1, uh=0.3), compile=False)
        rti.reset(np.zeros(2), np.zeros(1))
        rti.prepare(np.tile([1.0, 0.0], (6, 1)))
        assert rti.feedback(np.zeros(2)) is QpStatus.SOLVED
        plans.append(rti.u.copy())
    np.testing.assert_allclose(plans[1], plans[0], rtol=0, atol=1e-12)
    assert np.max(np.abs(plans[0])) > 0.1
    with pytest.raises(OcpError, match="h_expr must be SX, of the model's x, u, p, or be given to the Model"):
        Ocp(model, N=6, dt=0.1, Q=[1, 1], R=1, h_expr=x[0] * u)


def test_second_differences_that_cannot_be_kept_are_exceeded_by_as_little_as_can_be_and_the_excess_is_told() -> None:
    """An input that rises by 0.2 a sample is 0.1 below its upper bound: to stay below it must bend by 0.1 at least, and by no more than 0.06."""
    ocp = sampled_car(lbddu=[-0.06, -0.1], ubddu=[0.06, 0.1], lbx=-np.inf, ubx=np.inf)
    rti, solve = Rti(ocp, compile=False, iterations=50, tolerance=1e-10), nlp(ocp)
    x0, y_ref, u_prev, u_before = np.zeros(4), np.zeros((8, 3)), np.array([0.4, 0.0]), np.array([0.2, 0.0])
    y_ref[:, 0] = 0.5 * np.arange(1, 9)
    rti.reset(x0, u_prev)
    rti.prepare(y_ref, shift=False, u_before=u_before)
    assert rti.feedback(x0) is QpStatus.SOLVED
    _, u, _ = solve(x0, u_prev, y_ref, rti.x, rti.u, u_before)
    np.testing.assert_allclose(rti.u, u, rtol=0, atol=1e-6)
    ddu = np.diff(np.vstack([u_before, u_prev, rti.u]), 2, axis=0)
    assert rti.u.max() <= 0.5
    assert rti.violation == pytest.approx(np.abs(ddu[:, 0]).max() - 0.06, abs=1e-6)  # it is that of the plan before its refinement
    assert 0.04 < rti.violation < 0.061


def test_second_differences_are_counted_from_sample_to_sample() -> None:
    """Of the first two inputs of a plan each is sent in turn; the library remembers what came before."""
    rti = Rti(sampled_car(**BENDS | {"zddu": 1e3}), compile=False)
    x, sent = np.zeros(4), [np.zeros(2), np.zeros(2)]
    rti.reset(x, np.zeros(2))
    for k in range(25):
        rti.prepare(np.column_stack([0.04 * (k + np.arange(1, 9)), np.full((8, 2), 0.3 if k < 12 else -0.3)]))
        assert rti.feedback(x) is QpStatus.SOLVED
        sent.append(rti.u[0].copy())
        x = rti.x[1].copy()
    ddu = np.diff(sent, 2, axis=0)
    assert np.all(ddu <= np.array([0.06, 0.12]) + 1e-7)
    assert np.all(ddu >= np.array([-0.06, -0.1]) - 1e-7)
    assert np.isclose(ddu, [0.06, 0.12], atol=1e-7).any(axis=0).all()  # they act


def test_second_differences_are_retuned_as_if_the_problem_had_been_built_with_them() -> None:
    wide = {"lbddu": -0.2, "ubddu": [0.3, 0.2], "zddu": [5.0, 7.0], "Zddu": 1.0}
    built, retuned = (Rti(sampled_car(**bends), compile=False, iterations=50, tolerance=1e-9) for bends in (BENDS, wide))
    retuned.retune({name: getattr(built.ocp, name) for name in BENDS})
    for x0, y_ref, u_prev in around_a_bend(built.ocp, 3):
        for rti in (built, retuned):
            rti.reset(x0, u_prev)
            rti.prepare(y_ref, shift=False, u_before=u_prev)
            assert rti.feedback(x0) is QpStatus.SOLVED
        np.testing.assert_allclose(retuned.u, built.u, rtol=0, atol=1e-6)  # each is converged in scales of its own


def test_states_and_parameters_of_a_plan_are_those_of_the_model_whatever_solvers_remember() -> None:
    ocp = sampled_car(blocks=[1, 1, 2, 4], **BENDS)
    rti = Rti(ocp, compile=False)
    assert rti.ocp is ocp
    assert (rti.x.shape, rti.x0.shape, rti.p.shape, rti.x_nominal.shape) == ((9, 4), (4,), (9, 0), (4,))
    assert rti.problem.model.nx == 4 + 3 * 2
    plain = sampled_car()
    assert Rti(plain, compile=False).problem is plain


def test_reference_of_inputs_moves_with_the_parameters_of_the_stages() -> None:
    """A mass of one input, weighed alone: each stage's input is that stage's parameter."""
    x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
    model = Model("mass", x, u, u, x, "v", "a", "v", p=p, parameters="wanted", p_nominal=0.0)
    rti = Rti(Ocp(model, N=5, dt=0.1, Q=0, R=0, R_u=2.0, u_ref=p), compile=False)
    rti.reset(np.zeros(1), np.zeros(1))
    wanted = np.array([0.3, -0.2, 0.5, 0.1, 0.4, 9.0])
    rti.prepare(np.zeros((5, 1)), wanted[:, None])
    assert rti.feedback(np.zeros(1)) is QpStatus.SOLVED
    np.testing.assert_allclose(rti.u[:, 0], wanted[:5], rtol=0, atol=1e-9)
    assert rti.cost == pytest.approx(0.0, abs=1e-12)


def attitude(**changes: Any) -> Ocp:
    """A rigid body in space, turned by torques: a quaternion and body rates."""
    x, u = ca.SX.sym("x", 7), ca.SX.sym("u", 3)
    (w, i, j, k), rate = ca.vertsplit(x[:4]), x[4:]
    turning = ca.vertcat(-i, w, k, -j), ca.vertcat(-j, -k, w, i), ca.vertcat(-k, j, -i, w)
    f = ca.vertcat(0.5 * sum((turning[axis] * rate[axis] for axis in range(3)), ca.SX.zeros(4)), u - ca.cross(rate, ca.DM([1, 2, 3]) * rate))
    names = ("w", "i", "j", "k", "p", "q", "r")
    model = Model("attitude", x, u, f, x, names, ("t_p", "t_q", "t_r"), names, x_nominal=[1, 0, 0, 0, 0, 0, 0], quaternions=("w", "i", "j", "k"))
    own = {"N": 15, "dt": 0.1, "Q": [0, 1, 1, 1, 0.1, 0.1, 0.1], "R": [0.1] * 3, "lbu": -2, "ubu": 2, "lbdu": -1, "ubdu": 1}
    return Ocp(model, **own | changes)


def turned(axis: list[float], angle: float) -> Array:
    """The quaternion of a turn by an angle in rad."""
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis) / np.linalg.norm(axis))])


@pytest.mark.slow
@pytest.mark.parametrize("solver", BUILT_IN_SOLVERS)
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_quaternion_is_steered_by_its_small_angles_as_by_ipopt(formulation: str, solver: str) -> None:
    ocp = attitude()
    rti, solve = Rti(ocp, EXACT, formulation=formulation, solver=solver, compile=False), nlp(ocp)
    for axis, angle in (([1.0, 0.5, 0.2], 0.8), ([0.0, 1.0, -1.0], -1.5)):
        x0, y_ref = np.array([1.0, 0, 0, 0, 0.1, -0.2, 0.3]), np.tile([*turned(axis, angle), 0, 0, 0], (ocp.N, 1))
        rti.reset(x0, np.zeros(3))
        _, u, cost = solve(x0, np.zeros(3), y_ref, rti.x, rti.u)
        for _ in range(200):
            before = rti.u.copy()
            rti.prepare(y_ref, shift=False)
            assert rti.feedback(x0) is QpStatus.SOLVED
            if np.abs(rti.u - before).max() < 1e-9:
                break
        np.testing.assert_allclose(rti.u, u, rtol=0, atol=1e-6)
        assert rti.cost == pytest.approx(cost, rel=1e-6)


def test_quaternion_and_its_negative_are_one_attitude_and_the_shorter_way_round_is_taken() -> None:
    """By 2.5 rad, and by 2.5 rad less than a turn, from references and measurements of either sign; components themselves would go the long way."""
    ocp = attitude(N=20)
    phi = ocp.phi()
    rti = Rti(ocp, compile=False)
    for angle, shorter in ((2.5, 2.5), (2 * np.pi - 2.5, -2.5)):
        final = []
        for sign in (1.0, -1.0):
            goal, x = turned([0, 0, 1], angle), np.array([1.0, 0, 0, 0, 0, 0, 0])
            rti.reset(x, np.zeros(3))
            rates = []
            for sample in range(120):
                rti.prepare(np.tile([*(sign * goal), 0, 0, 0], (ocp.N, 1)))
                assert rti.feedback(x).usable
                x = np.array(phi(x, rti.u[0], [])).ravel()
                rates.append(x[6])
                if sign < 0 and sample == 30:
                    x[:4] *= -1.0
            assert abs(goal @ x[:4]) == pytest.approx(1.0, abs=1e-4)
            assert 0.1 * np.sum(rates) == pytest.approx(shorter, abs=0.1)
            final.append(rates)
        np.testing.assert_allclose(final[0][:30], final[1][:30], rtol=0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_quadrotor_of_13_states_flies_turns_whichever_sign_its_attitude_has(sign: float) -> None:
    """Its components compared with the reference, as without a quaternion, it would turn over from the other sign."""
    thirteen = quadrotor_model()
    names = tuple(signal.name for signal in thirteen.outputs[3:7])
    level = [0.0, 0.0, 0.0, sign] + 9 * [0.0]
    model = replace(thirteen, quaternions=names, x_nominal=level)
    ocp = Ocp(model, N=20, dt=0.03, Q=[1, 1, 1, 0, 0.1, 0.1, 0.1] + [0] * 6, R=[0.002] * 4, lbu=0, ubu=4, lbdu=-3, ubdu=3)

    def eight(t: Array) -> Array:
        still = np.zeros_like(t)
        attitude = np.cos(0.6 * t), still, still, np.sin(0.6 * t)  # more than a whole turn in 6 s
        return np.column_stack([np.sin(0.8 * t), 0.5 * np.sin(1.6 * t), 0.2 * np.sin(t), *attitude, *[still] * 6])

    run = simulate(Rti(ocp, compile=False), ocp.phi(), eight, x0=level, samples=200)
    assert set(run.status) == {QpStatus.SOLVED}
    assert np.abs(run.error[100:, :3]).max() < 0.02  # m, where it flies up to 1.1 m/s
    q, wanted = run.x[100:, 3:7], run.y_ref[100:, 3:7]
    assert 2 * np.arccos(np.minimum(np.abs(np.sum(q * wanted, axis=1)), 1.0)).max() < 0.2  # rad, by which it must tilt
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=0, atol=1e-6)
