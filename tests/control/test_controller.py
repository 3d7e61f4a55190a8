# SPDX-License-Identifier: Apache-2.0
"""The controller: its grid in time, its angles and an operator, all in lockstep."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, End, Reference, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.observer import Observer, ObserverSettings
from rti_mpc.model.model import Model
from rti_mpc.reference.trajectory import circle, eight, positioning, waypoints
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import Rti
from rti_mpc.signals import Signal
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, STEP, Run, assert_inside_slew, codes, drive, modes, reference, robot
from tests.problems import pioneer
from tests.slow import slow_but

DT = 100 * MS


def to_go(point: tuple[float, float, float], rows: int = 1) -> Reference:
    y = np.tile(np.array(point), (rows, 1))
    return Reference(1, 1, 0, DT, End.HOLD, y, np.zeros((rows, 0)))


# Starting.


def test_nothing_is_commanded_before_state_and_reference(controller: Controller) -> None:
    body = robot(circle())
    assert controller.mode is Mode.IDLE
    assert controller.tick(10**12) is None
    assert controller.standstill(0) is None
    assert controller.receive_state(body.tick(), 0) is None
    assert controller.mode is Mode.WAITING
    assert controller.receive_state(body.tick(), DT) is None
    assert controller.tick(10**12) is None
    controller.receive_reference(reference(circle()))
    command = controller.receive_state(body.tick(), 2 * DT)
    assert command is not None
    assert command.mode is Mode.TRACKING


def test_time_of_a_robot_that_was_not_heard_is_told_as_zero(controller: Controller) -> None:
    """Whatever the host's clock shows: events have this stamp."""
    body, started_ns = robot(circle()), 10**15
    assert controller.robot_now_ns(started_ns) == 0
    controller.receive_state(state := body.tick(), started_ns)
    assert controller.robot_now_ns(started_ns) == state.stamp_ns


def test_order_of_state_and_reference_does_not_matter(rti: Rti) -> None:
    """Nor for headings: the state is at 3 rad, the reference at -3, and that is 0.28 apart."""
    plans = []
    for first in ("state", "reference"):
        controller = Controller(rti, Timing(), compile=False)
        state = State(1, 1, 0, np.array([0.0, 0.0, 3.0, 0.0, 0.0]))
        message = to_go((0.5, 0.0, -3.0))
        if first == "state":
            controller.receive_state(state, 0)
            controller.receive_reference(message)
        else:
            controller.receive_reference(message)
            controller.receive_state(state, 0)
        command = controller.receive_state(dataclasses.replace(state, seq=2, stamp_ns=DT), DT) if first == "state" else None
        if command is None:
            controller.prepare()
            command = controller.receive_state(dataclasses.replace(state, seq=2, stamp_ns=DT), DT)
        assert command is not None
        controller.commit(command)
        plans.append(controller.telemetry(prepare_us=0, feedback_us=0, latency_us=0, slack_s=0).y_ref[0, 2])
    assert plans == [pytest.approx(2 * np.pi - 3)] * 2


def test_command_says_what_it_answers_and_how_long_it_holds(on_the_circle: tuple[Controller, Lockstep]) -> None:
    controller, body = on_the_circle
    state = body.tick()
    command = controller.receive_state(state, body.now_ns)
    assert command is not None
    assert (command.state_epoch, command.state_seq, command.state_stamp_ns) == (state.epoch, state.seq, state.stamp_ns)
    assert command.stamp_ns == state.stamp_ns
    assert command.valid_until_ns == state.stamp_ns + 250 * MS
    assert command.period_ns == DT
    assert command.u.shape == (12, 2)
    assert (command.mode, command.status) == (Mode.TRACKING, QpStatus.SOLVED)


def test_plan_shorter_than_its_validity_ends_it() -> None:
    controller = Controller(Rti(pioneer(N=2), compile=False), Timing(), compile=False)
    controller.receive_reference(reference(circle()))
    command = drive(controller, robot(circle()), 0.2).commands[0]
    assert command.valid_until_ns == command.stamp_ns + 200 * MS


def test_held_inputs_are_expanded() -> None:
    controller = Controller(Rti(pioneer(N=6, N_u=2), compile=False), Timing(), compile=False)
    controller.receive_reference(reference(circle()))
    command = drive(controller, robot(circle()), 0.2).commands[0]
    assert command.u.shape == (6, 2)
    np.testing.assert_array_equal(command.u[1:], np.tile(command.u[1], (5, 1)))


