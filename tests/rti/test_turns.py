# SPDX-License-Identifier: Apache-2.0
"""Angles of state, plan and reference in the same turn, whichever they come in, with every solver."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.model.model import Model, Signal
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.turns import MAX_ERROR_TURNS
from tests.problems import beacon
from tests.slow import slow_but

TURN = 2 * np.pi
MAX_ERROR_RAD = MAX_ERROR_TURNS * TURN
SOLVERS = ("riccati", "osqp", "daqp")


def arm(**changes: Any) -> Ocp:
    """Two joints on a slide; the outputs are the angle of the second link, which is the sum of theirs, and the slide."""
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 3)
    model = Model(
        name="arm",
        x=x,
        u=u,
        f_expl_expr=ca.vertcat(u[0], u[1], u[2] + 0.1 * ca.sin(x[0])),
        y_expr=ca.vertcat(x[0] + x[1], x[2]),
        states=(Signal("q_1", "rad", angle=True), Signal("q_2", "rad", angle=True), Signal("s", "m")),
        inputs=(Signal("w_1", "rad/s"), Signal("w_2", "rad/s"), Signal("v", "m/s")),
        outputs=(Signal("q", "rad", angle=True), Signal("s", "m")),
    )
    return Ocp(model, **({"N": 8, "dt": 0.1, "Q": [1.0, 1.0], "R": [0.05, 0.05, 0.05], "lbu": -1.0, "ubu": 1.0} | changes))


def turret(**changes: Any) -> Ocp:
    """One angle that is turned at a speed; linear, and its plan as easy to foresee."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    psi = (Signal("psi", "rad", angle=True),)
    model = Model(name="turret", x=x, u=u, f_expl_expr=u, y_expr=x, states=psi, inputs=(Signal("w", "rad/s"),), outputs=psi)
    return Ocp(model, **({"N": 8, "dt": 0.1, "Q": [1.0], "R": [0.05], "lbu": -1.0, "ubu": 1.0} | changes))


def wrap(angle: Array) -> Array:
    return np.asarray(np.arctan2(np.sin(angle), np.cos(angle)))


def held_at(rti: Rti, states: Array, reference: float = 0.0) -> Array:
    """First inputs of plans from these states, each shape ``(1,)``, towards a reference that rests."""
    inputs = []
    for state in states:
        rti.prepare(np.full((rti.ocp.N, 1), reference), shift=False)
        rti.feedback(np.atleast_1d(state))
        inputs.append(rti.u[0, 0])
    return np.array(inputs)


@pytest.mark.parametrize("solver", SOLVERS)
def test_commands_are_the_same_however_angles_of_state_and_reference_wrap(solver: str) -> None:
    """Both joints turn through several turns, forward and back; the reference's angle is the sum of theirs."""
    rng = np.random.default_rng(1)
    ocp = arm()
    phi = ocp.phi()
    plain, wrapped = (Rti(ocp, solver=solver, compile=False) for _ in range(2))
    x = np.array([2.5, 0.3, 0.0])
    for rti in (plain, wrapped):
        rti.reset(x, np.zeros(3))
    t = ocp.dt * np.arange(1, ocp.N + 1)
    way = lambda t: np.column_stack([2.8 + 9.0 * np.sin(0.15 * t), 0.2 * t])  # noqa: E731 # 1.35 rad/s at most, three turns in all
    for k in range(250):
        y_ref = way(0.1 * k + t)
        plain.prepare(y_ref)
        plain.feedback(x)
        wrapped.prepare(np.column_stack([wrap(y_ref[:, 0]), y_ref[:, 1]]))
        wrapped.feedback(np.array([*wrap(x[:2]), x[2]]))
        np.testing.assert_allclose(wrapped.u, plain.u, atol=1e-4)  # what OSQP's tolerance leaves
        x = np.array(phi(x, plain.u[0], [])).ravel() + rng.normal(size=3) * 1e-3
    assert abs(x[0] + x[1] - way(np.array([25.0]))[0, 0]) < 0.2, "and the reference is followed"


