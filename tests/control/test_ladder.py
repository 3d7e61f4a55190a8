# SPDX-License-Identifier: Apache-2.0
"""Each rung of the ladder, reached by a failure inside the real-time iteration."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, End, Reference
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.ladder import MAX_FALLBACK_SAMPLES, Ladder
from rti_mpc.reference.trajectory import circle
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import BUILT_IN_SOLVERS
from rti_mpc_service.injection import FAILURES, MAX_FAILING_SAMPLES, FaultyRti, answer
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, Run, codes, drive, reference, robot
from tests.movers import law_of, ocp_of
from tests.problems import double_integrator, pioneer
from tests.slow import slow_but

DT = 100 * MS
STEP = np.array([0.25, 0.4])  # slew limit per dt


@pytest.fixture(scope="module")
def rti() -> FaultyRti:
    return FaultyRti(pioneer(N=12, Q=[1.0, 1.0, 0.0]), SolverSettings(eps=1e-6, max_iter=4000), compile=False)


@pytest.fixture
def driving(rti: FaultyRti) -> tuple[Controller, Lockstep]:
    """A robot that has followed the circle for 5 s."""
    controller, body = Controller(rti, Timing(), compile=False), robot(circle())
    controller.receive_reference(reference(circle()))
    drive(controller, body, 5.0)
    controller.notices()
    return controller, body


def begun(rti: FaultyRti) -> tuple[Controller, Lockstep, Command]:
    """A controller that has proposed its first plan."""
    controller, body = Controller(rti, Timing(), compile=False), robot(circle())
    controller.receive_reference(reference(circle()))
    assert controller.receive_state(body.tick(), body.now_ns) is None
    command = controller.receive_state(body.tick(), body.now_ns)
    assert command is not None
    return controller, body, command


def cold_starts(rti: FaultyRti, monkeypatch: pytest.MonkeyPatch) -> list[Array]:
    """The states from which samples start cold from now on."""
    starts, cold = list[Array](), rti.reset

    def reset(x0: Array, u_prev: Array) -> None:
        starts.append(x0.copy())
        cold(x0, u_prev)

    monkeypatch.setattr(rti, "reset", reset)
    return starts


def fail(rti: FaultyRti, failure: str, samples: int) -> None:
    assert rti.inject({"failure": failure, "samples": samples})["ok"]


def sample(controller: Controller, body: Lockstep, took_ms: float = 0.0) -> Command | None:
    """One sample, published after some time."""
    command = controller.receive_state(body.tick(), body.now_ns)
    assert command is not None
    command = controller.in_time(command, body.now_ns + round(took_ms * MS))
    if command is not None:
        assert body.accept(command, body.now_ns) == ""
        controller.commit(command, body.now_ns + round(took_ms * MS))
    controller.prepare()
    return command


# The rungs.


def test_another_solver_takes_over_where_the_first_fails(driving: tuple[Controller, Lockstep], rti: FaultyRti) -> None:
    controller, body = driving
    fail(rti, "solver", 5)
    run = drive(controller, body, 10.0)
    assert {command.mode for command in run.commands} == {Mode.TRACKING}
    assert controller.ladder == Ladder(softened=5)
    assert run.error_mm(circle())[-10:].max() < 1.0


def test_each_rung_is_counted(driving: tuple[Controller, Lockstep], rti: FaultyRti) -> None:
    controller, body = driving
    fail(rti, "qp", 10)
    run = drive(controller, body, 6.5)
    by_mode = [command.mode for command in run.commands]
    assert by_mode.count(Mode.FALLBACK) == controller.ladder.shifted == 2
    braking = [command for command in run.commands if command.mode is Mode.BRAKING]
    assert controller.ladder.rested == sum(not command.u.any() for command in braking)
    assert controller.ladder.braked + controller.ladder.rested == len(braking)
    assert controller.ladder.fallbacks == 10
    assert controller.mode is Mode.TRACKING


@pytest.mark.parametrize("failed", [1, 2, 3, 4, 7])
def test_ladder_lets_the_previous_plan_play_three_times_at_most(failed: int) -> None:
    ladder = Ladder()
    assert [ladder.fall(plan_left=True) for _ in range(failed)] == [i < MAX_FALLBACK_SAMPLES for i in range(failed)]
    assert not Ladder().fall(plan_left=False)


@pytest.mark.parametrize("samples", [1, 3, 20])
def test_model_that_gave_nan_is_forgotten_within_two_samples(driving: tuple[Controller, Lockstep], rti: FaultyRti, samples: int) -> None:
    controller, body = driving
    fail(rti, "nan_model", samples)
    run = drive(controller, body, 5.0 + 0.1 * (samples + 4))
    tracking = [command.mode is Mode.TRACKING for command in run.commands]
    assert tracking.count(False) >= samples
    assert all(tracking[1 + samples + 2 :])
    for command in run.commands:
        assert np.isfinite(command.u).all()
    assert_applied_inside_slew(controller, body, run)


@pytest.mark.parametrize(
    ("name", "solver"),
    slow_but(product(("car", "quadrotor", "double_integrator"), BUILT_IN_SOLVERS), ("quadrotor", "riccati"), ("car", "osqp")),
)
def test_model_without_parameters_can_give_nan_too(name: str, solver: str) -> None:
    ocp = double_integrator() if name == "double_integrator" else ocp_of(name)
    rti = FaultyRti(ocp, solver=solver, compile=False)
    x = rti.x_nominal.copy()
    y_ref = np.tile(np.array(ocp.model.h()(x, ocp.model.p_nominal)).ravel(), (ocp.N, 1))
    rti.prepare(y_ref)
    assert rti.feedback(x).usable
    fail(rti, "nan_model", 1)
    rti.prepare(y_ref)
    assert not rti.feedback(x).usable
    rti.reset(x, np.array(ocp.model.u_rest))
    rti.prepare(y_ref, shift=False)
    assert rti.feedback(x).usable


# Over budget.


def test_sample_over_its_budget_is_not_sent_and_the_previous_plan_plays_on(driving: tuple[Controller, Lockstep]) -> None:
    controller, body = driving
    good = sample(controller, body)
    assert good is not None
    assert sample(controller, body, took_ms=105) is None
    assert controller.mode is Mode.FALLBACK
    (notice,) = controller.notices()
    assert notice.code == "over_budget"
    assert "0.105 s late" in notice.text
    assert (controller.ladder.shifted, controller.ladder.failed) == (1, 1)
    after = sample(controller, body)
    assert after is not None
    np.testing.assert_array_equal(controller._sent.at(after.stamp_ns - 1)[0], good.u[1])  # what the robot played meanwhile
    assert (after.mode, after.seq, after.stamp_ns) == (Mode.TRACKING, good.seq + 1, good.stamp_ns + 2 * DT)  # in phase, and no number is lost
    assert controller.mode is Mode.TRACKING
    assert controller.ladder.failed == 0


def test_samples_over_budget_brake_when_no_plan_is_left(driving: tuple[Controller, Lockstep]) -> None:
    controller, body = driving
    commands = [sample(controller, body, took_ms=110) for _ in range(6)]
    assert commands[0] is None  # the second is in time only after the plan has expired
    ramps = [command for command in commands if command is not None]
    assert {command.mode for command in ramps} == {Mode.BRAKING}
    assert ramps[0].stamp_ns == body.now_ns - 4 * DT + 110 * MS  # not when it should have acted
    assert not ramps[-1].u.any()
    assert codes(controller) == ["over_budget", "over_budget"]
    again = sample(controller, body)
    assert again is not None
    assert controller.mode is again.mode is Mode.TRACKING


@pytest.mark.parametrize("name", slow_but(["pioneer", "arm", "car"], "pioneer", "car"))
def test_robot_is_driven_though_only_samples_that_start_cold_take_longer_than_a_period(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Under load a cold sample may take several periods. If the next one started cold again, the robot would never move."""
    ocp, law = ocp_of(name), law_of(name)
    rti = FaultyRti(ocp, compile=False)
    controller = Controller(rti, Timing(), stop_law=law, compile=False)
    y = np.tile(np.eye(ocp.model.ny)[0], (400, 1))
    controller.receive_reference(Reference(1, 1, 0, round(1e9 * ocp.dt), End.HOLD, y, np.zeros((400, 0))))
    body = Lockstep(RobotSettings(ocp.model, np.zeros(ocp.model.nx), np.full(ocp.model.nu, 1e3), state_period_s=ocp.dt))
    starts, busy_ns, driven = cold_starts(rti, monkeypatch), 0, list[Mode]()
    for _ in range(40):
        state, before = body.tick(), len(starts)
        if body.now_ns < busy_ns:
            continue  # the controller takes the newest state when it is ready
        command = controller.receive_state(state, body.now_ns)
        if command is None:
            continue
        busy_ns = body.now_ns + round((1.8 if len(starts) > before else 0.3) * 1e9 * ocp.dt)
        command = controller.in_time(command, busy_ns)
        if command is not None:
            controller.commit(command, busy_ns)
            driven.append(command.mode)
            body.accept(command, body.now_ns)
        controller.prepare()
    assert len(starts) == 1, "the others begin with the plan of the one before, sent or not"
    assert driven[-30:] == [Mode.TRACKING] * 30