def test_telemetry_describes_the_sample_of_its_command(on_the_circle: tuple[Controller, Lockstep]) -> None:
    """Also after the next one has been prepared."""
    controller, body = on_the_circle
    state = body.tick()
    command = controller.receive_state(state, body.now_ns)
    assert command is not None
    controller.commit(command)
    before = controller.telemetry(prepare_us=1.0, feedback_us=2.0, latency_us=3.0, slack_s=0.05)
    controller.prepare()
    after = controller.telemetry(prepare_us=1.0, feedback_us=2.0, latency_us=3.0, slack_s=0.05)
    for field in dataclasses.fields(before):
        np.testing.assert_array_equal(getattr(before, field.name), getattr(after, field.name), err_msg=field.name)
    np.testing.assert_array_equal(after.u, command.u)
    np.testing.assert_allclose(after.x0[:2], state.x[:2])
    np.testing.assert_allclose(after.x[0], after.x0, atol=1e-5)
    np.testing.assert_array_equal(after.y, after.x0[:3], "the outputs there")
    t = 1e-9 * command.stamp_ns + 0.1 * np.arange(1, 13)
    np.testing.assert_allclose(after.y_ref[:, :2], circle().position(t), atol=1e-4)  # rows of 20 ms, interpolated
    assert after.cost == pytest.approx(cost(after.x, after.u, after.y_ref, controller._sent.at(after.stamp_ns - 1)[0]), rel=1e-9)


def cost(x: Array, u: Array, y_ref: Array, u_prev: Array) -> float:
    e = x[1:, :3] - y_ref
    du = np.diff(np.vstack([u_prev, u]), axis=0)
    return float(28 * (e**2 @ [1, 1, 0]).sum() + 0.8 * (du**2).sum())


# The grid in time.


