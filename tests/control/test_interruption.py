# SPDX-License-Identifier: Apache-2.0
"""Interruptions of a controller's samples, in lockstep: gaps, and other lives of the robot."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rti_mpc.contract.status import Mode
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.reference.trajectory import circle
from rti_mpc.rti.rti import Rti
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, SLEW, STEP, Run, codes, drive, modes, reference, robot
from tests.problems import pioneer


@pytest.mark.parametrize("missed", [1, 2])
def test_missed_samples_shift_the_plan_by_the_stages_elapsed(rti: Rti, monkeypatch: pytest.MonkeyPatch, missed: int) -> None:
    """As long as the plan sent last still acts."""
    controller, body = Controller(rti, Timing(valid_s=0.35), compile=False), robot(circle())
    controller.receive_reference(reference(circle()))
    drive(controller, body, 15.0)
    plan = controller.telemetry(prepare_us=0, feedback_us=0, latency_us=0, slack_s=0)
    shifts: list[int] = []
    shift = rti.shift
    monkeypatch.setattr(rti, "shift", lambda: shifts.append(1) or shift())
    monkeypatch.setattr(rti, "reset", lambda *_: pytest.fail("it started anew"))
    for _ in range(missed):
        body.tick()
    state = body.tick()
    x = plan.x[missed + 1]  # where the plan would have the robot now, had it been played to the end
    command = controller.receive_state(dataclasses.replace(state, x=x), body.now_ns)
    assert command is not None
    assert len(shifts) == missed - 1  # and one more by the preparation
    assert controller.grid.skipped == missed
    assert command.stamp_ns == state.stamp_ns
    np.testing.assert_array_equal(rti.u_prev, plan.u[missed])
    np.testing.assert_allclose(command.u[:8], plan.u[1 + missed : 9 + missed], atol=1e-2)  # the horizon has moved on


@pytest.mark.parametrize("missed", [2, 5])
def test_gap_in_which_the_plan_has_run_out_is_followed_by_a_cold_start(
    on_the_circle: tuple[Controller, Lockstep], rti: Rti, monkeypatch: pytest.MonkeyPatch, missed: int
) -> None:
    controller, body = on_the_circle
    monkeypatch.setattr(rti, "shift", lambda: pytest.fail("a plan that has run out was gone on with"))
    for _ in range(missed):
        body.tick()
    state = body.tick()
    command = controller.receive_state(state, body.now_ns)
    assert command is not None
    notice = controller.notices()[-1]
    assert notice.code == "gap"
    assert f"no sample for {missed} periods" in notice.text
    assert controller.grid.skipped == missed
    assert command.stamp_ns == state.stamp_ns
    assert np.all(np.abs(command.u[0] - body.actuator.u) <= STEP)


@pytest.mark.parametrize("missed", [7, 50])
def test_first_state_after_a_long_gap_is_not_answered_for_it_may_have_waited(on_the_circle: tuple[Controller, Lockstep], missed: int) -> None:
    """How late it is only the robot's clock tells, as far as that is known after so long."""
    controller, body = on_the_circle
    for _ in range(missed):
        body.tick()
    assert controller.receive_state(body.tick(), body.now_ns) is None
    assert controller.notices()[-1].code == "gap"
    state = body.tick()
    command = controller.receive_state(state, body.now_ns)
    assert command is not None
    assert command.stamp_ns == state.stamp_ns


@pytest.mark.parametrize("outage_s", [0.5, 1.1, 1.5, 4.0])
def test_outage_recovers_within_three_samples(on_the_circle: tuple[Controller, Lockstep], outage_s: float) -> None:
    """Of the robot's states; one longer than the horizon too."""
    controller, body = on_the_circle
    start = 1e-9 * body.now_ns
    lost = drive(controller, body, start + outage_s, sees=lambda _: None)
    assert [c.mode for c in lost.commands] == ([] if outage_s < 0.25 else [Mode.BRAKING])
    run = drive(controller, body, start + outage_s + 0.5)
    assert all(mode is Mode.TRACKING for mode in modes(run)[:3])
    assert not run.refused
    later = drive(controller, body, start + outage_s + 12.0)
    assert later.error_mm(circle())[-10:].max() < 0.5


def test_robot_that_is_restarted_is_another_robot(on_the_circle: tuple[Controller, Lockstep]) -> None:
    """Its clock starts again: a reference with stamps of the old clock is not followed."""
    controller, _ = on_the_circle
    controller.notices()
    again = Restarted(epoch=2)
    assert again.drive(controller, 0.6).commands == []
    assert controller.mode is Mode.WAITING
    assert "robot_restarted" in codes(controller)
    assert again.drive(controller, 1.0).commands == []
    controller.receive_reference(reference(circle(), stamp_ns=again.body.now_ns))
    run = again.drive(controller, 2.0)
    assert set(modes(run)) == {Mode.TRACKING}
    assert run.commands[0].state_epoch == 2


class Restarted:
    """Another life of the robot, long after the one before."""

    def __init__(self, epoch: int) -> None:
        self.body = Lockstep(RobotSettings(pioneer().model, np.array([*circle().pose0, 0.0, 0.0]), SLEW), epoch=epoch)

    def drive(self, controller: Controller, duration_s: float) -> Run:
        return drive(controller, self.body, duration_s, local_0_ns=10**12)


def test_clock_that_jumps_back_is_another_life_too(on_the_circle: tuple[Controller, Lockstep]) -> None:
    controller, body = on_the_circle
    state = body.tick()
    assert controller.receive_state(dataclasses.replace(state, stamp_ns=state.stamp_ns - 3000 * MS), body.now_ns) is None
    assert "clock_jumped" in codes(controller)
    assert controller.mode is Mode.WAITING


def test_stop_outlasts_a_restart_of_the_robot(on_the_circle: tuple[Controller, Lockstep]) -> None:
    controller, _ = on_the_circle
    controller.stop("by hand")
    again = Restarted(epoch=2)
    again.drive(controller, 0.6)
    controller.receive_reference(reference(circle(), stamp_ns=again.body.now_ns))
    run = again.drive(controller, 2.0)
    assert set(modes(run)) == {Mode.STOPPED}
    assert all(not command.u.any() for command in run.commands)
