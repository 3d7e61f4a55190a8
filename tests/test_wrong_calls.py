# SPDX-License-Identifier: Apache-2.0
"""Wrong calls of the library: each is refused in one line that names the argument, never in NumPy's or CasADi's words, and never guessed at."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc import Controller, Model, Ocp, Rti, Signal, find_model
from rti_mpc.contract.message import End, Reference, State
from rti_mpc.control.controller import Timing
from rti_mpc.control.observer import Disturbance, Observer, ObserverSettings
from rti_mpc.errors import RtiMpcError
from rti_mpc.model.disturbance import with_disturbances
from rti_mpc.model.integrator import integrator
from rti_mpc.model.obstacle import with_obstacles
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.path import read_path
from rti_mpc.reference.trajectory import circle, eight, find_trajectory, rows, waypoints
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.terminal import lqr_weight
from tests.problems import INF, double_integrator, pioneer

X, U = ca.SX.sym("x", 2), ca.SX.sym("u")
MASS: dict[str, Any] = {
    "name": "mass",
    "x": X,
    "u": U,
    "f_expl_expr": ca.vertcat(X[1], U),
    "y_expr": X[0],
    "states": ("r", "v"),
    "inputs": ("a",),
    "outputs": ("r",),
}
WIND = ca.SX.sym("wind")
MX_X, MX_U = ca.MX.sym("x", 2), ca.MX.sym("u")


def mass(**changes: Any) -> Model:
    return Model(**MASS | changes)


def ocp(**changes: Any) -> Ocp:
    return double_integrator(N=4, **changes)


MODEL = {
    "x that is text": (lambda: mass(x="x"), "model mass: x must be an expression"),
    "x that is an expression": (lambda: mass(x=2 * X), "model mass: x must consist of symbols"),
    "x of one symbol twice": (lambda: mass(x=ca.vertcat(X[0], X[0])), "model mass: x must consist of symbols"),
    "u that is in x": (lambda: mass(u=X[1]), "model mass: u must consist of symbols of its own, got x_1, which is in x too"),
    "f_expl_expr that is a function": (lambda: mass(f_expl_expr=lambda x, u: x), "model mass: f_expl_expr must be an expression"),
    "f_expl_expr in MX, symbols in SX": (lambda: mass(f_expl_expr=ca.vertcat(MX_X[1], MX_U)), "must be MX like the others, or all of them SX"),
    "f_expl_expr in SX, symbols in MX": (lambda: mass(x=MX_X, u=MX_U), "model mass: f_expl_expr must be MX like the others"),
    "f_expl_expr of SX and MX": (lambda: mass(f_expl_expr=[X[1], MX_U]), "model mass: f_expl_expr must be a list of numbers and of either SX or MX"),
    "f_expl_expr of another symbol": (lambda: mass(f_expl_expr=[X[1], U + WIND]), "f_expl_expr must depend only on x, u, p, also has wind"),
    "MX of another symbol": (
        lambda: mass(x=MX_X, u=MX_U, f_expl_expr=[MX_X[1], ca.MX.sym("wind")], y_expr=MX_X[0]),
        "f_expl_expr must depend only on x, u, p, also has wind",
    ),
    "f_expl_expr that is a row": (lambda: mass(f_expl_expr=ca.horzcat(X[1], U)), "f_expl_expr must be a column, of shape (2, 1), got shape (1, 2)"),
    "y_expr of None": (lambda: mass(y_expr=None), "model mass: y_expr must be an expression"),
    "states that are a number": (lambda: mass(states=2), "model mass: states must be signals or their names, got 2"),
    "states with a number among them": (lambda: mass(states=["r", 2]), "model mass: states must be signals or their names, got 2 among them"),
    "states that are too few": (lambda: mass(states="r"), "model mass: states must have 2 entries, as x has, got 1"),
    "output that is an angle of a state that is none": (
        lambda: mass(outputs=Signal("psi", "rad", angle=True)),
        "output psi is the state r, both or none must be an angle, got angle=True and angle=False",
    ),
    "outputs named twice": (lambda: mass(y_expr=X, outputs=["r", "r"]), "names must be unique within a vector, got"),
    "u_rest that is text": (lambda: mass(u_rest="0"), "model mass: u_rest must be real numbers, got '0'"),
    "u_rest that is NaN": (lambda: mass(u_rest=np.nan), "model mass: u_rest must be finite"),
    "x_nominal that is too short": (lambda: mass(x_nominal=[1.0]), "model mass: x_nominal must have 2 entries"),
    "p_nominal that is complex": (lambda: mass(p=WIND, parameters="w", p_nominal=1j), "model mass: p_nominal must be real numbers"),
    "name that is none": (lambda: mass(name=None), "name of a model must be text, got None"),
    "parameter that is text": (lambda: pioneer_3dx().with_parameters(a="0.2"), "parameter a of model pioneer_3dx must be real numbers, got '0.2'"),
    "find_model(None)": (lambda: find_model(None), "a model must be one of pioneer_3dx, "),  # type: ignore[arg-type]
    "model that is misspelt": (lambda: find_model("pionner_3dx"), "got 'pionner_3dx', perhaps pioneer_3dx is meant"),
    "Signal of a number": (lambda: Signal(3, "m"), "name of the signal 3 must be text, got 3"),  # type: ignore[arg-type]
    "Signal without a unit": (lambda: Signal("x", None), "unit of the signal 'x' must be text, got None"),  # type: ignore[arg-type]
    "Signal whose angle is text": (lambda: Signal("x", "rad", angle="yes"), "angle of the signal 'x' must be true or false"),  # type: ignore[arg-type]
    "Signal that is an angle in revolutions": (
        lambda: Signal("psi", "rev", angle=True),
        "unit of the signal 'psi' must be rad or deg for angle=True",
    ),
    "Signal of two lines": (lambda: Signal("v\n", "m/s"), "name and unit of a signal must be printable, in one line, got 'v\\n' in 'm/s'"),
    "name of two lines": (lambda: mass(name="mass\n"), "name of a model must be printable, in one line, got 'mass\\n'"),
    "quaternions of a list within": (
        lambda: mass(quaternions=[["r", ["v"], "a", "b"]]),
        "quaternions must be names of four outputs or of four states each, w, x, y, z, no angles, got ['r', ['v'], 'a', 'b']",
    ),
    "MX with a solution of linear equations": (
        lambda: mass(x=MX_X, u=MX_U, f_expl_expr=[MX_X[1], ca.solve(1 + MX_X @ MX_X.T, MX_X)[0]], y_expr=MX_X[0]),
        "got .../casadi/core/linsol_internal.cpp:65: eval_sx not defined for LinsolQr, for which solve(A, b, 'symbolicqr', {}) can stand",
    ),
    "Signal without a name": (lambda: Signal(" ", "m"), "name of a signal must not be empty"),
}

OCP = {
    "model that is an Ocp": (lambda: Ocp(ocp(), N=3, dt=0.1, Q=1, R=1), "model must be of rti_mpc.model.model.Model, got"),  # type: ignore[arg-type]
    "model without outputs": (lambda: Ocp(mass(y_expr=[], outputs=()), N=3, dt=0.1, Q=[], R=1), "model mass must have outputs for a problem"),
    "model without inputs": (
        lambda: Ocp(mass(u=ca.SX(0, 1), f_expl_expr=[X[1], 0], inputs=()), N=3, dt=0.1, Q=1, R=[]),
        "model mass must have inputs for a problem, got none",
    ),
    "N of 2.5": (lambda: ocp(N_u=2.5), "N_u must be a whole number of at least 1, got 2.5"),
    "N that is text": (lambda: double_integrator(N="20"), "N must be a whole number of at least 1, got '20'"),
    "N that is true": (lambda: double_integrator(N=True), "N must be a whole number of at least 1, got True"),
    "dt that is text": (lambda: ocp(dt="0.1"), "dt must be real numbers, got '0.1'"),
    "dt of two numbers": (lambda: ocp(dt=[0.1, 0.1]), "dt must be one number, got [0.1, 0.1]"),
    "method that is a list": (lambda: ocp(method=["rk4"]), "method must be one of euler, rk4, irk, got ['rk4']"),
    "build that is a list": (lambda: Rti(ocp(), build=["native"], compile=False), "build must be one of portable, native, got ['native']"),  # type: ignore[arg-type]
    "Q that is masked": (lambda: ocp(Q=np.ma.masked_array([1.0, 9e9], [False, True])), "Q must be real numbers, got masked_array"),
    "lbu of inf": (lambda: ocp(lbu=INF), "lbu must lie below inf, -inf where there is no bound, got [inf]"),
    "ubx of -inf": (lambda: ocp(ubx=[-INF, 1.0]), "ubx must lie above -inf, inf where there is no bound, got [-inf, 1.0]"),
    "u_ref that is NaN": (lambda: ocp(R_u=1.0, u_ref=np.nan), "u_ref must be finite, got SX(nan)"),
    "widest of a weight": (lambda: ocp().widest("Q"), "the name of a bound must be one of lbu, ubu, lbdu, ubdu, lbx, ubx, lh, uh"),
    "tightest of a number": (lambda: ocp().tightest(3), "the name of a bound must be one of lbu, "),  # type: ignore[arg-type]
    "copy of an Rti": (lambda: copy(Rti(ocp(), compile=False)), "an Rti must be made where it is used, Rti(ocp) in each process"),
    "pickle of an Rti": (lambda: pickle.dumps(Rti(ocp(), compile=False)), "an Rti must be made where it is used, Rti(ocp) in each process"),
    "Q that is text": (lambda: ocp(Q="1, 1"), "Q must be real numbers, got '1, 1'"),
    "Q by name": (lambda: ocp(Q={"r": 1.0, "v": 1.0}), "Q must be real numbers, got {'r'"),
    "Q of rows of different lengths": (lambda: ocp(Q=[[1.0], [1.0, 2.0]]), "Q must be real numbers, got [[1.0]"),
    "Q of one number for two outputs": (lambda: ocp(Q=1.0), "Q must have shape (2, 2) or be its diagonal (2,), got shape ()"),
    "R that is None": (lambda: ocp(R=None), "R must be real numbers, got None"),
    "R that is symbolic": (lambda: ocp(R=U), "R must be real numbers, got SX(u)"),
    "lbu of a bound per state": (lambda: ocp(lbu=[-1, -1]), "lbu must be a number or have shape (1,), got shape (2,)"),
    "ubx that is complex": (lambda: ocp(ubx=1 + 1j), "ubx must be real numbers, got (1+1j)"),
    "ubx that is a column": (
        lambda: ocp(ubx=np.ones((2, 1))),
        "ubx must be a number or have shape (2,), or (4, 2), a row per stage, got shape (2, 1)",
    ),
    "h_expr in MX": (lambda: ocp(h_expr=MX_X), "h_expr must be SX, of the model's x, u, p"),
    "h_expr of another symbol": (lambda: ocp(h_expr=WIND), "h_expr must be a column of the model's x, u, p"),
    "retuned by an unknown name": (lambda: ocp().retuned(lbz=1.0), "the name of a weight or bound must be one of Q, R, "),
    "integrator of 1.5 substeps": (lambda: integrator(mass(), substeps=1.5), "substeps must be a whole number of at least 1"),  # type: ignore[arg-type]
    "lqr_weight at a state too short": (lambda: lqr_weight(ocp(), np.zeros(1), np.zeros(1)), "x must be an array of shape (2,), got float64"),
    "disc of two numbers": (lambda: with_obstacles(pioneer_3dx(), [(1.0, 2.0)]), "discs must be finite rows of x, y and radius"),  # type: ignore[list-item]
    "disc outside a list": (lambda: with_obstacles(pioneer_3dx(), (1.0, 2.0, 0.3)), "discs must be finite rows"),  # type: ignore[arg-type]
    "disc that is NaN": (lambda: with_obstacles(pioneer_3dx(), [(1.0, np.nan, 0.3)]), "discs must be finite rows"),
    "discs of text": (lambda: with_obstacles(pioneer_3dx(), ["tree"]), "discs must be real numbers, got ['tree']"),  # type: ignore[list-item]
    "disturbance there twice": (lambda: with_disturbances(pioneer_3dx(), ["u_c", "u_c"]), "names of disturbances must be there once each"),
    "disturbances that are None": (
        lambda: with_disturbances(pioneer_3dx(), None),  # type: ignore[arg-type]
        "disturbances must be names of inputs or states, got None",
    ),
    "path of a number": (lambda: read_path(3), "file must be the path of a CSV file, got 3"),  # type: ignore[arg-type]
    "path of a file that is not there": (lambda: read_path("nowhere.csv"), "nowhere.csv: must be a readable file, got No such file or directory"),
    "disturbance of a number": (lambda: with_disturbances(pioneer_3dx(), [3]), "a disturbance must be of an input (u_c"),  # type: ignore[list-item]
}

CONTROL = {
    "Rti of a model": (lambda: Rti(pioneer_3dx()), "ocp must be of rti_mpc.rti.ocp.Ocp, got Model"),  # type: ignore[arg-type]
    "Rti with settings that are a table": (lambda: Rti(ocp(), {"eps": 1e-4}), "settings must be of rti_mpc.rti.qp.osqp.SolverSettings"),  # type: ignore[arg-type]
    "Rti with 2.5 iterations": (lambda: Rti(ocp(), iterations=2.5), "iterations must be a whole number of at least 1"),  # type: ignore[arg-type]
    "Rti with a tolerance of text": (lambda: Rti(ocp(), tolerance="1e-3"), "tolerance must be real numbers, got '1e-3'"),  # type: ignore[arg-type]
    "Rti of no formulation": (lambda: Rti(ocp(), formulation=None), "formulation must be one of auto, simultaneous, "),  # type: ignore[arg-type]
    "Rti of a solver in large letters": (lambda: Rti(ocp(), solver="OSQP"), "got 'OSQP', perhaps osqp is meant; pip install"),
    "Rti of an unknown solver": (lambda: Rti(ocp(), solver="ipopt"), "solver must be riccati, osqp, or one that is installed"),
    "SolverSettings of eps 0": (lambda: SolverSettings(eps=0.0), "eps must lie between 0 and inf, got 0.0"),
    "SolverSettings of half an iteration": (lambda: SolverSettings(max_iter=0.5), "max_iter must be a whole number of at least 1"),  # type: ignore[arg-type]
    "Controller of an Ocp": (lambda: Controller(pioneer(), Timing()), "rti must be of rti_mpc.rti.rti.Rti, got"),  # type: ignore[arg-type]
    "Controller timed by a number": (lambda: Controller(None, 0.1), "timing must be of rti_mpc.control.grid.Timing, got 0.1"),  # type: ignore[arg-type]
    "Controller that observes a number": (
        lambda: Controller(Rti(pioneer(), compile=False), Timing(), observer=3, compile=False),  # type: ignore[arg-type]
        "observer must be of rti_mpc.control.observer.Observer, got 3",
    ),
    "Controller that stops by text": (
        lambda: Controller(Rti(pioneer(), compile=False), Timing(), stop_law="ramp", compile=False),  # type: ignore[arg-type]
        "stop_law must be of rti_mpc.rti.way_to_rest.StopLaw, got 'ramp'",
    ),
    "Controller of an epoch of half": (
        lambda: Controller(Rti(pioneer(), compile=False), Timing(), epoch=1.5, compile=False),  # type: ignore[arg-type]
        "epoch must be a whole number of at least 0, got 1.5",
    ),
    "Timing of text": (lambda: Timing("measured"), "delay_s must be real numbers, got 'measured'"),  # type: ignore[arg-type]
    "Timing without a timeout": (lambda: Timing(stale_s=0.0), "stale_s must be a time above 0 s, got 0.0"),
    "Observer of a number": (
        lambda: Observer(pioneer_3dx(), ObserverSettings({"u_c": 0.1})),  # type: ignore[dict-item]
        "the disturbance of u_c must be of rti_mpc.control.observer.Disturbance, got 0.1",
    ),
    "Observer of a drift of text": (
        lambda: Observer(pioneer_3dx(), ObserverSettings({"u_c": Disturbance("0.1", 1.0)})),  # type: ignore[arg-type]
        "drift of the disturbance of u_c must be real numbers, got '0.1'",
    ),
    "Observer of an unknown state": (lambda: Observer(pioneer_3dx(), ObserverSettings(measured="z")), "measured must be of states (x, "),  # type: ignore[arg-type]
}

REFERENCE = {
    "waypoints of text": (lambda: waypoints("0,0 1,1"), "waypoints must be real numbers, got '0,0 1,1'"),  # type: ignore[arg-type]
    "waypoints of three columns": (lambda: waypoints(np.zeros((4, 3))), "waypoints must be finite, of shape (n, 2), got shape (4, 3)"),
    "waypoints of different lengths": (lambda: waypoints([[0, 0], [1]]), "waypoints must be real numbers"),  # type: ignore[arg-type]
    "waypoints at a speed of text": (lambda: waypoints(np.eye(2), "fast"), "speed_m_s must be real numbers, got 'fast'"),  # type: ignore[arg-type]
    "waypoints with a corner of None": (lambda: waypoints(np.eye(2), corner_m=None), "corner_m must be real numbers, got None"),  # type: ignore[arg-type]
    "rows of a name": (lambda: rows("eight", 0.1), "trajectory must be of rti_mpc.reference.trajectory.Trajectory, got 'eight'"),  # type: ignore[arg-type]
    "rows of an unknown role": (lambda: rows(eight(), 0.1, roles=("x", "z")), "a role must be one of x, y, heading, got 'z'"),  # type: ignore[arg-type]
    "rows of an unknown heading": (lambda: rows(eight(), 0.1, "north"), "heading must be one of tangent, consistent, none, got 'north'"),  # type: ignore[arg-type]
    "rows of a period of None": (lambda: rows(eight(), None), "period_s must be real numbers, got None"),  # type: ignore[arg-type]
    "rows from a heading of text": (lambda: rows(eight(), 0.1, psi0="east"), "psi0 must be real numbers, got 'east'"),  # type: ignore[arg-type]
    "a circle of no size": (lambda: circle(0.0), "k must be finite and above 0, got 0.0"),
    "find_trajectory of a scenario misspelt": (lambda: find_trajectory("eigth"), "or a FILE.csv of waypoints, got 'eigth', perhaps eight is meant"),
    "find_trajectory(None)": (lambda: find_trajectory(None), "a scenario must be one of eight, circle, positioning or a FILE.csv"),  # type: ignore[arg-type]
}

CONSTRUCTED = MODEL | OCP | CONTROL | REFERENCE


def refusal(call: Callable[[], object]) -> str:
    with pytest.raises(RtiMpcError) as refused:
        call()
    line = str(refused.value)
    assert "\n" not in line
    assert len(line) < 500
    return line


@pytest.mark.parametrize("what", CONSTRUCTED)
def test_wrong_argument_is_one_line_that_names_it(what: str) -> None:
    call, told = CONSTRUCTED[what]
    assert told in refusal(call)


@pytest.fixture(scope="module")
def rti() -> Rti:
    """One for all: a refused call changes nothing."""
    return Rti(ocp(), compile=False)


SAMPLE: dict[str, tuple[Callable[[Rti], object], str]] = {
    "reset(x0 too short)": (lambda rti: rti.reset([0.5], [0.0]), "x0 must be an array of shape (2,), got float64 of shape (1,)"),
    "reset(x0 a number)": (lambda rti: rti.reset(0.5, [0.0]), "x0 must be an array of shape (2,), got float64 of shape ()"),
    "reset(u_prev too long)": (lambda rti: rti.reset([0.5, 0.0], [0.0, 0.0]), "u_prev must be an array of shape (1,), got float64 of shape (2,)"),
    "prepare(y_ref of one row)": (lambda rti: rti.prepare([0.0, 0.0]), "y_ref must be an array of shape (4, 2), got float64 of shape (2,)"),
    "prepare(y_ref turned)": (lambda rti: rti.prepare(np.zeros((2, 4))), "y_ref must be an array of shape (4, 2), got float64 of shape (2, 4)"),
    "prepare(y_ref of text)": (lambda rti: rti.prepare([["a", "b"]] * 4), "y_ref must be real numbers"),
    "prepare(y_ref None)": (lambda rti: rti.prepare(None), "y_ref must be real numbers, got None"),
    "prepare(p too wide)": (lambda rti: rti.prepare(np.zeros((4, 2)), np.zeros((5, 1))), "p must be an array of shape (5, 0), got float64"),
    "prepare(u_prev too long)": (lambda rti: rti.prepare(np.zeros((4, 2)), u_prev=[0.3, 0.1]), "u_prev must be an array of shape (1,)"),
    "feedback(a number)": (lambda rti: rti.feedback(0.5), "x0 must be an array of shape (2,), got float64 of shape ()"),
    "feedback(too short)": (lambda rti: rti.feedback(np.array([0.5])), "x0 must be an array of shape (2,), got float64 of shape (1,)"),
    "feedback(too long)": (lambda rti: rti.feedback(np.zeros(3)), "x0 must be an array of shape (2,), got float64 of shape (3,)"),
    "feedback(a row)": (lambda rti: rti.feedback(np.array([[0.5, 0.1]])), "x0 must be an array of shape (2,), got float64 of shape (1, 2)"),
    "feedback(a column)": (lambda rti: rti.feedback(np.array([[0.5], [0.1]])), "x0 must be an array of shape (2,), got float64 of shape (2, 1)"),
    "feedback(None)": (lambda rti: rti.feedback(None), "x0 must be real numbers, got None"),
    "feedback(symbols)": (lambda rti: rti.feedback(X), "x0 must be real numbers, got SX("),
    "retune(an unknown name)": (lambda rti: rti.retune({"Qe": np.eye(2)}), "the name of a weight or bound must be one of Q, R"),
    "retune(another shape)": (lambda rti: rti.retune({"Q": np.eye(3)}), "Q must be an array of shape (2, 2), got float64 of shape (3, 3)"),
    "retune(a weight that is NaN)": (lambda rti: rti.retune({"Q": np.diag([1.0, np.nan])}), "Q must be finite, symmetric and positive semidefinite"),
    "retune(a negative weight)": (lambda rti: rti.retune({"delta": -np.ones(rti.ocp.N)}), "delta must be finite and not negative, got [-1.0"),
    "retune(a bound that is NaN)": (lambda rti: rti.retune({"lbu": np.full(1, np.nan)}), "lbu must not be NaN"),
    "retune(weights of inputs where there were none)": (lambda rti: rti.retune({"R_u": np.ones(1)}), "R_u must stay zero, as it was when compiled"),
    "retune(None)": (lambda rti: rti.retune(None), "values must be weights and bounds by name, got None"),
    "retune(a bound where there is none)": (lambda rti: rti.retune({"lbx": np.zeros(2)}), "lbx must be finite exactly where it was when compiled"),
}


@pytest.mark.parametrize("what", SAMPLE)
def test_wrong_sample_is_one_line_that_names_the_argument_and_changes_nothing(rti: Rti, what: str) -> None:
    call, told = SAMPLE[what]
    rti.reset(np.zeros(2), np.zeros(1))
    rti.prepare(np.ones((4, 2)))
    before = [array.copy() for array in (rti.x, rti.u, rti.u_prev, rti.y_ref, rti.x0)]
    assert told in refusal(lambda: call(rti))
    for now, then in zip((rti.x, rti.u, rti.u_prev, rti.y_ref, rti.x0), before, strict=True):
        np.testing.assert_array_equal(now, then)
    assert rti.feedback(np.zeros(2)).usable, "and the sample that was prepared goes on"


def test_feedback_must_follow_a_prepare_of_its_own(rti: Rti) -> None:
    told = "prepare must be called before each feedback"
    rti.reset(np.zeros(2), np.zeros(1))
    assert told in refusal(lambda: rti.feedback(np.zeros(2)))
    rti.prepare(np.ones((4, 2)))
    rti.feedback(np.zeros(2))
    assert told in refusal(lambda: rti.feedback(np.zeros(2)))


def test_messages_that_do_not_fit_the_model_are_refused_by_the_controller() -> None:
    controller = Controller(Rti(ocp(lbu=-1, ubu=1), compile=False), Timing(), compile=False)
    state = State(1, 1, 0, np.zeros(2))
    for wrong, told in (
        (np.zeros(2), "state must be of rti_mpc.contract.message.State, got array([0., 0.])"),
        (replace(state, x=np.zeros(1)), "state.x must be an array of shape (2,), got float64 of shape (1,)"),
        (replace(state, u=np.zeros(2)), "state.u must be an array of shape (1,), got float64 of shape (2,)"),
    ):
        assert told in refusal(lambda wrong=wrong: controller.receive_state(wrong, 0))  # type: ignore[misc]
    assert "reference must be of rti_mpc.contract.message.Reference, got" in refusal(lambda: controller.receive_reference(state))  # type: ignore[arg-type]
    reference = Reference(1, 1, 0, 100_000_000, End.HOLD, np.zeros((3, 5)), np.zeros((3, 0)))
    assert controller.receive_reference(reference) is None
    assert "rows of 2 outputs" in controller.notices()[-1].text


# What can only mean one thing is taken.


def test_names_alone_lists_and_mx_make_the_same_model_as_signals_columns_and_sx() -> None:
    listed = mass(f_expl_expr=[X[1], U], y_expr=[X[0]], states=["r", "v"], inputs="a", outputs=Signal("r", "1"), u_rest=0)
    stacked = mass(f_expl_expr=np.array([X[1], U]), p=ca.DM(0, 1), u_rest=np.float32(0.0), p_nominal=[])
    mx = mass(x=MX_X, u=MX_U, f_expl_expr=[MX_X[1], MX_U], y_expr=MX_X[0])
    parts = [ca.MX.sym("r"), ca.MX.sym("v")]
    by_parts = mass(x=parts, u=MX_U, f_expl_expr=ca.vertcat(parts[1], MX_U), y_expr=parts[0])
    for model in (listed, stacked, mx, by_parts):
        assert model.states == (Signal("r", "1"), Signal("v", "1"))
        assert model.u_rest == (0.0,)
        f = ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr, model.y_expr])
        np.testing.assert_array_equal(np.vstack([np.array(value) for value in f([1.0, 2.0], 3.0, [])]).ravel(), [2.0, 3.0, 1.0])


def test_output_by_name_alone_is_like_the_state_that_it_is() -> None:
    """Its angle above all: a heading that wraps must not spin the robot because the output forgot that it is one."""
    states = (Signal("psi", "rad", angle=True, role="heading"), Signal("omega", "rad/s"))
    model = mass(states=states, y_expr=ca.vertcat(X[1], X[0], X[0] + X[1]), outputs=("rate", "heading", "sum"))
    assert model.outputs == (Signal("rate", "rad/s"), Signal("heading", "rad", angle=True, role="heading"), Signal("sum", "1"))
    assert model.counterparts()["outputs"] == ["omega", "psi", ""]


def test_mx_with_an_interpolant_drives_as_well() -> None:
    """As a map of the engine's force over speed, which do-mpc and acados users write in MX."""
    force = ca.interpolant("force", "bspline", [np.linspace(-3.0, 3.0, 7)], np.linspace(-3.0, 3.0, 7))
    model = mass(x=MX_X, u=MX_U, f_expl_expr=ca.vertcat(MX_X[1], force(MX_U)), y_expr=MX_X[0])
    rti = Rti(Ocp(model, N=4, dt=0.1, Q=1, R=0.1, lbu=-2, ubu=2), compile=False)
    rti.reset([0, 0], [0])
    rti.prepare([[1.0]] * 4)
    assert rti.feedback([0, 0]).usable
    assert rti.u[0, 0] > 0.0


