# SPDX-License-Identifier: Apache-2.0
"""Robots that come to rest when their inputs do, and those that coast or fall."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.model.model import Model, Signal
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.operation import states_of_operation
from rti_mpc.rti.rest import RestClass, assess, find_stop_law, motion, motion_at_rest
from rti_mpc.si import read
from tests import movers
from tests.problems import INF, PAPER, beacon, double_integrator, pioneer
from tests.rti.test_nominal import PLANTS, problem
from tests.slow import slow_but
from tests.units import PIONEER_TEXTS, size, with_units


def robot(names: str, units: str, f: Any, nu: int, **options: Any) -> Ocp:
    """A robot of derivatives f(x, u), whose outputs are its states."""
    states = tuple(Signal(name, unit, angle=unit == "rad") for name, unit in zip(names.split(), units.split(), strict=True))
    x, u = ca.SX.sym("x", len(states)), ca.SX.sym("u", nu)
    model = Model(
        name="robot",
        x=x,
        u=u,
        f_expl_expr=ca.vertcat(*f(x, u)),
        y_expr=x,
        states=states,
        inputs=tuple(Signal(f"u_{k}", "1") for k in range(nu)),
        outputs=states,
        u_rest=options.pop("u_rest", ()),
    )
    return Ocp(model, **({"N": 5, "dt": 0.05, "Q": np.ones(len(states)), "R": np.ones(nu), "lbu": -2.0, "ubu": 2.0} | options))


def car(x: Any, u: Any) -> tuple[Any, ...]:
    """README's car, driven by acceleration and curvature."""
    return x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), x[3] * u[1], u[0]


def holonomic(x: Any, u: Any) -> tuple[Any, ...]:
    """A base on three wheels that move in any direction, its speeds a moment behind their commands."""
    c, s = ca.cos(x[2]), ca.sin(x[2])
    return x[3] * c - x[4] * s, x[3] * s + x[4] * c, x[5], (u[0] - x[3]) / 0.2, (u[1] - x[4]) / 0.2, (u[2] - x[5]) / 0.1


def drone(x: Any, u: Any) -> tuple[Any, ...]:
    """In the plane: it hovers if its attitude is level, and leaves if not."""
    return x[2], x[3], -u[0] * ca.sin(x[4]) - 0.5 * x[2], u[0] * ca.cos(x[4]) - 9.81 - 0.5 * x[3], u[1]


RESTING = {
    "pioneer": pioneer(),
    "pioneer without bounds on states": pioneer(lbx=-INF, ubx=INF),
    "unicycle": beacon(),
    "holonomic base": robot("x y psi v_x v_y omega", "m m rad m/s m/s rad/s", holonomic, 3),
    "stiff drive": robot("x v", "m m/s", lambda x, u: (x[1], 1e5 * (u - x[1])), 1),
    "forward only": robot("x v", "m m/s", lambda x, u: (x[1], u - x[1]), 1, lbu=0.0, lbx=[-INF, 0.0], ubx=[INF, 2.0]),
    "slow drive": robot("x v", "m m/s", lambda x, u: (x[1], (u - x[1]) / 1.5), 1),
    "joints driven by speeds": robot("q_1 q_2", "rad rad", lambda x, u: (u[0], u[1]), 2),
    "conveyor with an offset": robot("s", "m", lambda x, u: (u - 0.3,), 1, u_rest=(0.3,)),
}
MOVING = {
    "car": (robot("x y psi v", "m m rad m/s", car, 2, lbx=[-INF] * 3 + [0], ubx=[INF] * 3 + [3]), "s after its inputs have come to rest"),
    "mass": (double_integrator(), "r changes by"),
    "frictionless arm": (robot("q w", "rad rad/s", lambda x, u: (x[1], u - 9.81 * ca.sin(x[0])), 1), "changes by"),
    "arm with friction": (robot("q w", "rad rad/s", lambda x, u: (x[1], u - 9.81 * ca.sin(x[0]) - 5 * x[1]), 1), "where it stands at q ="),
    "arm that lies": (robot("q w", "rad rad/s", lambda x, u: (x[1], u), 1), "q changes by"),
    "cart that rolls": (robot("x v", "m m/s", lambda x, u: (x[1], u - 0.05 * x[1]), 1), "x changes by"),
    "drone": (robot("x z v_x v_z theta", "m m m/s m/s rad", drone, 2, u_rest=(9.81, 0.0), lbu=[0, -2], ubu=[20, 2]), "changes by"),
    "conveyor": (robot("s", "m", lambda x, u: (u - 0.3,), 1), "s changes by -0.3 m per second"),
    "unstable": (robot("x v", "m m/s", lambda x, u: (x[1], u + x[1] ** 3), 1), "x changes by"),
}