def test_output_that_is_no_state_is_put_next_to_its_reference() -> None:
    """The bearing of a beacon, atan2(3, 5) + 7 for a heading of -7."""
    rti = Rti(beacon(), compile=False)
    x0 = np.array([0.0, 0.0, -7.0])
    rti.reset(x0, np.zeros(2))
    rti.prepare(np.tile([5.0, 1.0], (rti.ocp.N, 1)), shift=False)
    assert rti.feedback(x0).usable
    assert abs(rti.y_ref[0, 1] - (np.arctan2(3, 5) + 7.0)) <= np.pi
    np.testing.assert_allclose(np.remainder(rti.y_ref[:, 1], TURN), 1.0)


@pytest.fixture(scope="module", params=SOLVERS)
def turned(request: pytest.FixtureRequest) -> Rti:
    """One turret a solver for many tests, each of which starts it cold."""
    return Rti(turret(), solver=request.param, compile=False)


@pytest.mark.parametrize("flip", slow_but([3.1, 3.3, -3.1, -3.3, TURN, -TURN, 2 * TURN], 3.1, -3.3, -TURN, 2 * TURN))
@pytest.mark.parametrize("samples", slow_but([1, 2, 5], 1, 5))
def test_wrong_angles_are_forgotten_when_they_are_over(turned: Rti, flip: float, samples: int) -> None:
    """For any direction of the robot's motion, and any turn that the wrong samples have led to."""
    rti = turned
    for speed in (0.5, -0.5):
        rti.reset(np.zeros(1), np.full(1, speed))
        t, psi, error = 0.1 * np.arange(1, rti.ocp.N + 1), 0.0, []
        for k in range(40):
            rti.prepare(speed * (0.1 * k + t)[:, None])
            rti.feedback(np.array([wrap(np.array(psi + flip * (10 <= k < 10 + samples)))]))
            psi += 0.1 * rti.u[0, 0]
            error.append(abs(psi - speed * 0.1 * (k + 1)))
        assert max(error[30:]) < 1e-2  # rad; a turn back takes six seconds


@pytest.mark.parametrize("wrapped", [True, False])
def test_noise_at_half_a_turn_changes_the_way_at_most_once(turned: Rti, wrapped: bool) -> None:
    noisy = np.pi + np.random.default_rng(2).uniform(-0.29, 0.29, 200)
    rti = turned
    rti.reset(noisy[:1], np.zeros(1))
    inputs = held_at(rti, wrap(noisy) if wrapped else noisy)
    assert np.abs(inputs).min() > 0.1  # rad/s: it never hesitates
    assert np.count_nonzero(np.diff(np.sign(inputs))) <= 1


def test_the_nearer_way_is_taken_where_the_other_has_become_too_long(turned: Rti) -> None:
    rti = turned
    rti.reset(np.full(1, 3.0), np.zeros(1))
    before, beyond = held_at(rti, np.linspace(3.0, MAX_ERROR_RAD - 0.01, 10)), held_at(rti, np.array([MAX_ERROR_RAD + 0.01]))
    assert np.all(before < -0.1)
    assert beyond > 0.1
    rti.reset(np.full(1, MAX_ERROR_RAD - 0.01), np.zeros(1))
    assert held_at(rti, np.array([MAX_ERROR_RAD - 0.01])) > 0.1, "a cold start takes the nearer way at once"


def test_reference_that_turns_on_and_on_is_followed_through_every_turn(turned: Rti) -> None:
    rti = turned
    rti.reset(np.zeros(1), np.zeros(1))
    t, psi = 0.1 * np.arange(1, rti.ocp.N + 1), 0.0
    for k in range(400):
        rti.prepare(0.9 * (0.1 * k + t)[:, None])
        rti.feedback(np.array([psi]))
        psi += 0.1 * rti.u[0, 0]
    assert psi == pytest.approx(0.9 * 40.0, abs=0.01)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("middle", [0.0, 3.0, -9.0])