@pytest.mark.parametrize("period_ms", slow_but([100, 50, 20, 10], 100, 10))
def test_faster_states_neither_skip_nor_double_a_sample(controller: Controller, period_ms: int) -> None:
    controller.receive_reference(reference(circle()))
    run = drive(controller, robot(circle(), state_period_s=1e-3 * period_ms), 5.0)
    first_ns = run.commands[0].stamp_ns
    assert first_ns == -(-50 // period_ms) * period_ms * MS, "the first states show how fast the clock runs"
    assert [command.stamp_ns for command in run.commands] == [first_ns + k * DT for k in range(len(run.commands))]
    assert len(run.commands) == pytest.approx(50, abs=1)
    assert controller.grid.skipped == 0


@pytest.mark.parametrize("period_ms", [100, 20])
def test_jitter_of_the_robots_clock_neither_skips_nor_doubles_a_sample(controller: Controller, period_ms: int) -> None:
    rng = np.random.default_rng(1)
    controller.receive_reference(reference(circle()))
    body = robot(circle())
    stamps = []
    for i in range(5000 // period_ms):
        stamp_ns = i * period_ms * MS + round(0.25 * period_ms * MS * rng.uniform(-1, 1))
        command = controller.receive_state(State(1, i + 1, stamp_ns, body.x), stamp_ns)
        if command is not None:
            stamps.append(command.stamp_ns)
            controller.commit(command)
            controller.prepare()
    gaps = np.diff(stamps) / DT
    assert controller.grid.skipped == 0
    assert len(stamps) == pytest.approx(50, abs=2)
    assert gaps.min() > 0.5
    assert gaps.max() < 1.5


@pytest.mark.parametrize("drift", [0.97, 1.03])
def test_grid_follows_a_robot_whose_period_drifts(controller: Controller, drift: float) -> None:
    """It samples when the robot does, once each time."""
    controller.receive_reference(reference(circle()))
    run = drive(controller, robot(circle(), state_period_s=0.1 * drift), 20.0)
    assert len(run.commands) == len(run.t_s) - 1, "the first two states show how fast the clock runs"
    assert controller.grid.skipped == 0
    np.testing.assert_allclose(1e-9 * np.array([c.stamp_ns for c in run.commands]), np.array(run.t_s[1:]), atol=0.1 * 0.03 + 1e-9)
    assert run.error_mm(circle())[150:].max() < 0.3


@pytest.mark.parametrize(("delay_s", "latency_s"), slow_but([(0.0, 0.0), (0.05, 0.04), (0.1, 0.1), (0.23, 0.2)], (0.0, 0.0), (0.23, 0.2)))
def test_plan_starts_where_the_robot_is_when_it_acts(rti: Rti, delay_s: float, latency_s: float) -> None:
    """Position, heading and speeds alike: predicted over the inputs already sent, in the hardest seconds of the eight."""
    predicted: dict[int, Array] = {}
    controller = Controller(rti, Timing(delay_s=delay_s), compile=False)
    controller.receive_reference(reference(eight()))
    propose = controller._issued.propose

    def noted(*args: Any, **kwargs: Any) -> Any:
        predicted[controller.grid.act_ns] = controller._prediction.x.copy()
        return propose(*args, **kwargs)

    controller._issued.propose = noted  # type: ignore[method-assign]
    run = drive(controller, robot(eight(), state_period_s=0.01), 6.0, latency_s=latency_s)
    assert not run.refused
    true = {round(1e9 * t): x for t, x in zip(run.t_s, run.x, strict=True)}
    compared = [stamp_ns for stamp_ns in predicted if stamp_ns in true]
    assert len(compared) > 50
    for stamp_ns in compared:
        np.testing.assert_allclose(predicted[stamp_ns], true[stamp_ns], atol=2e-4)  # one RK4 step of up to 0.1 s against the plant's many
    errors = run.error_mm(eight())
    assert errors[-1] < errors[0] / 10


@pytest.mark.parametrize(("delay_s", "latency_s"), slow_but([(0.05, 0.04), (0.1, 0.1), (0.23, 0.2)], (0.23, 0.2)))
def test_delay_that_is_known_costs_nothing(rti: Rti, delay_s: float, latency_s: float) -> None:
    errors = []
    for delay, latency in ((0.0, 0.0), (delay_s, latency_s)):
        controller = Controller(rti, Timing(delay_s=delay), compile=False)
        controller.receive_reference(reference(circle()))
        errors.append(drive(controller, robot(circle(), state_period_s=0.05), 30.0, latency_s=latency).error_mm(circle())[500:].max())
    assert errors[1] < errors[0] + 0.01


@pytest.mark.parametrize("gain", [0.4, 2.5])
def test_parameters_of_a_reference_are_those_of_the_robot_wherever_it_is_predicted(gain: float) -> None:
    """A robot whose inputs do more or less than nominal, with a delay and an observer: as if that were nominal."""
    errors = []
    for nominal in (gain, 1.0):
        x, u, p = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("p")
        model = Model(
            "motor",
            x,
            u,
            p * u,
            p=p,
            parameters=(Signal("gain", "m/(V s)"),),
            p_nominal=[nominal],
            states=(Signal("x", "m"),),
            inputs=(Signal("u", "V"),),
            y_expr=x,
            outputs=(Signal("x", "m"),),
        )
        observer = Observer(model, ObserverSettings(), compile=False)
        rti = Rti(Ocp(observer.model, N=10, dt=0.1, Q=[1.0], R=[1e-3], lbu=[-3.0], ubu=[3.0]), compile=False)
        controller = Controller(rti, Timing(delay_s=0.3), observer=observer, compile=False)
        y = np.sin(2.0 * 0.02 * np.arange(1000))[:, None]
        controller.receive_reference(Reference(1, 1, 0, 20 * MS, End.HOLD, y, np.full_like(y, gain)))
        plant = dataclasses.replace(model, p_nominal=[gain])
        run = drive(controller, Lockstep(RobotSettings(plant, np.zeros(1), state_period_s=0.1)), 10.0, latency_s=0.25)
        t = np.array(run.t_s)
        errors.append((np.array(run.x)[:, 0] - np.sin(2.0 * t))[t > 3.0])
    np.testing.assert_allclose(errors[1], errors[0], rtol=0, atol=1e-6)  # solver's tolerance


def test_reference_and_prediction_begin_where_the_command_acts(rti: Rti) -> None:
    controller = Controller(rti, Timing(delay_s=0.17), compile=False)
    controller.receive_reference(reference(circle()))
    run = drive(controller, robot(circle()), 5.0)
    command = run.commands[-1]
    telemetry = controller.telemetry(prepare_us=0, feedback_us=0, latency_us=0, slack_s=0)
    assert command.stamp_ns == command.state_stamp_ns + 170 * MS
    assert telemetry.state_age_s == pytest.approx(0.17)
    np.testing.assert_allclose(telemetry.y_ref[0, :2], circle().position(np.array(1e-9 * command.stamp_ns + 0.1)), atol=1e-4)
    assert command.valid_until_ns == command.state_stamp_ns + 420 * MS


def test_states_that_go_back_a_little_are_not_used(on_the_circle: tuple[Controller, Lockstep]) -> None:
    controller, body = on_the_circle
    state = body.tick()
    command = controller.receive_state(state, body.now_ns)
    assert command is not None
    controller.commit(command)
    controller.prepare()
    for back_ms in (0, 100, 220):
        assert controller.receive_state(dataclasses.replace(state, seq=state.seq + 1, stamp_ns=state.stamp_ns - back_ms * MS), body.now_ns) is None
    assert controller.mode is Mode.TRACKING


# References.


def test_reference_on_arrival_starts_at_the_state_and_is_handed_back_with_its_stamp(controller: Controller) -> None:
    body = robot(circle())
    drive(controller, body, 1.0)
    anchored = controller.receive_reference(reference(circle(), stamp_ns=STAMP_ON_ARRIVAL))
    assert anchored is not None
    assert anchored.stamp_ns == body.now_ns
    assert controller.receive_reference(reference(circle())) is None
    controller.receive_reference(anchored)
    run = drive(controller, body, 3.0)
    assert run.commands[0].mode is Mode.TRACKING


def test_reference_on_arrival_waits_for_the_first_state(controller: Controller) -> None:
    body = robot(circle())
    body.advance(700 * MS)
    assert controller.receive_reference(reference(circle(), stamp_ns=STAMP_ON_ARRIVAL)) is None
    assert len(drive(controller, body, 0.8).commands) == 1
    telemetry = controller.telemetry(prepare_us=0, feedback_us=0, latency_us=0, slack_s=0)
    np.testing.assert_allclose(telemetry.y_ref[0, :2], circle().position(np.array(0.2)), atol=1e-4)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"y": np.zeros((0, 3))}, "got 0 rows of 3"),
        ({"y": np.zeros((5, 2))}, "got 5 rows of 2"),
        ({"p": np.zeros((1, 3))}, "and 3, "),
        ({"period_ns": 0}, "positive period"),
    ],
)
def test_reference_that_does_not_fit_is_refused_with_what_would_be_right(
    on_the_circle: tuple[Controller, Lockstep], change: dict[str, Any], text: str
) -> None:
    controller, body = on_the_circle
    assert controller.receive_reference(dataclasses.replace(to_go((0.0, 0.0, 0.0)), **change)) is None
    notice = controller.notices()[-1]
    assert notice.code == "reference_refused"
    assert text in notice.text
    assert "rows of 3 outputs and of 0 or 7 parameters" in notice.text
    assert set(modes(drive(controller, body, 16.0))) == {Mode.TRACKING}  # the one before is followed on


