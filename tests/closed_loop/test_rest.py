# SPDX-License-Identifier: Apache-2.0
"""Stop of robots that inputs at rest do not stop, and the effect of their last command after the controller has died, in lockstep."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, End, Reference
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.model.integrator import integrator
from rti_mpc.rti.rest import find_stop_law
from rti_mpc.rti.rti import Rti
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, Run, drive
from tests.movers import law_of, ocp_of
from tests.slow import slow_but

STILL = 1e-3  # m/s, rad/s and the like
DRIVEN_S = 1.5
# Where each is, how fast it is to move from there, and for how long a stop may take, s.
MOTIONS: dict[str, tuple[list[float], list[float], float]] = {
    "car": ([0, 0, 0, 1], [1, 0, 0, 0], 3.0),
    "bicycle": ([0, 0, 0, 1, 0], [1, 0, 0, 0, 0], 3.0),
    "arm": ([0.5, 0.5, 0.3, -0.5], [0.3, -0.5, 0, 0], 3.0),
    "quadrotor": ([0, 0, 0, 0.5, 0.3, 0], [0.5, 0.3, 0, 0, 0, 0], 5.0),
}


def tracking(name: str) -> tuple[Controller, Lockstep]:
    """A controller that follows a line, and its robot."""
    ocp = ocp_of(name)
    start, rate, _ = MOTIONS[name]
    t = 0.05 * np.arange(400)
    y = np.array(start) + t[:, None] * np.array(rate)
    controller = Controller(Rti(ocp, compile=False), Timing(), stop_law=law_of(name), compile=False)
    controller.receive_reference(Reference(1, 1, 0, 50 * MS, End.HOLD, y, np.zeros((len(y), 0))))
    slew = np.minimum(-ocp.lbdu, ocp.ubdu) / ocp.dt
    return controller, Lockstep(RobotSettings(ocp.model, np.array(start, dtype=float), slew, state_period_s=ocp.dt))


def rates(name: str, x: Array, u: Array) -> Array:
    model = ocp_of(name).model
    return np.array(ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr])(x, u, model.p_nominal)).ravel()


def driven(name: str) -> tuple[Controller, Lockstep, Run]:
    controller, body = tracking(name)
    run = drive(controller, body, DRIVEN_S)
    assert controller.mode is Mode.TRACKING
    assert controller.ladder.fallbacks == 0
    return controller, body, run


@pytest.mark.parametrize("name", slow_but(MOTIONS, "car", "arm"))
def test_stop_brings_the_robot_to_rest_and_it_stays_there(name: str) -> None:
    controller, body, run = driven(name)
    assert np.abs(rates(name, body.x, body.u)).max() > 0.2, "it moves"
    controller.stop("by a test")
    stopped_s = DRIVEN_S + MOTIONS[name][2]
    drive(controller, body, stopped_s, run=run)
    assert controller.mode is Mode.STOPPED
    assert np.abs(rates(name, body.x, body.u)).max() < STILL
    assert controller.at_rest
    where = body.x.copy()
    drive(controller, body, stopped_s + 2.0, run=run)
    assert np.abs(body.x - where).max() < STILL
    ocp = ocp_of(name)
    acting = np.array([command.u[0] for command in run.commands])
    assert np.all((acting >= ocp.lbu) & (acting <= ocp.ubu))
    steps = np.diff(acting, axis=0)
    assert np.all((steps >= ocp.lbdu - 1e-9) & (steps <= ocp.ubdu + 1e-9))


def played(name: str, command: Command, x: Array, from_ns: int, span_s: float, heavier: float = 1.0) -> tuple[Array, Array]:
    """Play a command and its way to rest, fed back at each row, on a plant that answers its inputs by a factor; return state and input in the end."""
    ocp = ocp_of(name)
    phi, p = integrator(ocp.model, "rk4", 4), np.array(ocp.model.p_nominal)
    t_ns, u = from_ns, command.u[0]
    while t_ns < from_ns + round(1e9 * span_s):
        if t_ns < command.valid_until_ns:
            row = max(0, (t_ns - command.stamp_ns) // command.period_ns)
            u, until_ns = command.u[row], min(command.stamp_ns + (row + 1) * command.period_ns, command.valid_until_ns)
        else:
            i = (t_ns - command.valid_until_ns) // command.rest_period_ns
            until_ns = command.valid_until_ns + (i + 1) * command.rest_period_ns
            row = min(i, len(command.u_rest) - 1)
            u = np.clip(command.u_rest[row] - command.K @ (x - command.x_rest[row]), ocp.lbu, ocp.ubu)
        x = np.array(phi(x, heavier * u, p, 1e-9 * (until_ns - t_ns))).ravel()
        t_ns = until_ns
    return x, u


@pytest.mark.parametrize("name", slow_but(MOTIONS, "car", "arm"))
def test_last_command_of_a_controller_that_dies_brings_the_robot_to_rest(name: str) -> None:
    _, body, run = driven(name)
    last = run.commands[-1]
    assert last.valid_until_ns - body.now_ns <= 250 * MS
    assert len(last.u) * last.period_ns >= last.valid_until_ns - last.stamp_ns, "rows up to there, the others travel in telemetry"
    assert len(last.u_rest) == len(last.x_rest) > 1
    x, u = played(name, last, body.x, body.now_ns, MOTIONS[name][2])
    assert np.abs(rates(name, x, u)).max() < STILL
    x, u = played(name, last, body.x, body.now_ns, 12.0, heavier=1.01)
    assert np.abs(rates(name, x, 1.01 * u)).max() < STILL, "one that answers 1 % more is held as well"


def test_stop_whose_rows_last_several_periods_is_followed_by_the_rest_of_its_way() -> None:
    """At short periods a way has fewer rows than there are periods: those in the command's plan last as long as the ones that follow."""
    ocp = replace(ocp_of("car"), dt=0.01)
    law = find_stop_law(ocp)
    assert law is not None
    assert law.substeps > 1
    controller = Controller(Rti(ocp, compile=False), Timing(), stop_law=law, compile=False)
    y = np.array([0.0, 0, 0, 1]) + 0.05 * np.arange(400)[:, None] * np.array([1.0, 0, 0, 0])
    controller.receive_reference(Reference(1, 1, 0, 50 * MS, End.HOLD, y, np.zeros((400, 0))))
    body = Lockstep(RobotSettings(ocp.model, np.array([0.0, 0, 0, 1]), ocp.ubdu / ocp.dt, state_period_s=ocp.dt))
    drive(controller, body, 0.5)
    stop = controller.standstill(body.now_ns)
    assert stop is not None
    assert stop.period_ns == stop.rest_period_ns == round(1e9 * law.period_s)
    assert stop.stamp_ns + len(stop.u) * stop.period_ns == stop.valid_until_ns
    x, _ = played("car", stop, body.x, body.now_ns, MOTIONS["car"][2])
    assert abs(x[3]) < STILL