def test_angle_with_bounds_is_taken_in_the_turn_of_its_bounds(solver: str, middle: float) -> None:
    """For any measured turn, and after a wrong sample: a joint at its stop must not be driven through it."""
    rti = Rti(turret(lbx=middle - 1.5, ubx=middle + 1.5), solver=solver, compile=False)
    measured = wrap(middle + np.array([1.0] * 5 + [-2.2] + [1.0] * 25))
    rti.reset(measured[:1], np.zeros(1))
    held_at(rti, measured, float(wrap(np.array(middle + 1.2))))
    assert rti.x[0, 0] == pytest.approx(middle + 1.0)
    assert rti.violation == 0.0
    assert rti.u[0, 0] > 0.1  # rad/s, the short way


@pytest.mark.parametrize("bounds", [{}, {"lbx": [-1.5, -np.inf, -np.inf], "ubx": [1.5, np.inf, np.inf]}], ids=["free", "bounded"])
def test_nothing_is_turned_where_all_is_near_and_then_the_errors_are_the_same(bounds: dict[str, Any]) -> None:
    """The compiled look at a sample, which spares turning, against turning."""
    rng, rti, settled = np.random.default_rng(4), Rti(arm(**bounds), compile=False), 0
    turns = rti._turns
    for _ in range(300):
        rti.x0[:], rti.guess.sample["x"][0], rti.y_ref[0] = rng.uniform(-3.0, 3.0, 3), rng.uniform(-3.0, 3.0, 3), rng.uniform(-6.0, 6.0, 2)
        known = turns._errors[:] = [rng.uniform(-4.0, 4.0), 0.0]
        kept = rti.x0.copy(), rti.y_ref.copy()
        turns._look()
        seen = turns._errors.copy()
        if turns._unsettled[0]:
            np.testing.assert_array_equal(seen, known)
            continue
        settled += 1
        turns._errors[:] = known
        assert not turns._turn()
        for array, before in zip((rti.x0, rti.y_ref), kept, strict=True):
            np.testing.assert_array_equal(array, before)
        assert turns._errors[0] == seen[0]
    assert 20 < settled < 280


def test_what_has_been_turned_once_needs_no_turn_in_the_samples_after_it() -> None:
    """Nor is a turn of a rehearsal one: after it, the sample itself is turned."""
    rti = Rti(turret(), compile=False)
    rti.reset(np.zeros(1), np.zeros(1))
    turns, turned = rti._turns, []
    for k in range(4):
        rti.prepare(np.full((rti.ocp.N, 1), 4.0), shift=k > 0)
        kept = rti.y_ref.copy(), rti.guess.sample["x"].copy()
        turns.rehearse()
        rti.y_ref[:], rti.guess.sample["x"][:] = kept
        rti.x0[:] = 0.0
        turned.append(turns.settle())
        rti.feedback(np.zeros(1))
    assert turned == [True, False, False, False]
    assert rti.y_ref[0, 0] == pytest.approx(4.0 - 2.0 * np.pi, abs=1e-12)  # rounding


@pytest.mark.parametrize("solver", SOLVERS)
def test_angle_in_degrees_turns_at_360(solver: str) -> None:
    """A turret commanded in degrees, its states and references wrapped there, does what one in rad does."""
    degrees = 180 / np.pi
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    psi = (Signal("psi", "deg", angle=True),)
    model = Model(name="turret", x=x, u=u, f_expl_expr=u, y_expr=x, states=psi, inputs=(Signal("w", "deg/s"),), outputs=psi)
    scaled = {"Q": [degrees**-2], "R": [0.05 * degrees**-2], "lbu": -degrees, "ubu": degrees}
    plain = Rti(turret(), solver=solver, compile=False)
    other = Rti(Ocp(model, N=8, dt=0.1, **scaled), solver=solver, compile=False)
    start, state = 3.0, 3.0
    plain.reset(np.array([start]), np.zeros(1))
    other.reset(np.array([start * degrees]), np.zeros(1))
    for k in range(40):
        rows = 3.0 + 0.08 * np.arange(k + 1, k + 9)[:, None]  # through half a turn, and on
        plain.prepare(rows)
        other.prepare(degrees * wrap(rows))
        plain.feedback(np.array([state]))
        other.feedback(degrees * wrap(np.array([state])))
        np.testing.assert_allclose(other.u / degrees, plain.u, rtol=0, atol=1e-6)
        state += 0.1 * plain.u[0, 0]
    assert state > np.pi + 1.0