def test_reference_that_ends_with_hold_is_held(controller: Controller) -> None:
    body = robot(positioning())
    controller.receive_reference(to_go((1.5, 0.7, 3.6), rows=11))
    run = drive(controller, body, 25.0)
    assert modes(run)[:10] == [Mode.TRACKING] * 10
    assert modes(run)[-1] is Mode.HOLDING
    assert controller.notices()[-1].text == "tracking to holding: the reference has ended"
    assert np.abs(run.x[-1][3:]).max() < 1e-3


@pytest.mark.parametrize("speed_m_s", [0.21, 0.3])
def test_robot_comes_to_rest_at_the_last_waypoint_of_an_open_path(controller: Controller, speed_m_s: float) -> None:
    path = waypoints(np.array([[0.0, 0.0], [1.01, 0.0]]), speed_m_s)
    body = robot(path)
    controller.receive_reference(reference(path, period_ms=50))
    run = drive(controller, body, path.duration_s + 15.0)
    assert modes(run)[-1] is Mode.HOLDING
    np.testing.assert_allclose(run.x[-1][:2], [1.01, 0.0], atol=1e-3)  # m: it is approached ever more slowly
    assert np.abs(run.x[-1][3:]).max() < 1e-3


def test_reference_that_ends_with_stop_is_braked_after_inside_the_slew_limits(on_the_circle: tuple[Controller, Lockstep]) -> None:
    controller, body = on_the_circle
    path = circle().lasting(17.0)
    controller.receive_reference(reference(path))
    run = drive(controller, body, 20.0)
    stamps = np.array([c.stamp_ns for c in run.commands])
    assert {c.mode for c in run.commands if c.stamp_ns <= 17_000 * MS} == {Mode.TRACKING}
    assert {c.mode for c in run.commands if c.stamp_ns > 17_000 * MS} == {Mode.BRAKING}
    assert len(stamps) == 50
    assert_inside_slew(run)
    np.testing.assert_array_equal(run.commands[-1].u, 0.0)
    assert controller.at_rest
    controller.receive_reference(reference(circle()))
    assert set(modes(drive(controller, body, 21.0))) == {Mode.TRACKING}


