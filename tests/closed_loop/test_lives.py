# SPDX-License-Identifier: Apache-2.0
"""Robot, controller and guard in lockstep, with a second robot of the same name, or stamps that are not nanoseconds."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.guard import Guard
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command, End, Notice, Reference, State
from rti_mpc.contract.status import Mode
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.rti.rti import Rti
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, PIONEER, SLEW
from tests.problems import pioneer
from tests.slow import slow_but

DT = 100 * MS
STEP = np.array([0.25, 0.4])  # slew limit per dt
BOUND = np.array([0.5, 0.745])
SPEED_M_S = 0.4
RAMP_SLEW_FACTOR = 1.1  # a ramp in steps of 10 ms may change by this factor times the slew limits
LIMITS = Limits(np.zeros(2), -BOUND, BOUND, -STEP, STEP, dt_s=0.1)


class Scene:
    """
    A robot that is to follow a straight line, with a guard or without.

    Time goes on in steps of 10 ms here, in which the robot's clock may advance by anything.
    """

    def __init__(self, rti: Rti, *, guarded: bool, rate: float = 1.0, period_ms: float = 100.0) -> None:
        self.controller = Controller(rti, Timing(), compile=False)
        self.guard = Guard(LIMITS, epoch=5) if guarded else None
        self.rate, self.step_ms = rate, period_ms / 10
        self.speed = rate  # at which the robot lives, whatever its clock shows
        self.local_ns, self.robot_ns, self.states = 10**12, 0.0, 0
        self.sent: list[Command] = []  # to the robot
        self.said: list[Notice] = []
        self.answered = 0
        self.u: list[Array] = []  # what acted, as it changed
        self.t: list[float] = []  # when, ns of its life
        self.begin(1)
        self.refer(1)

    def refer(self, seq: int, stamp_ns: int = 0) -> None:
        """Send the straight line, from a time on, at which the robot is to be where it is at 0."""
        y = np.stack([SPEED_M_S * 0.1 * np.arange(3000), np.zeros(3000), np.zeros(3000)], axis=1)
        y[:, 0] += self.body.x[0]
        self.controller.receive_reference(Reference(1, seq, stamp_ns, DT, End.HOLD, y, np.zeros((3000, 0))))
        self.from_m, self.from_ns = float(y[0, 0]), stamp_ns

    def begin(self, epoch: int) -> None:
        """Begin a life of the robot."""
        self.robot_ns = 0.0
        self.body = Lockstep(RobotSettings(PIONEER, np.zeros(5), SLEW), epoch=epoch)

    def state(self, **change: object) -> State:
        self.states += 1
        return State(**({"epoch": self.body.epoch, "seq": self.states, "stamp_ns": self.body.now_ns, "x": self.body.x.copy()} | change))  # type: ignore[arg-type]

    def hear(self, state: State) -> None:
        """Let guard and controller hear a state, and answer it."""
        if self.guard is not None:
            self.guard.receive_state(state, self.local_ns)
        command = self.controller.receive_state(state, self.local_ns)
        if command is not None:
            command = self.controller.in_time(command, self.local_ns)
            if command is not None:
                self.controller.commit(command, self.local_ns)
            self.controller.prepare()
        self.answered += command is not None
        self.send(command)

    def send(self, command: Command | None) -> None:
        """Pass a command of the controller on."""
        if command is not None and self.guard is not None:
            command = self.guard.receive_command(command, self.local_ns)
        self.tell(command)

    def tell(self, command: Command | None) -> None:
        if command is not None:
            self.sent.append(command)
            self.body.accept(command)

    def wait(self, ms: float, beside: Iterable[State] = (), *, heard: bool = True) -> None:
        """Let local time pass; the robot sends a state every tenth step, and a second robot possibly one in between."""
        others = iter(beside)
        for i in range(round(ms / self.step_ms)):
            self.local_ns += round(self.step_ms * MS)
            self.robot_ns += self.rate * self.step_ms * MS
            for until_ns, u in self.body.actuator.play(self.body.now_ns, round(self.robot_ns)):
                if not self.u or (u != self.u[-1]).any():
                    self.u.append(u.copy())
                    self.t.append((self.local_ns - 10**12) * self.speed)
                self.body._plant.advance(u, 1e-9 * (until_ns - self.body.now_ns))
                self.body.now_ns = until_ns
            if i % 10 == 4 and (other := next(others, None)) is not None:
                self.hear(other)
            if i % 10 == 9 and heard:
                self.hear(self.state())
            if self.guard is not None:
                self.tell(self.guard.tick(self.local_ns))
            if (ramp := self.controller.tick(self.local_ns)) is not None:
                self.controller.commit(ramp)
            self.send(ramp)
            self.said += self.controller.notices()
            if self.guard is not None:
                self.said += self.guard.notices
                self.guard.notices.clear()

    def told(self, code: str) -> list[str]:
        return [notice.text for notice in self.said if notice.code == code]

    def check(self) -> None:
        """No input beyond its bounds, no change within a period beyond the slew limits."""
        t, u = np.array(self.t), np.array(self.u)
        assert (np.abs(u) <= BOUND + 1e-9).all()
        for i in range(1, len(t)):
            since = np.searchsorted(t, t[i] - DT + 10 * MS, side="right") - 1  # times are those of steps
            change = np.abs(u[max(0, since) : i] - u[i]).max(axis=0)
            assert (change <= RAMP_SLEW_FACTOR * STEP).all(), (1e-9 * t[i], change)

    @property
    def error_m(self) -> float:
        """Distance from the reference."""
        return float(np.hypot(self.body.x[0] - self.from_m - SPEED_M_S * 1e-9 * (self.body.now_ns - self.from_ns), self.body.x[1]))


@pytest.fixture(scope="module")
def rti() -> Rti:
    return Rti(pioneer(N=12), compile=False)


@pytest.fixture(params=[False, True], ids=["alone", "guarded"])
def scene(request: pytest.FixtureRequest, rti: Rti) -> Scene:
    """It drives."""
    scene = Scene(rti, guarded=request.param)
    scene.wait(8000)
    assert scene.body.x[3] == pytest.approx(SPEED_M_S, abs=0.01)
    assert scene.error_m < 0.01
    scene.said.clear()
    return scene


def forged(scene: Scene, epoch: int, count: int) -> list[State]:
    """States of a second robot, which stands where the first was, on another clock."""
    return [State(epoch, i + 1, 10**15 + i * DT, np.zeros(5)) for i in range(count)]


@pytest.mark.parametrize(
    ("states", "epoch"),
    slow_but([(1, 2**62), (3, 0), (20, 2**62), (3, 2**62), (1, 0), (20, 0)], (1, 2**62), (3, 0)),
)
def test_second_robot_of_the_name_brings_the_first_to_rest_inside_its_limits_and_it_goes_on_by_itself(scene: Scene, epoch: int, states: int) -> None:
    scene.wait(100 * states, forged(scene, epoch, states))
    scene.wait(400)
    assert not scene.body.actuator.u.any()
    assert {text.count(str(epoch)) > 0 for text in scene.told("two_robots")} == {True}
    assert len(scene.told("two_robots")) == (1 if scene.guard is None else 2)  # each says it once
    scene.wait(400)
    assert scene.controller.mode is Mode.TRACKING
    scene.wait(25_000)
    assert scene.error_m < 0.01, "the reference is that of before"
    assert not scene.told("robot_restarted")
    scene.check()


def test_robot_heard_again_right_after_a_second_one_is_told_of_too(scene: Scene) -> None:
    """The robot's own states were lost for longer than the stale time, and a state of the other robot came in between."""
    scene.wait(300, heard=False)
    scene.hear(forged(scene, 9, 1)[0])
    scene.wait(100)
    assert len(scene.told("two_robots")) == (1 if scene.guard is None else 2)
    assert not scene.told("robot_restarted")
    scene.check()


