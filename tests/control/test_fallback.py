# SPDX-License-Identifier: Apache-2.0
"""Fallbacks of a controller in lockstep: QPs that fail, states that do not come, and the ramps that answer them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.ladder import MAX_FALLBACK_SAMPLES
from rti_mpc.reference.trajectory import circle
from rti_mpc.rti.rti import Rti
from rti_mpc_sim.lockstep import Lockstep
from tests.loop import MS, STEP, Run, assert_inside_slew, drive, modes, reference, robot


@pytest.fixture
def failing(rti: Rti, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Let the next QPs fail."""
    left = 0
    assert rti.active_set is not None
    solve, solve_qp = rti.active_set.solve, rti.solve_qp

    def gives_up() -> bool:
        return left == 0 and solve()

    def fails() -> QpStatus:
        nonlocal left
        if left == 0:
            return solve_qp()
        left -= 1
        return QpStatus.INFEASIBLE

    def fail(times: int) -> None:
        nonlocal left
        left = times

    monkeypatch.setattr(rti.active_set, "solve", gives_up)
    monkeypatch.setattr(rti, "solve_qp", fails)
    return fail


def test_failed_qps_play_the_shifted_plan_and_then_brake(on_the_circle: tuple[Controller, Lockstep], failing: Callable[[int], None]) -> None:
    controller, body = on_the_circle
    good = drive(controller, body, 15.1).commands[-1]
    failing(100)
    run = drive(controller, body, 16.0)
    assert modes(run) == [Mode.FALLBACK] * 2 + [Mode.BRAKING] * 7  # the third would act when the plan has expired
    for i, command in enumerate(run.commands[:2]):
        np.testing.assert_array_equal(command.u[0], good.u[i + 1])
        np.testing.assert_array_equal(command.u[-1], good.u[-1])
        assert command.valid_until_ns == good.valid_until_ns  # never renewed
        assert command.status is QpStatus.INFEASIBLE
    assert [n.code for n in controller.notices() if n.code != "mode"] == ["qp_failed", "no_plan"]
    assert controller.ladder.fallbacks == 9
    ramp = run.commands[2]
    assert_inside_slew(run, excess=0.1)  # the robot brakes in steps of 10 ms
    np.testing.assert_array_equal(ramp.u[-1], 0.0)


def test_shifted_plan_serves_three_samples_at_most(failing: Callable[[int], None], rti: Rti) -> None:
    """However long it might still act."""
    controller = Controller(rti, Timing(valid_s=1.0), compile=False)
    controller.receive_reference(reference(circle()))
    body = robot(circle())
    drive(controller, body, 5.0)
    failing(100)
    run = drive(controller, body, 6.6)
    assert MAX_FALLBACK_SAMPLES == 3
    assert modes(run) == [Mode.FALLBACK] * 3 + [Mode.BRAKING] * 13
    assert_inside_slew(run)
    ladder = controller.ladder
    assert (ladder.shifted, ladder.braked + ladder.rested, ladder.fallbacks) == (3, 13, 16)
    assert ladder.rested == sum(not command.u.any() for command in run.commands)
    np.testing.assert_array_equal(run.commands[-1].u, 0.0)


def test_robot_and_controller_agree_on_what_acts_after_the_last_valid_plan(
    on_the_circle: tuple[Controller, Lockstep], failing: Callable[[int], None]
) -> None:
    """The plan of a fallback expires; the ramp starts from where the robot's own braking has come to."""
    controller, body = on_the_circle
    failing(100)
    run = drive(controller, body, 15.4)
    at_the_end = body.u.copy()
    command = drive(controller, body, 15.5, run=run).commands[-1]
    assert command.mode is Mode.BRAKING
    assert np.all(np.abs(command.u[0] - at_the_end) <= STEP + 0.1 * STEP + 1e-12)  # the robot brakes in steps of 10 ms


@pytest.mark.parametrize("failures", [1, 3, 4, 30])
def test_after_failures_one_good_qp_is_enough(on_the_circle: tuple[Controller, Lockstep], failing: Callable[[int], None], failures: int) -> None:
    controller, body = on_the_circle
    failing(failures)
    run = drive(controller, body, 20.0)
    first = next(i for i, command in enumerate(run.commands) if command.mode is Mode.TRACKING)
    assert all(mode is Mode.TRACKING for mode in modes(run)[first:])
    assert first <= (failures if failures <= MAX_FALLBACK_SAMPLES else MAX_FALLBACK_SAMPLES + -(-(failures - MAX_FALLBACK_SAMPLES) // 3))
    assert_inside_slew(run, excess=0.1)
    later = drive(controller, body, 30.0)
    assert later.error_mm(circle())[-10:].max() < 0.5


def test_failures_are_counted_anew_after_a_success(on_the_circle: tuple[Controller, Lockstep], failing: Callable[[int], None]) -> None:
    controller, body = on_the_circle
    until_s = 15.0
    for _ in range(4):
        failing(2)
        until_s += 0.3
        run = drive(controller, body, until_s)
        assert modes(run) == [Mode.FALLBACK] * 2 + [Mode.TRACKING]
    assert controller.ladder.fallbacks == 8


def test_first_qp_that_fails_leaves_the_robot_at_rest(controller: Controller, failing: Callable[[int], None]) -> None:
    controller.receive_reference(reference(circle()))
    body = robot(circle())
    failing(6)
    run = drive(controller, body, 1.0)
    assert modes(run)[:2] == [Mode.BRAKING] * 2
    np.testing.assert_array_equal(run.commands[0].u, 0.0)
    assert set(modes(run)[2:]) == {Mode.TRACKING}


def test_stale_state_is_answered_by_one_ramp(controller: Controller, rti: Rti) -> None:
    controller = Controller(rti, Timing(stale_s=0.12), compile=False)
    body = robot(circle())
    controller.receive_reference(reference(circle()))
    last = drive(controller, body, 4.0).commands[-1]
    assert controller.tick(body.now_ns + 120 * MS) is None
    command = controller.tick(body.now_ns + 125 * MS)
    assert command is not None
    assert controller.tick(body.now_ns + 130 * MS) is None
    assert controller.tick(body.now_ns + 900 * MS) is None
    assert (command.mode, command.status) == (Mode.BRAKING, QpStatus.NONE)
    assert command.valid_until_ns == command.stamp_ns + 250 * MS  # a ramp is as right without a state
    assert command.stamp_ns < last.valid_until_ns  # so that it takes over from a plan that still acts
    assert command.stamp_ns == pytest.approx(body.now_ns + 125 * MS, abs=MS)
    assert np.all(np.abs(command.u[0] - last.u[1]) <= STEP)
    assert_inside_slew(Run(commands=[command]))
    np.testing.assert_array_equal(command.u[-1], 0.0)
    notice = controller.notices()[-1]
    assert (notice.code, notice.severity.name) == ("state_stale", "ERROR")
    assert "no state for 0.12" in notice.text


def test_ramps_are_built_from_commands_never_from_measured_speeds(on_the_circle: tuple[Controller, Lockstep]) -> None:
    """A speed sensor that lies must not make the robot brake from there."""
    controller, body = on_the_circle
    controller.stop("test")
    state = body.tick()
    state.x[3:] = 30.0, -30.0
    sent = controller._sent.at(state.stamp_ns - 1)[0].copy()
    command = controller.receive_state(state, body.now_ns)
    assert command is not None
    assert np.all(np.abs(command.u[0] - sent) <= STEP)
    assert np.all(np.abs(command.u[0]) <= np.abs(sent))
