# SPDX-License-Identifier: Apache-2.0
"""Units: the same robot in other units is driven the same way, by every solver, from the same guess."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.model.model import Model, Signal
from rti_mpc.model.path_following import path_following
from rti_mpc.model.robots.boat import boat
from rti_mpc.model.robots.cart_pole import cart_pole
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.model.robots.quadrotor import quadrotor
from rti_mpc.rti.construction import FORMULATIONS
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.scale import scale
from rti_mpc.si import read
from tests.problems import INF, cart, double_integrator, fenced, pioneer
from tests.slow import slow_but
from tests.units import PIONEER_UNITS, in_other_units, with_units

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


def differences(one: Rti, other: Rti, units: tuple[Array, Array], x: Array, y_ref: Callable[[int], Array], samples: int) -> Array:
    """
    Drive both from a state, and from the same guess in each sample.

    Returns:
        The largest difference of a command, that of any input of a plan, both in half ranges, and the number of samples whose statuses, QPs or
        iterations differ.
    """
    x_units, u_units = units
    ocp = one.ocp
    phi, found = ocp.phi(), []
    one.reset(x, np.array(ocp.model.u_rest))
    other.reset(x / x_units, np.array(other.ocp.model.u_rest))
    for k in range(samples):
        for rti, unit in ((one, 1.0), (other, x_units)):
            rti.prepare(y_ref(k), shift=k > 0)
            assert rti.feedback(x / unit) is QpStatus.SOLVED
        off = np.abs(other.u * u_units - one.u) / one.scale[ocp.model.nx :][: ocp.model.nu]
        found.append([off[0].max(), off.max(), (other.taken, other.solver.iterations) != (one.taken, one.solver.iterations)])
        for theirs, mine, unit in ((other.x, one.x, x_units), (other.u, one.u, u_units)):
            theirs[:] = mine / unit
        x = np.array(phi(x, one.u[0], ocp.model.p_nominal)).ravel()
    command, plan, iterations = np.array(found).T
    return np.array([command.max(), plan.max(), iterations.sum()])


def wave(N: int, outputs: int, dt: float = 0.1) -> Callable[[int], Array]:
    """Return the reference at each sample, a wave along x at 0.4 m/s, shape ``(N, outputs)``."""

    def at(k: int) -> Array:
        t = dt * np.arange(k + 1, k + N + 1)
        return np.column_stack([0.4 * t, 0.3 * np.sin(t), 0 * t])[:, :outputs]

    return at


def pioneer_start(seed: int) -> Array:
    """Return a random state of the shipped robot, from which bounds of all kinds act; of seed 0 one that is beyond a bound of its speeds."""
    rng = np.random.default_rng(seed)
    drawn = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-1, 1), rng.uniform(-0.4, 0.45), rng.uniform(-0.7, 0.7)])
    return drawn if seed else np.array([0.1, 0.02, 0.2, 0.45, -0.7])


@pytest.mark.parametrize(
    ("bounds", "seeds"), slow_but([(True, (0, 8, 42, 43)), (False, (0, 1)), (True, range(60))], (True, (0, 8, 42, 43)), (False, (0, 1)))
)
def test_kilometres_degrees_and_revolutions_per_minute_change_nothing(bounds: bool, seeds: Sequence[int]) -> None:
    """Of the shipped robot, nonlinear, state by state from the same guess; without bounds on inputs by the curvature of the cost alone."""
    unbounded = {} if bounds else {name: sign * INF for name, sign in (("lbu", -1), ("ubu", 1), ("lbdu", -1), ("ubdu", 1))}
    plain = pioneer(N=15, **unbounded)
    one, other = (Rti(ocp, compile=False) for ocp in (plain, in_other_units(plain, *PIONEER_UNITS)))
    found = [differences(one, other, PIONEER_UNITS, pioneer_start(seed), wave(15, 3), samples=25) for seed in seeds]
    np.testing.assert_allclose(np.array(found)[:, :2], 0.0, rtol=0, atol=1e-8)  # what is promised; 1e-14 is found
    np.testing.assert_array_equal(np.array(found)[:, 2], 0)


class Driven(NamedTuple):
    """
    A robot with bounds of its own.

    Attributes:
        ocp: Problem.
        middle: State about which it starts.
        spread: Largest distance from there.
        y_ref: Reference at each sample.
    """

    ocp: Ocp
    middle: Array
    spread: Array
    y_ref: Callable[[int], Array]


def driven_pioneer(ocp: Ocp) -> Driven:
    """Return the shipped robot on the wave."""
    return Driven(ocp, np.zeros(5), np.array([0.5, 0.5, 1.0, 0.45, 0.7]), wave(ocp.N, 3))


def driven_boat() -> Driven:
    """Return the boat on the wave, its thrust, moment, speed and rate of turn bounded."""
    limits: dict[str, Any] = {"lbu": [-40, -8], "ubu": [40, 8], "lbdu": [-10, -3], "ubdu": [10, 3]}
    limits |= {"lbx": [-INF, -INF, -INF, -0.2, -INF, -0.5], "ubx": [INF, INF, INF, 0.8, INF, 0.5]}
    ocp = Ocp(boat(), N=20, dt=0.2, Q=[1, 1], R=[1e-3, 1e-2], **limits)
    return Driven(ocp, np.zeros(6), np.array([1.0, 1.0, 2.0, 0.6, 0.2, 0.4]), wave(20, 2, dt=0.2))


def driven_cart_pole() -> Driven:
    """Return the cart-pole with its pole up, on a short rail."""
    ocp = Ocp(cart_pole(), N=30, dt=0.05, Q=[10, 10, 0.1, 0.1], R=[0.01], lbu=-20, ubu=20, lbx=[-0.6] + 3 * [-INF], ubx=[0.6] + 3 * [INF], z=100.0)
    return Driven(ocp, np.zeros(4), np.array([0.5, 0.5, 0.5, 1.0]), lambda k: np.zeros((30, 4)))


def driven_quadrotor() -> Driven:
    """Return the quadrotor, called from 2 m aside to a point, its body rates bounded."""
    rates = np.array([*9 * [INF], *3 * [2.0]])  # rad/s
    ocp = Ocp(quadrotor(), N=15, dt=0.05, Q=[10, 10, 10, 1], R=[0.05] * 4, lbu=0.0, ubu=4.0, lbdu=-0.5, ubdu=0.5, lbx=-rates, ubx=rates, z=100.0)
    return Driven(ocp, np.array([2.0] + 11 * [0.0]), np.array([*3 * [0.5], *3 * [0.2], *3 * [0.5], *3 * [0.3]]), lambda k: np.zeros((15, 4)))


DRIVEN: dict[str, Callable[[], Driven]] = {
    "general_constraints": lambda: driven_pioneer(fenced(N=15, R_u=[0.05, 0.02])),
    "held_blocks": lambda: driven_pioneer(pioneer(N=15, blocks=[1, 1, 2, 3, 8])),
    "boat": driven_boat,
    "cart_pole": driven_cart_pole,
    "quadrotor": driven_quadrotor,
}


@pytest.mark.parametrize(("robot", "starts"), slow_but([(robot, n) for robot in DRIVEN for n in (2, 15)], *((robot, 2) for robot in DRIVEN)))
def test_any_robot_is_driven_alike_in_units_of_any_size(robot: str, starts: int) -> None:
    """Its commands, from random states beyond bounds of all kinds, in units from 1e-3 to 1e3 of the old ones."""
    ocp, middle, spread, y_ref = DRIVEN[robot]()
    rng = np.random.default_rng(1)
    units = 10.0 ** rng.uniform(-3, 3, ocp.model.nx), 10.0 ** rng.uniform(-3, 3, ocp.model.nu)
    plain = in_other_units(ocp, np.ones(ocp.model.nx), np.ones(ocp.model.nu))
    one, other = (Rti(problem, compile=False) for problem in (plain, in_other_units(ocp, *units)))
    states = middle + spread * rng.uniform(-1, 1, (starts, len(middle)))
    found = np.array([differences(one, other, units, x, y_ref, samples=25) for x in states])
    np.testing.assert_allclose(found[:, 0], 0.0, rtol=0, atol=1e-8)  # as above
    assert found[:, 2].sum() <= 0.01 * 25 * starts  # where more bounds are held than inputs can hold, rounding may say which


def test_scale_of_what_has_no_bounds_is_the_reach_of_the_inputs() -> None:
    """A mass pushed by at most 2 for a second: half a metre times two, and two metres per second; with bounds that is its reach still."""
    ocp = double_integrator(lbu=-2.0, ubu=2.0)
    args = np.zeros((11, 2)), np.zeros((10, 1)), np.zeros((10, 2)), np.zeros((11, 0))
    found = scale(ocp, *args)
    np.testing.assert_allclose(found, [1.0, 2.0, 2.0, 1.0, 2.0], rtol=1e-12)
    bounded = scale(double_integrator(lbu=-2.0, ubu=2.0, lbx=[-7.0, -0.5], ubx=[7.0, 0.5]), *args)
    np.testing.assert_allclose(bounded, [7.0, 0.5, 2.0, 7.0, 0.5, 1.0, 2.0], rtol=1e-12)


@pytest.mark.parametrize(("x", "y"), [("km", "mm"), ("m", "km"), ("m", "m")])
def test_position_has_one_scale_although_its_coordinates_are_in_two_units(x: str, y: str) -> None:
    """Kilometres beside millimetres had a scale each: the robot hardly reaches sideways within two stages."""
    ocp = Ocp(with_units(pioneer_3dx(), {"x": x, "y": y}), N=2, dt=0.1, Q=[1, 1, 1], R=[1, 1], lbu=-0.5, ubu=0.5)
    of_x, of_y = Rti(ocp, compile=False).scale_x[:2]
    assert of_x * read(x).size == pytest.approx(of_y * read(y).size, rel=1e-12)


@pytest.mark.parametrize("units", [{}, {"r": "km", "drift": "mm/s"}])
def test_state_that_nothing_moves_has_the_scale_of_one_si_unit(units: dict[str, str]) -> None:
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    signals = (Signal("r", "m"), Signal("drift", "m/s")), (Signal("v", "m/s"),), (Signal("r", "m"),)
    model = with_units(Model("carried", x, u, ca.vertcat(u + x[1], 0), x[0], *signals), units)
    rti = Rti(Ocp(model, N=3, dt=0.1, Q=1.0, R=1.0, lbu=-1.0, ubu=1.0), compile=False)
    assert rti.scale_x[1] * read(model.states[1].unit).size == pytest.approx(1.0, rel=1e-12)


def test_scale_of_a_constraint_is_how_far_its_states_are_moved_in_any_direction() -> None:
    """A robot that drives along x hardly reaches sideways within two stages; that position has the scale of the other one all the same."""
    model = pioneer_3dx()
    away = 3.0 * model.x[1] - 4.0 * model.x[0]  # m
    rti = Rti(Ocp(model, N=2, dt=0.1, Q=[1, 1, 1], R=[1, 1], lbu=-0.5, ubu=0.5, h_expr=ca.vertcat(model.x[1], away), uh=[0.3, 0.3]), compile=False)
    _, of_y = rti.scale[:2]  # that of x
    np.testing.assert_allclose(rti.scale_g, [of_y, 5.0 * of_y], rtol=1e-12)


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
