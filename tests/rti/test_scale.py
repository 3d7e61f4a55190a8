# SPDX-License-Identifier: Apache-2.0
"""Units: the same robot in other units is driven the same way, by every solver, from the same guess."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.model.model import Model, Signal
from rti_mpc.model.path_following import path_following
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.rti.construction import FORMULATIONS
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.scale import scale
from tests.problems import INF, cart, double_integrator, pioneer
from tests.slow import slow_but

NEWTONS = {"N": 1.0, "kN": 1e3, "mN": 1e-3, "rpm": 0.05, "m/s^2": 1500.0}  # newtons of one unit of the input


def cart_ocp(newtons: float) -> Ocp:
    force, step = 5000 / newtons, 2000 / newtons
    return Ocp(cart(newtons), N=20, dt=0.1, Q=[1], R=[1e-7 * newtons**2], lbu=-force, ubu=force, lbdu=-step, ubdu=step, lbx=[-INF, -3], ubx=[INF, 3])


def driven(ocp: Ocp, solver: str, samples: int = 60) -> tuple[Array, Array, list[int], set[QpStatus]]:
    """Drive the cart to 30 m; return its commands, speeds, iterations per sample, and the statuses."""
    rti, phi, x = Rti(ocp, solver=solver, compile=False), ocp.phi(), np.zeros(2)
    commands, speeds, iterations, statuses = [], [], [], set()
    for _ in range(samples):
        rti.prepare(np.full((ocp.N, 1), 30.0))
        statuses.add(rti.feedback(x))
        x = np.array(phi(x, rti.u[0], [])).ravel()
        commands.append(rti.u[0].copy())
        speeds.append(x[1])
        iterations.append(rti.solver.iterations)
    return np.array(commands), np.array(speeds), iterations, statuses


@pytest.mark.parametrize("unit", slow_but(NEWTONS, "N", "mN", "m/s^2"))
def test_a_speed_bound_that_can_be_kept_is_kept_in_any_unit_of_the_force(unit: str) -> None:
    commands, speeds, iterations, statuses = driven(cart_ocp(NEWTONS[unit]), "riccati")
    theirs, _, their_iterations, _ = driven(cart_ocp(1000.0), "riccati")
    assert statuses == {QpStatus.SOLVED}
    assert speeds.max() == pytest.approx(3.0, abs=1e-6)  # it is reached, and rounding apart never exceeded
    np.testing.assert_allclose(commands * NEWTONS[unit] / 5000, theirs * 1000 / 5000, rtol=0, atol=1e-8)
    assert iterations == their_iterations


@pytest.mark.parametrize(("solver", "atol"), slow_but([("osqp", 1e-8), ("daqp", 1e-8), ("piqp", 1e-7)], ("osqp", 1e-8)))
@pytest.mark.parametrize("unit", ["N", "mN"])
def test_other_solvers_are_given_the_same_numbers_in_any_unit(solver: str, atol: float, unit: str) -> None:
    """So that OSQP takes the same steps, in spite of its loose tolerance."""
    commands, _, iterations, _ = driven(cart_ocp(NEWTONS[unit]), solver, samples=25)
    theirs, _, their_iterations, _ = driven(cart_ocp(1000.0), solver, samples=25)
    np.testing.assert_allclose(commands * NEWTONS[unit] / 5000, theirs * 1000 / 5000, rtol=0, atol=atol)
    assert iterations == their_iterations


def in_other_units(model: Model, x_units: Array, u_units: Array) -> Model:
    """Return a model whose states and inputs count so many of the old units each; its outputs are the old ones."""
    x, u = ca.SX.sym("x", model.nx), ca.SX.sym("u", model.nu)
    old = (ca.DM(x_units) * x, ca.DM(u_units) * u)
    f, y = (ca.substitute([expr], [model.x, model.u], [*old])[0] for expr in (model.f_expl_expr, model.y_expr))
    states = tuple(Signal(signal.name, f"{unit} {signal.unit}") for signal, unit in zip(model.states, x_units, strict=True))
    return Model(model.name, x, u, f / ca.DM(x_units), y, states, model.inputs, model.outputs, model.p, model.parameters, model.p_nominal)


@pytest.mark.parametrize("bounds", [True, False], ids=["bounds", "no_bounds"])
def test_kilometres_degrees_and_revolutions_per_minute_change_nothing(bounds: bool) -> None:
    """Of the shipped robot, nonlinear, state by state from the same guess; without bounds on inputs by the curvature of the cost alone."""
    x_units, u_units = np.array([1e3, 1e-3, np.pi / 180, 1e-2, 2 * np.pi / 60]), np.array([1e-3, 2 * np.pi / 60])
    unbounded = {} if bounds else {name: sign * INF for name, sign in (("lbu", -1), ("ubu", 1), ("lbdu", -1), ("ubdu", 1))}
    plain = pioneer(N=15, **unbounded)
    limits = {name: getattr(plain, name) / u_units for name in ("lbu", "ubu", "lbdu", "ubdu")}
    limits |= {name: getattr(plain, name) / x_units for name in ("lbx", "ubx")}
    weights = {"Q": plain.Q, "R": plain.R * np.outer(u_units, u_units), "z": plain.z * x_units, "Z": plain.Z * x_units**2}
    changed = Ocp(in_other_units(pioneer_3dx(), x_units, u_units), N=15, dt=0.1, delta=plain.delta, lambda_=plain.lambda_, **weights, **limits)
    one, other = (Rti(ocp, compile=False) for ocp in (plain, changed))
    phi = plain.phi()
    x = np.array([0.1, 0.02, 0.2, 0.45, -0.7])
    one.reset(x, np.zeros(2))
    other.reset(x / x_units, np.zeros(2))
    for k in range(25):
        t = 0.1 * np.arange(k + 1, k + 16)
        y_ref = np.column_stack([0.4 * t, 0.3 * np.sin(t), 0 * t])
        for rti, units in ((one, 1.0), (other, x_units)):
            rti.prepare(y_ref, shift=k > 0)
            assert rti.feedback(x / units) is QpStatus.SOLVED
        np.testing.assert_allclose(other.u * u_units / one.scale[5:7], one.u / one.scale[5:7], rtol=0, atol=1e-8)
        assert (other.taken, other.solver.iterations) == (one.taken, one.solver.iterations)
        for theirs, mine, units in ((other.x, one.x, x_units), (other.u, one.u, u_units)):
            theirs[:] = mine / units
        x = np.array(phi(x, one.u[0], plain.model.p_nominal)).ravel()


def test_scale_of_what_has_no_bounds_is_the_reach_of_the_inputs() -> None:
    """A mass pushed by at most 2 for a second: half a metre times two, and two metres per second."""
    ocp = double_integrator(lbu=-2.0, ubu=2.0)
    found = scale(ocp, np.zeros((11, 2)), np.zeros((10, 1)), np.zeros((10, 2)), np.zeros((11, 0)))
    np.testing.assert_allclose(found, [1.0, 2.0, 2.0], rtol=1e-12)


def test_scale_of_a_constraint_is_how_far_its_states_are_moved_in_any_direction() -> None:
    """A robot that drives along x hardly reaches sideways within two stages; that position has the scale of the other one all the same."""
    model = pioneer_3dx()
    away = 3.0 * model.x[1] - 4.0 * model.x[0]  # m
    rti = Rti(Ocp(model, N=2, dt=0.1, Q=[1, 1, 1], R=[1, 1], lbu=-0.5, ubu=0.5, h_expr=ca.vertcat(model.x[1], away), uh=[0.3, 0.3]), compile=False)
    _, of_y = rti.scale[:2]  # that of x
    np.testing.assert_allclose(rti.scale[-2:], [of_y, 5.0 * of_y], rtol=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("N", [1, 2])
def test_osqp_solves_a_problem_whose_few_stages_hardly_reach_the_edges_of_a_path(N: int, formulation: str) -> None:
    """Its rows were relative to what these stages reach sideways, and so far from the others that 200,000 iterations were not enough."""
    ocp = Ocp(path_following(pioneer_3dx()), N=N, dt=0.1, Q=[1, 5, 1], R=[0.1] * 3, lbu=-0.5, ubu=0.5, lh=[0.05, 0.05, -np.inf])
    x0, found = np.array([0.1, 0.97, 0.4, 0.2, -0.3, 0.0, 0.1]), []  # beyond the edge that it must keep away from
    for solver, settings in (("riccati", None), ("osqp", SolverSettings(eps=1e-6, max_iter=100_000))):
        rti = Rti(ocp, settings, formulation=formulation, solver=solver, iterations=1, compile=False)
        rti.reset(x0, np.zeros(3))
        rti.prepare(np.zeros((N, 3)))
        assert rti.feedback(x0) is QpStatus.SOLVED
        found.append(rti.u.copy())
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-3 * 0.5)  # of half an input's range, what a second opinion has


def test_inputs_without_bounds_are_measured_by_their_increments_or_by_the_cost() -> None:
    args = np.zeros((11, 2)), np.zeros((10, 1)), np.zeros((10, 2)), np.zeros((11, 0))
    assert scale(double_integrator(lbdu=-0.5, ubdu=0.5), *args)[2] == pytest.approx(5.0)
    by_cost = [scale(double_integrator(Q=[q, 0.1 * q], R=[0.05 * q]), *args)[2] for q in (1.0, 100.0)]
    assert by_cost[0] == pytest.approx(10.0 * by_cost[1])