def test_plan_that_was_late_is_not_gone_on_with_when_it_would_have_run_out(rti: FaultyRti) -> None:
    controller, body, late = begun(rti)
    assert controller.in_time(late, body.now_ns + 110 * MS) is not late
    controller.prepare()
    for _ in range(3):
        body.tick()
    controller.notices()
    controller.receive_state(body.tick(), body.now_ns)
    assert "gap" in codes(controller)


@pytest.mark.parametrize("ready_ms", [240, 280])
def test_ramp_that_still_acts_keeps_the_samples_in_phase_when_a_late_plan_has_run_out(
    rti: FaultyRti, ready_ms: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sample of almost three periods: its plan is valid until 250 ms, the ramp that was sent instead for longer."""
    (controller, body, late), starts = begun(rti), cold_starts(rti, monkeypatch)
    ready_ns = body.now_ns + ready_ms * MS
    ramp = controller.in_time(late, ready_ns)
    assert ramp is not None
    controller.commit(ramp, ready_ns)
    controller.prepare()
    for _ in range(2):
        body.tick()
    controller.notices()
    command = controller.receive_state(body.tick(), body.now_ns)
    assert command is not None
    assert command.stamp_ns == late.stamp_ns + 3 * DT
    assert "gap" not in codes(controller)
    assert len(starts) == 1, "it starts cold"


def test_nothing_is_prepared_from_a_late_plan_that_has_run_out_when_it_is_ready(rti: FaultyRti) -> None:
    controller, body, late = begun(rti)
    controller.commit(controller.in_time(late, body.now_ns + 600 * MS) or late)
    fail(rti, "qp", 1)
    controller.prepare()
    for _ in range(6):
        body.tick()
    command = controller.receive_state(body.tick(), body.now_ns)
    assert command is not None
    assert command.mode is Mode.BRAKING, "the next sample fails, which begins with its state"


def test_ramp_that_is_late_itself_is_counted_once(driving: tuple[Controller, Lockstep], rti: FaultyRti) -> None:
    controller, body = driving
    fail(rti, "qp", 6)  # one sample is prepared already
    for _ in range(6):
        sample(controller, body)
    before = controller.ladder.fallbacks
    assert sample(controller, body, took_ms=110) is not None
    assert controller.ladder.fallbacks == before + 1


def test_sample_inside_its_budget_is_sent_as_it_is(driving: tuple[Controller, Lockstep]) -> None:
    controller, body = driving
    command = sample(controller, body, took_ms=70)
    assert command is not None
    assert command.mode is Mode.TRACKING
    assert controller.ladder == Ladder()


def test_delay_that_is_known_is_part_of_the_budget(rti: FaultyRti) -> None:
    controller, body = Controller(rti, Timing(delay_s=0.05), compile=False), robot(circle())
    controller.receive_reference(reference(circle()))
    drive(controller, body, 2.0)
    assert sample(controller, body, took_ms=120) is not None
    assert sample(controller, body, took_ms=130) is None


def test_sample_right_after_a_restart_is_held_to_its_budget_though_the_speed_of_the_simulation_is_not_known_yet(rti: FaultyRti) -> None:
    """At four times real speed 25 ms are a period; a rate assumed low would take them for 2.5."""
    speed, controller, body = 4, Controller(rti, Timing(), compile=False), robot(circle())
    controller.receive_reference(reference(circle()))
    for k in range(4):
        arrival_ns = (state := body.tick()).stamp_ns // speed
        command = controller.receive_state(state, arrival_ns)
        assert (command is not None) == (k >= 2), "the first two show how fast the clock runs, roughly"
        if command is not None:
            assert controller.in_time(command, arrival_ns + 1 * MS) is command
            controller.commit(command, arrival_ns + 1 * MS)
            controller.prepare()
    arrival_ns = (state := body.tick()).stamp_ns // speed
    command = controller.receive_state(state, arrival_ns)
    assert command is not None
    assert controller.in_time(command, arrival_ns + 25 * MS) is None


def test_first_state_of_a_life_is_left_unanswered_without_a_word(rti: FaultyRti) -> None:
    """Before a second state has arrived, the rate of the robot's clock is unknown."""
    controller, body = Controller(rti, Timing(), compile=False), robot(circle())
    controller.receive_reference(reference(circle()))
    assert controller.receive_state(body.tick(), body.now_ns) is None
    controller.notices()
    second = sample(controller, body, took_ms=10)
    assert second is not None
    assert (second.seq, codes(controller), controller.ladder) == (1, ["mode"], Ladder())


# Gaps.


def test_states_that_have_waited_while_the_controller_was_stopped_are_not_acted_on(driving: tuple[Controller, Lockstep]) -> None:
    """As after SIGSTOP and SIGCONT: they come all at once; that the newest is fresh is known when the next one comes."""
    controller, body = driving
    waiting = [body.tick() for _ in range(15)]
    for state in waiting[:-3]:  # fresh enough are the last three
        assert controller.receive_state(state, body.now_ns) is None
    assert codes(controller) == ["state_old"]
    assert controller.receive_state(waiting[-1], body.now_ns) is None
    assert codes(controller)[-1] == "gap"
    command = controller.receive_state(body.tick(), body.now_ns)
    assert command is not None
    assert command.stamp_ns == body.now_ns
    assert np.all(np.abs(command.u[0] - body.actuator.u) <= STEP)


@pytest.mark.parametrize("outage_s", slow_but([0.15, 0.35, 0.65, 1.5, 4.0], 0.15, 0.65, 4.0))
@pytest.mark.parametrize("latency_ms", slow_but([0, 3, 33, 90], 3, 90))
def test_increments_hold_as_they_are_applied_across_any_gap(rti: FaultyRti, outage_s: float, latency_ms: int) -> None:
    """However late the first command comes, and whatever the reference has done meanwhile."""
    controller, body = Controller(rti, Timing(), compile=False), robot(circle(), state_period_s=0.05)
    controller.receive_reference(reference(circle()))
    played = Played(body)
    for gap_s in (3.0, 6.0):
        drive(controller, body, gap_s, latency_s=1e-3 * latency_ms)
        drive(controller, body, gap_s + outage_s, sees=lambda _: None)
        controller.receive_reference(reference(circle(), stamp_ns=round(-1e9 * gap_s)))
    drive(controller, body, 12.0, latency_s=1e-3 * latency_ms)
    played.check()


class Played:
    """The inputs that a robot plays."""

    def __init__(self, body: Lockstep) -> None:
        self.t: list[int] = []
        self.u: list[np.ndarray] = []
        play = body.actuator.play

        def noted(from_ns: int, to_ns: int):  # type: ignore[no-untyped-def]
            for until_ns, u in play(from_ns, to_ns):
                self.t.append(from_ns)
                self.u.append(u.copy())
                yield until_ns, u
                from_ns = until_ns

        body.actuator.play = noted  # type: ignore[method-assign]

    def check(self) -> None:
        """No change within a period exceeds the slew limits."""
        t, u = np.array(self.t), np.array(self.u)
        for i in range(1, len(t)):
            since = np.searchsorted(t, t[i] - DT, side="right") - 1
            change = np.abs(u[max(0, since) : i] - u[i]).max(axis=0)
            assert np.all(change <= (1 + 1e-9) * STEP), (1e-9 * t[i], change)


def assert_applied_inside_slew(controller: Controller, body: Lockstep, run: Run) -> None:
    applied = np.array(run.u)
    assert np.all(np.abs(np.diff(applied, axis=0)) <= 1.1 * STEP)  # the robot brakes in steps of 10 ms


# Requests.


@pytest.mark.parametrize(
    ("request_", "error"),
    [
        ({"failure": "flood"}, "failure must be one of solver, qp, nan_model, gradient, over_budget, got 'flood'"),
        ({}, "got None"),
        ({"failure": "qp", "samples": 0}, f"samples must be a whole number from 1 to {MAX_FAILING_SAMPLES}, got 0"),
        ({"failure": "qp", "samples": "3"}, "got '3'"),
        ({"failure": "qp", "samples": True}, "got True"),
    ],
)
def test_request_that_cannot_be_granted_says_what_would_be_right(rti: FaultyRti, request_: dict[str, object], error: str) -> None:
    given = answer(rti, request_)
    assert given["ok"] is False
    assert error in given["error"]


def test_failures_are_as_many_samples_as_asked_for(driving: tuple[Controller, Lockstep], rti: FaultyRti) -> None:
    controller, body = driving
    for samples in (1, 2):
        fail(rti, "qp", samples)
        run = drive(controller, body, 1e-9 * body.now_ns + 1.0)
        assert sum(command.status is QpStatus.INFEASIBLE for command in run.commands) == samples
    assert set(FAILURES) == {"solver", "qp", "nan_model", "gradient", "over_budget"}