@pytest.mark.parametrize("states", slow_but([1, 3], 3))
def test_standing_second_robot_while_the_planner_turns_round_gives_no_step(scene: Scene, states: int) -> None:
    """A controller that believed the standing robot's states would drive back at once."""
    for i in range(5):
        scene.wait(100 * states, forged(scene, 2**60 + i, states))
        ahead = -1.0 if i % 2 == 0 else 1.0
        y = np.array([[scene.body.x[0] + 20.0 * ahead, 0.0, 0.0]])
        scene.controller.receive_reference(Reference(1, 2 + i, 0, DT, End.HOLD, y, np.zeros((1, 0))))
        scene.wait(4000)
        assert scene.body.x[3] * ahead > 0.4
    scene.check()


def test_flood_of_forged_states_with_ever_new_epochs_brings_to_rest_and_keeps_there(scene: Scene) -> None:
    scene.wait(4000, (State(10**6 + i, 1, i, np.full(5, 3.0)) for i in range(10**6)))
    assert not scene.body.actuator.u.any()
    scene.wait(30_000)
    assert scene.error_m < 0.01
    scene.check()


def test_robot_that_is_really_restarted_begins_anew_and_what_was_sent_to_it_meanwhile_is_followed(scene: Scene) -> None:
    scene.wait(1000, heard=False)
    scene.begin(2)
    scene.wait(150)
    scene.refer(2)
    sent = len(scene.sent)
    scene.wait(500)
    assert len(scene.told("robot_restarted")) == (1 if scene.guard is None else 2)
    assert {command.state_epoch for command in scene.sent[sent:] if command.mode is Mode.TRACKING} == {2}
    scene.wait(8000)
    assert scene.error_m < 0.01