def wrapped(psi: Array) -> Array:
    return np.pi - np.remainder(np.pi - psi, 2 * np.pi)


def test_angles_that_wrap_change_nothing() -> None:
    """Of states, as robots send them, and of references, as planners do; nor does it matter how often either has gone round."""
    rti, path = Rti(pioneer(), SolverSettings(eps=1e-8, max_iter=4000), compile=False), circle().lasting(45.0)

    def commands(of_state: Callable[[Array], Array], of_reference: Callable[[Array], Array]) -> Array:
        controller = Controller(rti, Timing(), compile=False)
        body = robot(circle())
        message = reference(path, "consistent")
        y = message.y.copy()
        y[:, 2] = of_reference(y[:, 2])
        controller.receive_reference(dataclasses.replace(message, y=y))

        def sees(state: State) -> State:
            state.x[2] = of_state(body.x[2])
            return state

        return np.array([c.u[0] for c in drive(controller, body, 40.0, sees=sees).commands])

    def kept(psi: Array) -> Array:
        return psi

    expected = commands(kept, kept)
    for of_state, of_reference in (
        (wrapped, kept),
        (kept, wrapped),
        (wrapped, wrapped),
        (kept, lambda psi: psi + 6 * np.pi),
        (lambda psi: psi - 4 * np.pi, kept),
    ):
        np.testing.assert_allclose(commands(of_state, of_reference), expected, atol=1e-6)


# An operator.


def test_stop_is_latched_until_enable(on_the_circle: tuple[Controller, Lockstep]) -> None:
    controller, body = on_the_circle
    controller.notices()
    controller.stop("by hand")
    controller.stop("by hand again")
    run = drive(controller, body, 19.0)
    assert set(modes(run)) == {Mode.STOPPED}
    assert_inside_slew(run)
    assert np.abs(run.x[-1][3:]).max() < 1e-3
    controller.receive_reference(reference(circle()))
    assert set(modes(drive(controller, body, 20.0))) == {Mode.STOPPED}
    controller.enable()
    controller.enable()
    run = drive(controller, body, 40.0)
    assert set(modes(run)) == {Mode.TRACKING}
    assert_inside_slew(run)
    assert run.error_mm(circle())[-10:].max() < 0.5
    said = codes(controller)
    assert said.count("stop") == said.count("enable") == 1


def test_last_command_of_a_life_is_a_standstill(on_the_circle: tuple[Controller, Lockstep]) -> None:
    controller, body = on_the_circle
    body.tick()
    command = controller.standstill(body.now_ns)
    assert command is not None
    np.testing.assert_array_equal(command.u, 0.0)
    assert command.seq == controller._issued.seq + 1
    assert body.accept(command) == ""


# All commands.


@pytest.mark.parametrize("max_iter", slow_but([1, 3], 1))
def test_commands_are_exactly_inside_bounds_and_increments_whatever_the_solver_does(max_iter: int) -> None:
    ocp = pioneer(N=7)
    controller = Controller(Rti(ocp, SolverSettings(max_iter=max_iter, check_termination=1), compile=False), Timing(), compile=False)
    body = robot(eight(), noise_std=np.full(5, 0.05), seed=3)
    controller.receive_reference(reference(eight()))
    run = drive(controller, body, 30.0)
    plans = np.array([command.u for command in run.commands])
    assert np.all(plans >= ocp.lbu)
    assert np.all(plans <= ocp.ubu)
    assert plans.max() == 0.745
    assert_inside_slew(Run(commands=run.commands), excess=1e-14)  # of rounding
    for last, command in itertools.pairwise(run.commands):
        if last.mode is command.mode is Mode.TRACKING:
            assert np.all(np.abs(command.u[0] - last.u[0]) <= STEP)


def test_same_states_give_the_same_commands_bit_for_bit(rti: Rti) -> None:
    runs = []
    for _ in range(2):
        controller = Controller(rti, Timing(delay_s=0.03), compile=False)
        controller.receive_reference(reference(eight()))
        runs.append(drive(controller, robot(eight(), noise_std=np.full(5, 0.01), dropout=0.1, state_period_s=0.05), 10.0))
    for one, other in zip(runs[0].commands, runs[1].commands, strict=True):
        np.testing.assert_array_equal(one.u, other.u)
        assert (one.stamp_ns, one.seq, one.mode, one.status) == (other.stamp_ns, other.seq, other.mode, other.status)
