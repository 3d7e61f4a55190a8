# SPDX-License-Identifier: Apache-2.0
"""Commands that are lost while states get through, in lockstep: with and without a guard, on either of its links."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.approach import Increments
from rti_mpc.contract.guard import Guard
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.reference.trajectory import eight
from rti_mpc.rti.rti import Rti
from tests.loop import MS, reference, robot
from tests.problems import pioneer
from tests.slow import slow_but

DT = 100 * MS
EIGHT = eight()
STEP = np.array([0.25, 0.4])  # slew limit per dt
BOUND = np.array([0.5, 0.745])
LOSS_DURATION_NS = 800 * MS
FIRST_NS, LAST_NS = 3_000 * MS, 17_000 * MS
LOSS_PERIOD_NS = 2_300 * MS  # from one loss to the next
ROUNDING = 1e-9


def lost(t_ns: int) -> bool:
    """Whether a link loses messages now."""
    return FIRST_NS <= t_ns < LAST_NS and (t_ns - FIRST_NS) % LOSS_PERIOD_NS < LOSS_DURATION_NS


class Scene:
    """A robot on the eight with its controller, and perhaps a guard, whose links lose commands now and then."""

    def __init__(self, *, guarded: bool, at: str, reports: bool = True, state_period_s: float = 0.1, delay_s: float | None = 0.0) -> None:
        self.controller = Controller(Rti(pioneer(N=10), compile=False), Timing(delay_s=delay_s), compile=False)
        self.controller.receive_reference(reference(EIGHT, "consistent"))
        limits = Limits(np.zeros(2), -BOUND, BOUND, -STEP, STEP, dt_s=0.1)
        self.guard = Guard(limits, epoch=10) if guarded else None
        self.body = robot(EIGHT, increments=Increments(-STEP, STEP, DT), reports_inputs=reports, state_period_s=state_period_s)
        self.at = at  # the link that loses
        self.inputs: list[Array] = []  # every 10 ms
        self.jumps: list[float] = []  # by which the first row of what reached the robot was further from what acted than allowed, as a share

    def drive(self, duration_s: float) -> None:
        body, before_ns = self.body, 0
        while body.now_ns < 1e9 * duration_s:
            if body.due_ns > before_ns + 10 * MS:
                before_ns += 10 * MS
                body.advance(before_ns)
                self.inputs.append(body.actuator.u.copy())
                self.actuate(self.guard.tick(before_ns) if self.guard is not None else None)
                continue
            state = body.tick()
            before_ns = body.now_ns
            self.inputs.append(body.actuator.u.copy())
            if self.guard is not None:
                self.guard.receive_state(state, body.now_ns)
            command = self.controller.receive_state(state, body.now_ns)
            if command is not None:
                self.controller.commit(command)
                self.controller.prepare()
                self.send(command)
            if self.guard is not None:
                self.actuate(self.guard.tick(body.now_ns))

    def send(self, command: Command) -> None:
        if self.at == "controller" and lost(self.body.now_ns):
            return
        self.actuate(command if self.guard is None else self.guard.receive_command(command, self.body.now_ns))

    def actuate(self, command: Command | None) -> None:
        body = self.body
        if command is None or (self.at == "guard" and lost(body.now_ns)):
            return
        row = command.u[max(0, (body.now_ns - command.stamp_ns) // command.period_ns)]
        self.jumps.append(float((np.abs(row - body.actuator.u) / STEP).max()))
        body.accept(command)

    @property
    def largest_step(self) -> float:
        """Largest change within three quarters of a period, as a share of the slew limits."""
        u = np.array(self.inputs)
        return max(float((np.abs(u[k:] - u[:-k]) / STEP).max()) for k in range(1, 8))

    def error_m(self) -> float:
        return float(np.hypot(*(self.body.x[:2] - EIGHT.position(np.array([1e-9 * self.body.now_ns]))[0])))


LINKS = [(False, "controller"), (True, "controller"), (True, "guard")]


@pytest.mark.parametrize(("guarded", "at"), LINKS, ids=["no guard", "to the guard", "from the guard"])
@pytest.mark.parametrize("state_period_s", slow_but([0.1, 0.02], 0.02))
def test_commands_lost_for_most_of_a_second_leave_no_step(guarded: bool, at: str, state_period_s: float) -> None:
    scene = Scene(guarded=guarded, at=at, state_period_s=state_period_s)
    scene.drive(20.0)
    assert scene.body.counters.starved + (scene.guard is not None) >= 1
    assert np.abs(np.array(scene.inputs)).max() > 0.3, "it drives"
    assert scene.largest_step <= 1.0 + ROUNDING
    assert max(scene.jumps) <= 1.0 + 0.11, "controller and guard begin where the robot is; one step of its ramp aside"
    assert scene.error_m() < 0.01, "and it catches up"


def test_robot_that_does_not_report_covers_the_loss_by_itself() -> None:
    scene = Scene(guarded=False, at="controller", reports=False)
    scene.drive(20.0)
    assert max(scene.jumps) > 1.2, "the controller believes that its commands acted"
    assert scene.largest_step <= 1.0 + ROUNDING


def test_robot_that_does_not_report_is_told_of_once() -> None:
    said: dict[bool, list[str]] = {}
    for reports in (True, False):
        scene = Scene(guarded=False, at="none", reports=reports)
        scene.drive(3.0)
        said[reports] = [notice.code for notice in scene.controller.notices()]
    assert said[False].count("inputs_unreported") == 1
    assert "inputs_unreported" not in said[True]


@pytest.mark.parametrize("state_period_s", [0.1, 0.01, 0.005])
@pytest.mark.parametrize(("at", "named", "times"), [("none", False, 1), ("none", True, 0), ("controller", True, 0)], ids=["unnamed", "named", "lost"])
def test_robot_whose_inputs_come_from_no_command_is_told_of_once(
    at: str, named: bool, times: int, state_period_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes none, or does not say which, however fast its states come; the loss of commands for less than a second is no such case."""
    scene = Scene(guarded=False, at=at, state_period_s=state_period_s)
    if not named:
        receive = scene.controller.receive_state
        unnamed = lambda state, now_ns: receive(replace(state, command_epoch=0, command_seq=0), now_ns)  # noqa: E731
        monkeypatch.setattr(scene.controller, "receive_state", unnamed)
    scene.drive(20.0)
    assert [notice.code for notice in scene.controller.notices()].count("commands_untaken") == times


@pytest.mark.parametrize("drop", [lambda _: True, lambda k: k % 3 == 0], ids=["a burst", "every third"])
def test_measured_delay_survives_losses(drop: Callable[[int], bool]) -> None:
    """An estimate learnt from commands that never acted is taken back."""
    scene = Scene(guarded=False, at="none", delay_s=None)
    scene.body.actuator._delay_ns = 60 * MS
    scene.drive(12.0)
    estimator = scene.controller._delay
    assert estimator is not None
    learnt_ns = estimator.delay_ns
    assert abs(learnt_ns - 60 * MS) < 13 * MS
    scene.at = "controller" if drop(1) else "none"
    if not drop(1):
        send, count = scene.send, iter(range(10**6))
        scene.send = lambda command: None if drop(next(count)) else send(command)  # type: ignore[method-assign]
    scene.drive(17.5)
    scene.send, scene.at = Scene.send.__get__(scene), "none"  # type: ignore[method-assign]
    scene.drive(18.5)
    assert abs(estimator.delay_ns - learnt_ns) < 26 * MS
    assert scene.largest_step <= 1.0 + ROUNDING