@pytest.mark.parametrize(
    "state",
    [[0.1, 0.2], (0.1, 0.2), np.array([0.1, 0.2], dtype=np.float32), ca.DM([0.1, 0.2]), np.array([0.1, 0.2, 0.0])[:2], np.array([0.1, 0.2], ">f8")],
    ids=["list", "tuple", "float32", "DM", "view", "big-endian"],
)
def test_a_state_is_taken_in_whatever_numbers_come(rti: Rti, state: Any) -> None:
    plans = []
    for x0, y_ref, u_prev in ((np.array([0.1, 0.2]), np.ones((4, 2)), np.zeros(1)), (state, [[1, 1]] * 4, 0)):
        rti.reset(x0, u_prev)
        rti.prepare(y_ref, u_prev=u_prev)
        assert rti.feedback(x0).usable
        plans.append(rti.u.copy())
    np.testing.assert_allclose(*plans, rtol=0, atol=1e-7)  # what float32 leaves of 0.1


@pytest.mark.parametrize(
    "weight",
    [ca.DM([4, 9]), [Fraction(4), Fraction(9)], [Decimal(4), Decimal(9)], np.array([4, 9], dtype=object)],
    ids=["DM", "fractions", "decimals", "objects"],
)
def test_weights_are_taken_in_whatever_exact_numbers_come(weight: Any) -> None:
    np.testing.assert_array_equal(ocp(Q=weight).Q, np.diag([4.0, 9.0]))


def test_bound_of_a_large_integer_and_a_period_of_casadis_are_numbers() -> None:
    problem = ocp(ubu=10**20, dt=ca.DM(0.25))
    assert problem.ubu.tolist() == [1e20]
    assert problem.dt == 0.25


def test_an_axis_of_length_one_may_be_left_out() -> None:
    rti = Rti(Ocp(mass(), N=4, dt=0.1, Q=1, R=[[0.1]]), compile=False)
    rti.reset(ca.DM([0.1, 0.2]), 0.0)
    rti.prepare(np.arange(4.0), p=[])
    np.testing.assert_array_equal(rti.y_ref, [[0.0], [1.0], [2.0], [3.0]])