@pytest.mark.parametrize("name", slow_but(MOTIONS, "car", "arm"))
def test_controller_that_is_late_leaves_the_robot_on_the_way_that_its_states_correct(name: str) -> None:
    """A way from a state of 0.2 s ago would replace one that newer states correct: a quadrotor tumbles then."""
    controller, body, _ = driven(name)
    sent = []
    for _ in range(40):
        command = controller.receive_state(body.tick(), body.now_ns)
        assert command is not None
        sent.append(controller.in_time(command, body.now_ns + 225 * MS))
        controller.prepare()
    assert sent == [None] * 40
    assert controller.ladder.shifted + controller.ladder.braked == 40, "each is counted"
    assert controller.mode is Mode.BRAKING
    after = controller.receive_state(body.tick(), body.now_ns)
    assert after is not None
    assert controller.in_time(after, body.now_ns) is after
    assert controller.mode is Mode.TRACKING, "once it is in time again, it drives on"


def test_failing_solver_ends_on_the_way_to_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    controller, body, run = driven("car")
    monkeypatch.setattr(Rti, "feedback", lambda self, x0: QpStatus.FAILED)
    drive(controller, body, DRIVEN_S + 4.0, run=run)
    assert controller.mode is Mode.BRAKING
    assert controller.ladder.shifted > 0
    assert controller.ladder.rested > 0
    assert np.abs(body.x[3]) < STILL


def test_robot_that_is_pushed_while_it_is_stopped_comes_back() -> None:
    controller, body, run = driven("quadrotor")
    controller.stop("by a test")
    drive(controller, body, 5.0, run=run)
    where = body.x.copy()
    body.x[3] += 0.3  # m/s
    drive(controller, body, 12.0, run=run)
    assert np.abs(body.x[:3] - where[:3]).max() < 0.01


def test_robot_whose_inputs_ramp_to_rest_has_commands_as_ever() -> None:
    """Without a stop law, a command carries no way to rest."""
    ocp = ocp_of("car")
    assert law_of("boat") is None
    controller, body = tracking("car")
    plain = Controller(Rti(ocp, compile=False), Timing(), compile=False)
    plain._track.arriving = controller._track.arriving
    run = drive(plain, body, 0.5)
    assert all(len(command.u) == ocp.N and command.u_rest.size == command.x_rest.size == command.K.size == 0 for command in run.commands)
    assert run.commands[-1].rest_period_ns == 0