def test_restarted_robot_does_not_follow_what_was_sent_to_the_one_before(scene: Scene) -> None:
    scene.wait(1000, heard=False)
    scene.begin(2)
    scene.wait(3000)
    assert scene.controller.mode is Mode.WAITING
    assert not scene.body.x.any()


def test_robot_restarted_at_once_is_commanded_when_what_acted_before_has_settled(scene: Scene) -> None:
    scene.begin(2)
    scene.wait(500)
    assert scene.controller.mode is not Mode.TRACKING
    assert scene.told("two_robots")
    scene.wait(500)
    assert scene.told("robot_restarted")
    assert scene.controller.mode is Mode.WAITING


# Clocks.


@pytest.mark.parametrize("guarded", [False, True], ids=["alone", "guarded"])
@pytest.mark.parametrize(
    ("rate", "unit"),
    slow_but([(1e-9, "s (seconds)"), (1e-6, "ms"), (1e-3, "us"), (1e3, "ps"), (0.0, "")], (1e-9, "s (seconds)"), (1e3, "ps"), (0.0, "")),
)
def test_robot_whose_stamps_are_no_nanoseconds_is_never_commanded_and_told_why(rti: Rti, rate: float, unit: str, guarded: bool) -> None:
    scene = Scene(rti, guarded=guarded, rate=rate)
    scene.wait(2000)
    assert len(scene.said) > 1 + guarded, "that a state has come, and what is wrong"
    scene.wait(3000)
    told = scene.told("stamps_not_ns") if unit else scene.told("stamps_stand_still")
    assert len(told) == 1 + guarded
    assert all(unit in text for text in told)
    assert scene.sent == []
    assert scene.answered == 0
    assert scene.controller.standstill(scene.local_ns) is None


@pytest.mark.parametrize("rate", [1e-3, 1e-6])
def test_clock_that_is_none_any_more_in_motion_is_answered_by_one_step_to_rest_and_silence(scene: Scene, rate: float) -> None:
    u, sent = scene.body.actuator.u.copy(), len(scene.sent)
    scene.rate = rate
    scene.wait(5000)
    (last,) = (command for command in scene.sent[sent:] if command.mode is Mode.BRAKING)
    assert scene.sent[-1] is last
    np.testing.assert_allclose(last.u, np.tile(u - np.clip(u, -STEP, STEP), (len(last.u), 1)), atol=1e-3)  # driven straight, it hardly turns
    assert scene.body.actuator.u[0] < u[0]
    assert len(scene.told("stamps_not_ns")) == (1 if scene.guard is None else 2)
    scene.rate = 1.0
    scene.wait(10_000)
    assert scene.error_m < 0.01, "it goes on by itself"
    scene.check()


def test_clock_that_changes_its_unit_moves_the_robot_by_no_step(scene: Scene) -> None:
    """From nanoseconds to microseconds: the clock goes back, and hardly advances."""
    sent, now_ns = len(scene.sent), scene.body.now_ns
    u = scene.body.actuator.u.copy()
    for i in range(30):
        scene.local_ns += 100 * MS
        scene.hear(scene.state(stamp_ns=now_ns // 1000 + 100_000 * i))
        if scene.guard is not None:
            scene.tell(scene.guard.tick(scene.local_ns))
    rows = [row for command in scene.sent[sent:] for row in command.u]
    assert all((np.abs(row) <= np.abs(u) + 1e-9).all() for row in rows)
    scene.wait(100, heard=False)
    assert any("us (microseconds)" in text for text in scene.told("stamps_not_ns"))
    assert len([c for c in scene.sent[sent:] if np.ptp(c.u, axis=0).max() == 0.0]) == 1


@pytest.mark.parametrize("guarded", [False, True], ids=["alone", "guarded"])
@pytest.mark.parametrize("rate", slow_but([0.005, 0.02, 0.1, 1.0, 10.0, 50.0, 200.0], 0.005, 200.0))
def test_simulation_of_any_possible_speed_is_driven(rti: Rti, rate: float, guarded: bool) -> None:
    scene = Scene(rti, guarded=guarded, rate=rate, period_ms=100.0 / rate)
    while scene.controller.mode is not Mode.TRACKING:
        assert scene.local_ns - 10**12 < 200 * MS + 300 * MS / rate, "it begins to drive"
        scene.wait(100 / rate)
    scene.refer(2, scene.body.now_ns)
    scene.wait(8000 / rate)
    answered = scene.answered
    scene.wait(3000 / rate)
    assert scene.answered - answered == 30, "each state"
    assert scene.error_m < 0.01
    assert not scene.told("stamps_not_ns")
    scene.check()
