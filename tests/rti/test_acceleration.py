# SPDX-License-Identifier: Apache-2.0
"""Acceleration of the iterations within a sample: guesses ahead of the plan where steps shrink slowly."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled
from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.acceleration import LARGE_STEP, MAX_RELAXATION, MIN_RELAXATION, relaxation
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc_service.bench.families import cart_pole, discs_passed
from tests.problems import pioneer
from tests.rti.test_recursion import needs_compiler
from tests.slow import slow_but

ROUNDING = 1e-12  # relative


def next_guess(
    ocp: Ocp, x: Array, u: Array, x_plan: Array, u_plan: Array, step: Array, omega: float = 1.0, lbx: Array | None = None
) -> tuple[Array, Array, Array, float]:
    """The next guess of states and inputs, the step and its relaxation, in units in which all half ranges are 1."""
    lower = ocp.lbx if lbx is None else lbx
    given = x.T, u.T, x_plan.T, u_plan.T, step.T, omega, lower, ocp.ubx, ocp.lbu, ocp.ubu, 1.0
    x_next, u_next, step_next, omega_next = (np.array(one) for one in relaxation(ocp)(*given))
    return x_next.T, u_next.T, step_next.T, float(omega_next[0, 0])


@pytest.fixture(scope="module")
def ocp() -> Ocp:
    return pioneer(N=3)


@pytest.mark.parametrize(
    ("ratio", "omega"),
    [(-0.5, 1.0), (0.0, 1.0), (0.3, 1.0), (0.4, 1 / 0.6), (0.6, 2.5), (0.7, 1 / 0.3), *((ratio, MAX_RELAXATION) for ratio in (0.8, 1.0, 1.5))],
)
def test_guess_is_ahead_by_all_the_steps_that_would_follow(ocp: Ocp, ratio: float, omega: float) -> None:
    rng = np.random.default_rng(1)
    x, u = 0.01 * rng.normal(size=(4, 5)), 0.01 * rng.normal(size=(3, 2))
    dx, du = 0.01 * rng.normal(size=(4, 5)), 0.01 * rng.normal(size=(3, 2))
    x_next, u_next, step, relaxed = next_guess(ocp, x, u, x + ratio * dx, u + ratio * du, du)
    np.testing.assert_allclose(step, ratio * du, rtol=0, atol=ROUNDING)
    assert relaxed == pytest.approx(omega, rel=ROUNDING)
    assert relaxed == 1.0 or relaxed >= MIN_RELAXATION
    np.testing.assert_allclose(u_next, u + omega * ratio * du, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(x_next[1:], (x + omega * ratio * dx)[1:], rtol=0, atol=ROUNDING)
    np.testing.assert_array_equal(x_next[0], (x + ratio * dx)[0])  # the measured state


def test_factor_of_steps_in_different_directions_is_that_along_the_first_one(ocp: Ocp) -> None:
    x, step, across = np.zeros((4, 5)), np.full((3, 2), 0.01), np.tile([0.01, -0.01], (3, 1))
    relaxed = next_guess(ocp, x, np.zeros((3, 2)), x, 0.5 * step + 0.9 * across, step)[3]
    assert relaxed == pytest.approx(2.0, rel=ROUNDING)


@pytest.mark.parametrize("machine", ["virtual", pytest.param("own", marks=needs_compiler)])
def test_next_guess_may_lie_where_the_guess_lay(ocp: Ocp, machine: str) -> None:
    rng, relax = np.random.default_rng(3), relaxation(ocp)
    (fast,) = compiled(relax) if machine == "own" else [relax]
    given = {name: 0.1 * rng.normal(size=relax.size_in(name)[::-1]) for name in relax.name_in()}
    given |= {"omega": np.array([1.2]), "scale": np.ones(relax.size_in("scale")[0])}
    given |= {bound: np.full(relax.size_in(bound)[::-1], side) for bound, side in (("lbx", -9.0), ("lbu", -9.0), ("ubx", 9.0), ("ubu", 9.0))}
    apart = {name: np.zeros(relax.size_out(name)[::-1]) for name in relax.name_out()}
    bind(fast, given, apart)()
    bind(fast, given, {name: given[name.removesuffix("_next")] for name in apart})()
    for name, expected in apart.items():
        np.testing.assert_array_equal(given[name.removesuffix("_next")].ravel(), expected.ravel(), err_msg=name)
    assert apart["omega_next"] > 1.0


def test_second_guess_of_a_sample_is_the_plan_to_the_last_bit(ocp: Ocp) -> None:
    rng = np.random.default_rng(2)
    x, u, x_plan, u_plan = (rng.normal(size=shape) for shape in ((4, 5), (3, 2), (4, 5), (3, 2)))
    x_next, u_next, _, relaxed = next_guess(ocp, x, u, x_plan, u_plan, np.zeros((3, 2)))
    assert relaxed == 1.0
    np.testing.assert_array_equal(x_next, x_plan)
    np.testing.assert_array_equal(u_next, u_plan)


def test_guess_after_a_large_step_is_the_plan(ocp: Ocp) -> None:
    x, u, du = np.zeros((4, 5)), np.zeros((3, 2)), np.full((3, 2), 0.01)
    for size, omega in ((0.9 * LARGE_STEP, MAX_RELAXATION), (1.1 * LARGE_STEP, 1.0)):
        du[-1] = size
        assert next_guess(ocp, x, u, x, du, du)[3] == omega


@pytest.mark.parametrize("iterations", slow_but([5, 10], 5))
def test_cart_pole_swings_up_with_more_iterations_a_sample_as_well(iterations: int) -> None:
    """From a state at which guesses ahead of the first, large steps lead to no plan."""
    family = cart_pole(40)
    rti, x = Rti(family.ocp, iterations=iterations), family.start(200)
    assert x is not None
    u = family.u0
    rti.reset(x, u)
    for k in range(200, 300):
        y_ref, p = family.at(k)
        rti.prepare(y_ref, p, shift=k > 200, u_prev=u)
        assert rti.feedback(x) is QpStatus.SOLVED
        u = rti.u[0].copy()
        x = family.plant(x, u)
    assert abs(np.cos(x[1]) - 1.0) < 1e-3


def test_factor_of_a_step_that_was_relaxed_is_that_of_steps_that_are_not(ocp: Ocp) -> None:
    """Steps that would shrink to 0.7 shrink to 1 - 2 * 0.3 where they are doubled."""
    u, du = np.zeros((3, 2)), np.full((3, 2), 0.01)
    relaxed = next_guess(ocp, np.zeros((4, 5)), u, np.zeros((4, 5)), u + 0.4 * du, du, omega=2.0)[3]
    assert relaxed == pytest.approx(1 / 0.3, rel=ROUNDING)


def test_guess_is_not_ahead_beyond_a_bound_where_a_model_may_not_be_defined(ocp: Ocp) -> None:
    """A level that sinks towards its lower bound, 0.1; and one that is below it already stays where the plan has it."""
    x, x_plan, du = np.full((4, 5), 0.4), np.full((4, 5), 0.2), np.full((3, 2), 0.01)
    x_plan[-1] = 0.05
    x_next = next_guess(ocp, x, np.zeros((3, 2)), x_plan, 0.9 * du, du, lbx=np.full(5, 0.1))[0]
    np.testing.assert_array_equal(x_next, [[0.2] * 5, [0.1] * 5, [0.1] * 5, [0.05] * 5])
    u_next = next_guess(ocp, x, np.full((3, 2), 0.25), x, np.full((3, 2), 0.45), du * 20)[1]
    np.testing.assert_array_equal(u_next, np.tile(np.minimum(ocp.ubu, 0.25 + MAX_RELAXATION * 0.2), (3, 1)))


def drive(iterations: int, tolerance: float, samples: int = 90) -> tuple[float, Rti]:
    """Drive past discs, along which steps shrink slowly; return the cost."""
    family = discs_passed(20)
    rti = Rti(family.ocp, iterations=iterations, tolerance=tolerance)
    x, u, cost = family.start(0), family.u0, 0.0
    assert x is not None
    rti.reset(x, u)
    for k in range(samples):
        y_ref, p = family.at(k)
        rti.prepare(y_ref, p, shift=k > 0, u_prev=u)
        assert rti.feedback(x) is QpStatus.SOLVED
        before, u = u, rti.u[0].copy()
        x = family.plant(x, u)
        cost += family.cost(x, u, before, y_ref[0], None if p is None else p[1])
    return cost, rti


def test_three_iterations_a_sample_cost_as_much_as_thirty_among_discs() -> None:
    """To a thousandth: without acceleration they cost 1 % more."""
    assert drive(3, 0.015)[0] == pytest.approx(drive(30, 1e-4)[0], rel=1e-3)


@pytest.mark.parametrize("solver", ["riccati", "osqp"])
def test_guesses_are_ahead_whichever_solver_commands(solver: str) -> None:
    family, ahead = discs_passed(20), []
    rti, x, u = Rti(family.ocp, solver=solver, compile=False), family.start(0), family.u0
    assert x is not None
    advance = rti._acceleration.advance

    def watched() -> None:
        advance()
        ahead.append(bool((rti.guess.sample["u"] != rti.u).any()))

    rti._acceleration.advance = watched  # type: ignore[method-assign]
    rti.reset(x, u)
    for k in range(30):
        rti.prepare(*family.at(k), shift=k > 0, u_prev=u)
        assert rti.feedback(x).usable
        u = rti.u[0].copy()
        x = family.plant(x, u)
    assert any(ahead)
    assert not all(ahead)  # the second guess of a sample is its first plan


@pytest.mark.parametrize("certified", [False, True], ids=["not solved", "solved, but not certified"])
def test_iteration_that_fails_from_a_guess_ahead_leaves_the_plan_of_the_one_before(monkeypatch: pytest.MonkeyPatch, certified: bool) -> None:
    kept = drive(2, 0.015, samples=25)[1]
    rti = drive(2, 0.015, samples=24)[1]
    rti.iterations = 3
    assert rti.active_set is not None
    keep, guesses = rti.keep_guess, []

    def keep_guess() -> None:
        guesses.append(rti.guess.sample["u"].copy())
        keep()

    monkeypatch.setattr(rti, "keep_guess", keep_guess)
    if certified:
        monkeypatch.setattr(rti.active_set, "certified", lambda: QpStatus.FAILED)
    else:
        solve, solved = rti.active_set.solve, iter((True, True, False))
        monkeypatch.setattr(rti.active_set, "solve", lambda: next(solved) and solve())
        monkeypatch.setattr(rti, "solve_qp", lambda: QpStatus.FAILED)
    y_ref, p = discs_passed(20).at(24)
    rti.prepare(y_ref, p, u_prev=rti.u[0])
    assert rti.feedback(kept.x0.copy()) is (QpStatus.FAILED if certified else QpStatus.INACCURATE)
    for array, plan in ((rti.u, kept.u), (rti.x, kept.x)):
        np.testing.assert_allclose(array, plan, rtol=0, atol=1e-5)  # which was refined to be certified
    assert np.abs(guesses[-1] - kept.u).max() > 0.01