@pytest.mark.parametrize("name", RESTING)
def test_robot_that_comes_to_rest_with_its_inputs_passes(name: str) -> None:
    assert motion_at_rest(RESTING[name]) == ""


@pytest.mark.parametrize("name", MOVING)
def test_robot_that_coasts_or_falls_is_found_and_what_was_seen_is_said(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    ocp, words = MOVING[name]
    seen = motion_at_rest(ocp)
    assert words in seen
    assert seen == motion_at_rest(ocp), "and the same each time"
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("given", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["found", "given"])
@pytest.mark.parametrize(("name", "rests"), [("reactor", True), ("bicycle", True), ("attitude", True), ("tank", False)])
def test_model_that_is_singular_at_zero_is_judged_around_its_nominal_state(name: str, rests: bool, given: bool) -> None:
    """A tank without inflow drains, and is held at its level instead; the rest need no way."""
    plant = PLANTS[name]()
    ocp = problem(PLANTS[name](x_nominal=plant.x0) if given else plant)
    seen = motion_at_rest(ocp)
    assert seen == ("" if rests else "10 s after its inputs have come to rest h has come to where the model is not finite")
    rest = assess(ocp, find_stop_law(ocp), 24, compile=False)
    assert (rest.kind, rest.states) == (RestClass.HOLDS, 24)
    assert np.isfinite(rest.moved).all()


def test_states_of_operation_are_those_where_the_model_is_regular() -> None:
    ocp = problem(PLANTS["tank"](), lbx=-1.0, ubx=3.0)
    X, U = states_of_operation(ocp, 40)
    assert (X.shape, U.shape) == ((40, 1), (40, 1))
    assert X.min() > 0.0
    assert len(np.unique(X)) > 20


def test_states_of_operation_are_the_same_in_any_units() -> None:
    """Of the paper's robot, whose position and heading have no bounds: they were tried within one kilometre, and one degree."""
    bounds = {"lbu": np.array([-0.5, -INF]), "ubu": np.array([0.5, INF])}
    found = []
    for units in ({}, PIONEER_TEXTS):
        model = with_units(pioneer().model, units)
        sizes = [np.array([read(signal.unit).size for signal in signals]) for signals in (model.states, model.inputs)]
        ocp = Ocp(model, N=5, dt=0.1, Q=[1, 1, 1], R=[1, 1], **{name: bound / sizes[1] for name, bound in bounds.items()})
        found.append([values * of for values, of in zip(states_of_operation(ocp, 40), sizes, strict=True)])
    for theirs, mine in zip(*found, strict=True):
        np.testing.assert_allclose(theirs, mine, rtol=0, atol=1e-12)


def test_motion_by_which_rest_is_judged_is_the_same_in_any_units() -> None:
    """As it is integrated to the same tolerance: it was 1e-8 of a kilometre."""
    plain, other = pioneer().model, with_units(pioneer().model, PIONEER_TEXTS)
    x, u = np.array([1.0, 2.0, 0.5, 0.3, 0.2]), np.array([0.4, -0.5])
    x_sizes, u_sizes = (np.array([size(signal, PIONEER_TEXTS) for signal in signals]) for signals in (plain.states, plain.inputs))
    np.testing.assert_allclose(motion(other)(x / x_sizes, u / u_sizes, 10.0) * x_sizes, motion(plain)(x, u, 10.0), rtol=0, atol=1e-10)


def test_bounds_say_what_operation_is() -> None:
    """At 0.5 m/s at most the paper's robot is as still after a second as one of 50 m/s is after two."""
    assert motion_at_rest(Ocp(pioneer().model, **(PAPER | {"ubu": [50.0, 0.7]}))) == ""


@pytest.mark.parametrize("name", slow_but(["mass", "car", "arm", "quadrotor"], "mass"))
def test_robot_in_discrete_time_comes_to_rest_as_the_same_in_continuous_time(name: str) -> None:
    """Over a period its inputs change positions, too: the way to rest must tell which rates are theirs."""
    continuous: Ocp = double_integrator(lbu=-1.0, ubu=1.0) if name == "mass" else getattr(movers, name)()
    model = continuous.model
    same = replace(model, f_expl_expr=None, disc_dyn_expr=continuous.phi()(model.x, model.u, model.p), dt=continuous.dt)
    bounds = {key: getattr(continuous, key) for key in ("lbu", "ubu", "lbdu", "ubdu", "lbx", "ubx")}
    sampled = Ocp(same, N=continuous.N, dt=continuous.dt, Q=continuous.Q, R=continuous.R, **bounds)
    found = []
    for ocp in (continuous, sampled):
        law = find_stop_law(ocp)
        assert law is not None
        found.append(assess(ocp, law, 24, compile=False))
    assert found[0].kind is found[1].kind
    assert found[1].growth == pytest.approx(found[0].growth, abs=0.01)  # 1/s: of a period's mean rates
