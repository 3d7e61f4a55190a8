# SPDX-License-Identifier: Apache-2.0
"""Guard without clock and network, in front of the actuators of the simulated robot, judged by the inputs that act there."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.guard import Guard
from rti_mpc.contract.limits import MAX_VALID_NS, Limits
from rti_mpc.contract.message import Command, Severity, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.wire.actuator import Actuator
from tests.slow import slow_but

MS = 1_000_000
LOCAL_NS = 10**15  # local time when the robot's clock is 0
BOUND, STEP = np.array([0.5, 0.745]), np.array([0.25, 0.4])  # of the shipped configuration, the latter over 100 ms
LIMITS = Limits(np.zeros(2), -BOUND, BOUND, -STEP, STEP, dt_s=0.1)
FULL = np.array([0.5, 0.3])


class Scene:
    """A robot, its guard and a controller that can be told what to command, in steps of 10 ms of the robot."""

    def __init__(self, rate: float = 1.0, limits: Limits = LIMITS) -> None:
        self.rate = rate
        self.limits = limits
        self.now_ns = 0  # the robot's clock
        self.local_ns = LOCAL_NS
        self.epoch = 7
        self.seq = 0
        self.states = 0  # sent
        self.leader = 100
        self.state: State | None = None
        self.published: list[Command] = []
        self.times_ms: list[float] = []
        self.inputs: list[Array] = []
        self.refused = 0  # by the robot's own watchdog
        self.heard = True  # whether states reach the guard
        self.power_up()

    def power_up(self) -> None:
        """Start a guard."""
        self.guard = Guard(self.limits, epoch=10 if not self.published else self.published[-1].epoch + 10)
        self.actuator = getattr(self, "actuator", None) or Actuator(np.zeros(2), LIMITS.slew, self.epoch)

    def publish(self, told: Command | None) -> Command | None:
        if told is not None:
            self.refused += self.actuator.accept(told, self.now_ns) != ""
            self.published.append(told)
        return told

    def step(self) -> None:
        """Let 10 ms pass: in the end a state, if it is time, and a tick."""
        for until_ns, u in self.actuator.play(self.now_ns, self.now_ns + 10 * MS):
            self.times_ms.append(self.now_ns / MS)
            self.inputs.append(u.copy())
            self.now_ns = until_ns
        self.local_ns += round(10 * MS / self.rate)
        if self.now_ns % (100 * MS) == 0:
            self.states += 1
            self.state = State(self.epoch, self.states, self.now_ns, np.zeros(5))
            if self.heard:
                self.guard.receive_state(self.state, self.local_ns)
        self.publish(self.guard.tick(self.local_ns))

    def wait(self, ms: int) -> None:
        for _ in range(ms // 10):
            self.step()

    def restart(self) -> None:
        """Stop the robot for a second, restart it, and wait until the new epoch is accepted."""
        self.heard = False
        self.wait(1000)
        self.epoch += 1
        self.actuator = Actuator(np.zeros(2), LIMITS.slew, self.epoch)
        self.heard = True
        self.wait(500)
        self.refused = 0  # told to the life before, until this one was sure

    def command(self, u: Any = FULL, **change: Any) -> Command:
        """A command that answers the last state; constant rows, or those given."""
        assert self.state is not None
        self.seq += 1
        stamp_ns = self.state.stamp_ns
        rows = np.tile(u, (20, 1)) if np.ndim(u) == 1 else np.array(u)
        healthy = Command(
            epoch=self.leader,
            seq=self.seq,
            stamp_ns=stamp_ns,
            state_epoch=self.state.epoch,
            state_seq=self.state.seq,
            state_stamp_ns=stamp_ns,
            valid_until_ns=stamp_ns + 250 * MS,
            config_hash=5,
            mode=Mode.TRACKING,
            status=QpStatus.SOLVED,
            period_ns=100 * MS,
            u=rows,
        )
        return replace(healthy, **change)

    def send(self, u: Any = FULL, **change: Any) -> Command | None:
        return self.publish(self.guard.receive_command(self.command(u, **change), self.local_ns))

    def drive(self, ms: int, u: Array = FULL) -> None:
        """Command an input, approached inside the slew limits, at every state; end with a state that is not answered."""
        for _ in range(ms // 100):
            rows = [self.actuator.u + np.clip(u - self.actuator.u, -STEP, STEP)]
            while len(rows) < 20:
                rows.append(rows[-1] + np.clip(u - rows[-1], -STEP, STEP))
            assert self.send(rows) is not None
            self.wait(100)

    def ready(self) -> Scene:
        """Wait until the guard lets commands pass."""
        self.wait(1000)
        return self

    def said(self) -> list[str]:
        codes = [notice.code for notice in self.guard.notices]
        self.guard.notices.clear()
        return codes

    def trace(self) -> tuple[Array, Array]:
        """Times in ms, and the inputs that acted from then on."""
        return np.array(self.times_ms), np.array(self.inputs)


@pytest.fixture
def scene() -> Iterator[Scene]:
    scene = Scene().ready()
    yield scene
    assert not scene.refused


def test_healthy_command_passes_at_once_and_whole(scene: Scene) -> None:
    sent = scene.command(np.array([[0.1 + 0.01 * k, 0.2] for k in range(20)]))
    passed = scene.guard.receive_command(sent, scene.local_ns)
    assert passed is not None
    np.testing.assert_array_equal(passed.u, sent.u)
    assert replace(passed, u=sent.u, epoch=sent.epoch, seq=sent.seq) == sent
    assert scene.said() == ["guard_passing"]


def test_what_it_publishes_is_numbered_without_a_gap_in_an_epoch_no_lower_than_any_controllers(scene: Scene) -> None:
    scene.drive(500)
    scene.wait(1000)
    scene.leader, scene.seq = 200, 0
    scene.drive(500)
    epochs = [told.epoch for told in scene.published]
    assert epochs == sorted(epochs)
    assert epochs[-1] >= 200
    assert [told.seq for told in scene.published] == list(range(1, len(epochs) + 1))


def test_restarted_guard_publishes_in_an_epoch_of_its_own_though_controllers_have_higher_ones(scene: Scene) -> None:
    """In that of the guard before it, numbered from 1, the robot would refuse it as old, and then take it in one step."""
    scene.drive(1000)
    first, refused = scene.published[-1].epoch, scene.refused
    scene.guard = Guard(LIMITS, epoch=11)
    scene.ready().drive(1000)
    assert scene.leader < first < scene.published[-1].epoch
    assert scene.refused == refused


def test_robot_plays_the_plan_while_a_message_is_late(scene: Scene) -> None:
    scene.drive(500)
    rows = np.array([[0.5 - 0.1 * k, 0.3] for k in range(5)])
    scene.send(rows)
    scene.wait(240)
    times, inputs = scene.trace()
    for k in range(2):
        np.testing.assert_array_equal(inputs[(times >= 1500 + 100 * k) & (times < 1600 + 100 * k), 0], rows[k, 0])
    assert scene.guard.passing
    assert scene.actuator.counters.starved == 0


def test_silence_is_answered_by_a_ramp_told_in_time_and_then_by_standing(scene: Scene) -> None:
    scene.drive(1000)
    stamp_ns = scene.now_ns
    scene.send()
    fault_ms = stamp_ns / MS  # the controller dies right after its command
    scene.said()
    scene.wait(3000)
    times, inputs = scene.trace()
    braking = times[(times > fault_ms) & (inputs[:, 0] < 0.5)][0] - fault_ms
    zero = times[(times > fault_ms) & ~inputs.any(axis=1)][0] - fault_ms
    assert braking == 250.0
    assert zero == 440.0
    assert not inputs[times >= fault_ms + zero].any()
    assert scene.actuator.counters.starved == 0, "the robot's own watchdog had nothing to do"
    assert scene.said() == ["guard_braking"]
    last = scene.published[-1]
    assert (last.u.any(), last.mode) == (False, Mode.BRAKING)
    assert last.valid_until_ns - scene.now_ns <= 200 * MS
    assert scene.guard.at_rest(scene.local_ns)


def test_ramp_is_that_of_the_robot_itself(scene: Scene) -> None:
    """So it does not matter which of the two begins."""
    alone = Scene().ready()
    for one in (scene, alone):
        one.drive(1000)
        one.send()
    alone.guard.tick = lambda _: None  # type: ignore[method-assign, assignment]
    scene.wait(1000)
    alone.wait(1000)
    assert alone.actuator.counters.starved == 1
    np.testing.assert_allclose(scene.trace()[1], alone.trace()[1], atol=1e-12)


def test_commands_pass_again_after_a_gap_without_a_jump(scene: Scene) -> None:
    """A controller that has heard nothing of the gap goes on where it believes the robot to be."""
    scene.drive(1000)
    scene.wait(1000)
    scene.said()
    passed = scene.send()
    assert passed is not None
    np.testing.assert_allclose(passed.u[:4], [[0.25, 0.3], [0.25, 0.3], [0.5, 0.3], [0.5, 0.3]])
    assert scene.said() == ["slew_limited", "guard_passing"]


REFUSED: list[tuple[str, Callable[[Scene], dict[str, Any]]]] = [
    ("foreign_epoch", lambda s: {"state_epoch": s.epoch - 1}),
    ("foreign_epoch", lambda s: {"state_epoch": s.epoch + 1}),
    ("wrong_shape", lambda s: {"u": np.zeros((20, 3))}),
    ("wrong_shape", lambda s: {"u": np.zeros((0, 2))}),
    ("wrong_shape", lambda s: {"period_ns": 0}),
    ("not_finite", lambda s: {"u": np.array([[0.5, np.nan]])}),
    ("not_finite", lambda s: {"u": np.array([[np.inf, 0.3]])}),
    ("stale", lambda s: {"state_stamp_ns": s.now_ns - 260 * MS, "valid_until_ns": s.now_ns + 250 * MS}),
    ("early", lambda s: {"state_stamp_ns": s.now_ns + 100 * MS, "stamp_ns": s.now_ns + 100 * MS, "valid_until_ns": s.now_ns + 350 * MS}),
    ("expired", lambda s: {"valid_until_ns": s.now_ns}),
    ("expired", lambda s: {"stamp_ns": s.now_ns - 2000 * MS}),
    ("expired", lambda s: {"stamp_ns": s.now_ns + 400 * MS, "valid_until_ns": 2**62}),
    ("repeated", lambda s: {"seq": s.seq - 1}),
    ("old", lambda s: {"seq": 0}),
    ("fenced", lambda s: {"epoch": 99}),
    ("out_of_bounds", lambda s: {"u": np.array([[0.51, 0.3]])}),
    ("out_of_bounds", lambda s: {"u": np.array([[0.5, 0.3], [0.5, -0.8]])}),
    ("out_of_slew", lambda s: {"u": np.array([[0.5, 0.3], [0.2, 0.3]])}),
    ("out_of_slew", lambda s: {"u": np.array([[0.5, 0.3], [0.45, 0.3]]), "period_ns": 10 * MS}),
]


@pytest.mark.parametrize(("reason", "change"), REFUSED)
def test_command_that_is_not_in_order_is_refused_as_a_whole_and_the_plan_plays_on(
    scene: Scene, reason: str, change: Callable[[Scene], dict[str, Any]]
) -> None:
    scene.drive(500)
    scene.said()
    sent = scene.command()
    assert scene.guard.receive_command(replace(sent, **change(scene)), scene.local_ns) is None
    notices = list(scene.guard.notices)
    assert [notice.code for notice in notices] == [f"command_{reason}"]
    assert notices[0].severity is Severity.WARNING
    scene.wait(50)
    np.testing.assert_array_equal(scene.actuator.u, FULL)
    assert scene.send() is not None


def test_rounding_is_forgiven_and_never_passed_on(scene: Scene) -> None:
    scene.drive(500)
    passed = scene.send(np.float32(BOUND).astype(np.float64))
    assert passed is not None
    assert (np.abs(passed.u) <= BOUND).all()
    assert scene.send(BOUND * (1 + 1e-5)) is None


def test_nothing_acts_longer_than_promised_whatever_a_command_says(scene: Scene) -> None:
    passed = scene.send(valid_until_ns=2**62)
    assert passed is not None
    assert passed.valid_until_ns == passed.state_stamp_ns + MAX_VALID_NS


def test_higher_epoch_takes_over_and_the_old_leader_never_passes_again(scene: Scene) -> None:
    scene.drive(500)
    scene.leader = 101
    scene.drive(300)
    assert "source_changed" in scene.said()
    scene.leader = 100
    for _ in range(20):  # neither while the new one commands nor long after
        assert scene.send() is None
        scene.wait(100)
    assert set(scene.said()) == {"command_fenced", "guard_braking"}
    scene.leader = 101
    assert scene.send() is not None


def test_epoch_that_only_claims_fences_nobody(scene: Scene) -> None:
    """A command that is refused does not raise the epoch that passes."""
    scene.drive(500)
    for change in ({"state_stamp_ns": 0}, {"u": np.full((20, 2), 9.0)}, {"state_epoch": 1}):
        assert scene.send(epoch=10**6, **change) is None
    assert scene.send() is not None


def test_resumed_controller_gets_nothing_stale_through(scene: Scene) -> None:
    """Stopped for 1.5 s, it empties its queue of states: an answer to each."""
    scene.drive(500)
    waiting = []
    for _ in range(15):
        waiting.append(scene.command())
        scene.wait(100)
    passed = [scene.guard.receive_command(command, scene.local_ns) is not None for command in waiting]
    assert passed == [False] * 12 + [False, True, True] or passed == [False] * 13 + [True, True]
    assert scene.guard._clock.now_ns(scene.local_ns) - waiting[-2].state_stamp_ns <= 250 * MS


@pytest.mark.parametrize("gap_ms", [400, 1500])
def test_held_up_guard_publishes_nothing_stale_whatever_waited_for_it(scene: Scene, gap_ms: int) -> None:
    """States and commands wait in rings, and come in a burst, the oldest first."""
    scene.drive(1000)
    told = len(scene.published)
    backlog: list[tuple[State, Command]] = []
    scene.heard = False
    guard, scene.guard = scene.guard, Guard(LIMITS)  # this one is stopped; nobody is there
    for _ in range(gap_ms // 100):
        assert scene.state is not None
        backlog.append((scene.state, scene.command()))
        scene.wait(100)
    assert len(scene.published) == told
    scene.guard, scene.heard = guard, True
    scene.said()
    for state, command in backlog:
        guard.receive_state(state, scene.local_ns)
        scene.publish(guard.receive_command(command, scene.local_ns))
    assert all(scene.now_ns - told.state_stamp_ns <= 250 * MS for told in scene.published[told:])
    assert "guard_held_up" in scene.said()
    scene.wait(300)
    scene.drive(1000)
    np.testing.assert_array_equal(scene.actuator.u, FULL)


def test_states_that_waited_on_the_way_make_no_old_command_young(scene: Scene) -> None:
    """The link hangs, the guard does not: the first state to arrive does not tell the current time of the robot."""
    scene.drive(1000)
    scene.heard = False
    states, commands = [], []
    for _ in range(10):
        states.append(scene.state)
        commands.append(scene.command())
        scene.wait(100)
    for state, command in zip(states[:-3], commands[:-3], strict=True):
        assert state is not None
        scene.guard.receive_state(state, scene.local_ns)
        assert scene.guard.receive_command(command, scene.local_ns) is None


def test_states_that_waited_and_come_in_clumps_make_no_old_command_young() -> None:
    """As they do in a guard that was stopped and then gets few turns on a busy host: the first of each clump has taken its time."""
    guard = Guard(LIMITS)
    scene = Scene().ready()

    def command(state: State) -> Command:
        return replace(
            scene.command(), state_epoch=1, state_seq=state.seq, stamp_ns=state.stamp_ns, state_stamp_ns=state.stamp_ns, valid_until_ns=2**60
        )

    def state(k: int) -> State:
        return State(1, k, k * 10 * MS, np.zeros(5))

    local_ns = LOCAL_NS
    for k in range(1, 201):
        guard.receive_state(state(k), local_ns := LOCAL_NS + k * 10 * MS)
    assert guard.receive_command(command(state(200)), local_ns) is not None
    local_ns += 1500 * MS  # stopped
    for k in range(201, 260):
        local_ns += (90 if k % 5 == 0 else 1) * MS
        guard.receive_state(state(k), local_ns)
        assert guard.receive_command(command(state(k)), local_ns) is None, k


def test_clock_of_a_simulation_that_was_held_up_is_believed_again(scene: Scene) -> None:
    """Its clock waits with it: ours is ahead until its pace has shown that."""
    scene.drive(1000)
    scene.local_ns += 1500 * MS
    scene.guard.tick(scene.local_ns)
    scene.wait(200)
    assert scene.send() is not None
    scene.drive(1000)


def test_guard_without_states_lets_nothing_pass(scene: Scene) -> None:
    scene.drive(1000)
    scene.heard = False
    scene.wait(300)
    assert scene.send() is None
    assert scene.said()[-1] == "command_blind"


def test_robot_that_has_gone_is_not_told_to_stand_for_ever(scene: Scene) -> None:
    scene.drive(1000)
    scene.heard = False
    scene.wait(5000)
    told = len(scene.published)
    scene.wait(5000)
    assert len(scene.published) == told


def test_another_life_of_the_robot_begins_at_rest_with_any_controller(scene: Scene) -> None:
    scene.drive(1000)
    scene.leader = 50
    scene.restart()
    assert "robot_restarted" in scene.said()
    assert scene.send(state_epoch=7, epoch=200) is None
    passed = scene.send(STEP / 2)
    assert passed is not None
    assert passed.u[0].tolist() == (STEP / 2).tolist()


@pytest.mark.parametrize("rate", [0.1, 0.5])
def test_life_whose_clock_runs_at_another_speed_is_guarded_by_that(scene: Scene, rate: float) -> None:
    """A simulation that is restarted slower: of the life before, nothing is kept."""
    scene.drive(1000)
    scene.rate = rate
    scene.restart()
    scene.wait(1000)
    begun_ns = scene.guard.robot_now_ns(scene.local_ns)
    scene.heard = False
    scene.wait(200)
    assert scene.guard.robot_now_ns(scene.local_ns) - begun_ns == pytest.approx(200 * MS, rel=0.01)  # of the robot, whose states are exact


@pytest.mark.parametrize("jump_ms", [-5000, -600, 300, 5000, 10**9])
def test_clock_that_jumps_is_answered_by_braking(scene: Scene, jump_ms: int) -> None:
    scene.wait(5000)
    scene.drive(1000)
    sent = scene.command()
    scene.wait(100)
    u = scene.actuator.u
    scene.inputs.clear()
    scene.now_ns += jump_ms * MS
    scene.actuator = Actuator(np.zeros(2), LIMITS.slew, scene.epoch)
    scene.actuator._schedule.brake(u, scene.now_ns)
    scene.wait(100)
    assert "clock_jumped" in scene.said()
    assert scene.guard.receive_command(sent, scene.local_ns) is None
    scene.wait(50)
    told = scene.published[-1]
    assert told.mode is Mode.BRAKING
    assert abs(told.stamp_ns - scene.now_ns) < 200 * MS
    scene.wait(300)
    assert not scene.inputs[-1].any()
    assert (np.abs(np.diff(scene.inputs, axis=0)) <= STEP + 1e-9).all(), "from what acts, not from rest"
    assert scene.send(0.5 * FULL) is not None
    scene.refused = 0  # told in the old time, before a state has shown the new one


def test_nothing_passes_after_a_jump_until_the_robot_was_told_to_brake(scene: Scene) -> None:
    """It goes on with the plan it has until then, while a command would be approached from the ramp."""
    scene.drive(1000)
    scene.send()
    assert scene.state is not None
    jumped = replace(scene.state, seq=scene.state.seq + 1, stamp_ns=scene.now_ns + 5000 * MS)
    scene.guard.receive_state(jumped, scene.local_ns)
    answer = {"stamp_ns": jumped.stamp_ns, "state_stamp_ns": jumped.stamp_ns, "valid_until_ns": jumped.stamp_ns + 250 * MS}
    assert scene.guard.receive_command(scene.command(STEP, **answer), scene.local_ns) is None
    assert scene.said()[-2:] == ["clock_jumped", "command_held"]
    told = scene.guard.tick(scene.local_ns)
    assert told is not None
    assert told.mode is Mode.BRAKING
    assert scene.guard.receive_command(scene.command(STEP, **answer), scene.local_ns) is not None


def test_starting_guard_waits_until_what_another_one_told_the_robot_has_run_out(scene: Scene) -> None:
    """It does not know the commands of the earlier guard, so it waits 300 ms and the ramp from the bounds."""
    scene.drive(1000)
    scene.send()
    scene.power_up()
    notices = []
    while not scene.send(np.zeros(2)):
        notices += scene.guard.notices
        scene.guard.notices.clear()
        scene.wait(100)
    assert {(notice.severity, notice.code) for notice in notices} == {(Severity.INFO, "guard_starting")}, "a start is no fault"
    assert len({notice.text for notice in notices}) == len(notices) == 3, "each is said once: no state yet, one state yet, another guard's way"
    assert scene.actuator.at_rest
    assert scene.said() == ["guard_passing"]


def test_guard_that_is_held_up_before_a_robot_depends_on_it_says_nothing(scene: Scene) -> None:
    scene.power_up()
    for _ in range(3):
        scene.local_ns += 1000 * MS
        scene.wait(100)
    assert "guard_held_up" not in scene.said()


def test_guard_that_is_being_stopped_passes_nothing_and_complains_of_nobody(scene: Scene) -> None:
    scene.drive(1000)
    scene.said()
    scene.guard.stop(scene.local_ns)
    assert scene.send() is None
    assert scene.said() == []


def test_starting_guard_learns_who_leads_before_anything_passes() -> None:
    scene = Scene()
    scene.wait(300)
    scene.leader = 200
    assert scene.send() is None
    scene.ready()
    scene.leader = 100
    assert scene.send() is None
    assert scene.said()[-1] == "command_fenced"


def test_nothing_is_told_to_a_robot_that_was_never_commanded(scene: Scene) -> None:
    scene.wait(3000)
    assert not scene.published
    assert scene.guard.at_rest(scene.local_ns)


def test_stopped_guard_ramps_to_rest_and_takes_no_command(scene: Scene) -> None:
    scene.drive(1000)
    scene.wait(30)
    scene.guard.stop(scene.local_ns)
    assert not scene.guard.at_rest(scene.local_ns)
    assert scene.send() is None
    while not scene.guard.at_rest(scene.local_ns):
        scene.step()
    scene.wait(400)
    assert not scene.actuator.u.any()
    assert scene.actuator.counters.starved == 0
    _, inputs = scene.trace()
    assert (-np.diff(inputs[-60:], axis=0) <= 0.2 * STEP + 1e-12).all()


def end_late(scene: Scene, late_ms: int, *, always: bool, states_ms: int = 10, lost: int = 0) -> Command:
    """
    Stop a guard and let its process end; return its last command.

    The robot, which reports its inputs, hears of it late, until some time after the stop or always; the first commands are lost.
    """
    scene.drive(1000)
    scene.wait(30)
    scene.guard.stop(scene.local_ns)
    scene.inputs.clear()
    stopped_ns, coming, ended = scene.now_ns, [(scene.now_ns, scene.guard.tick(scene.local_ns))], False
    while coming or not ended:
        for until_ns, u in scene.actuator.play(scene.now_ns, scene.now_ns + 10 * MS):
            scene.inputs.append(u.copy())
            scene.now_ns = until_ns
        scene.local_ns += 10 * MS
        if scene.now_ns % (states_ms * MS) == 0 and not ended:
            scene.states, (epoch, seq) = scene.states + 1, scene.actuator.source
            state = State(scene.epoch, scene.states, scene.now_ns, np.zeros(5), u=u.copy(), command_epoch=epoch, command_seq=seq)
            scene.guard.receive_state(state, scene.local_ns)
        ended |= scene.guard.at_rest(scene.local_ns)  # then its process hears nothing more, whatever comes
        if not ended:
            coming.append((scene.now_ns, scene.guard.tick(scene.local_ns)))
        while coming and scene.now_ns - (coming[0][0] if always else stopped_ns) >= late_ms * MS:
            _, command = coming.pop(0)
            if command is not None and lost:
                lost -= 1
            else:
                scene.publish(command)
    return scene.published[-1]


@pytest.mark.parametrize(("late_ms", "always", "refused"), [(80, False, 0), (110, True, 1)])
def test_stopped_guard_goes_on_until_it_has_told_rest_to_a_robot_that_was_late_to_hear_of_the_ramp(
    scene: Scene, late_ms: int, always: bool, refused: int
) -> None:
    """Where the command to brake is over when it comes, the next one begins where the robot still was; then it reports that it is far ahead."""
    last = end_late(scene, late_ms, always=always)
    assert last.mode is Mode.BRAKING
    assert not last.u[-1].any()
    assert scene.refused == refused
    scene.refused = 0


@pytest.mark.parametrize("lost", [1, 2])
def test_stopped_guard_goes_on_until_the_robot_has_heard_that_it_brakes(scene: Scene, lost: int) -> None:
    """Its reports say that it has not, and then where it is on its own ramp, from where the guard goes on."""
    last = end_late(scene, 0, always=False, lost=lost)
    assert not last.u[-1].any()
    assert scene.actuator.source[1] in (last.seq - 1, last.seq), "it obeys the last command, or the one before until that begins, not its own ramp"


def test_stopped_guard_does_not_wait_for_a_robot_that_has_fallen_silent_to_say_that_it_brakes(scene: Scene) -> None:
    """Its process would be killed by a supervisor that is told how long an end may take; and the whole ramp has been sent."""
    scene.drive(1000)
    reported = State(scene.epoch, scene.states + 1, scene.now_ns + MS, np.zeros(5), u=scene.actuator.u.copy())
    reported.command_epoch, reported.command_seq = scene.actuator.source
    scene.guard.receive_state(reported, scene.local_ns)
    scene.guard.stop(scene.local_ns)
    scene.heard = False
    ramp_s = max(FULL / LIMITS.slew)
    scene.wait(round(1e3 * (LIMITS.stale_s + ramp_s)))
    assert scene.guard.at_rest(scene.local_ns)
    assert not scene.published[-1].u[-1].any()


@pytest.mark.parametrize("states_ms", [10, 50])
@pytest.mark.parametrize("late_ms", [20, 50, 70, 90])
@pytest.mark.parametrize("always", [False, True], ids=["the first one late", "all late"])
def test_inputs_of_a_robot_that_was_late_to_hear_of_the_ramp_do_not_rise_on_it(scene: Scene, late_ms: int, states_ms: int, always: bool) -> None:
    """It reports inputs that still drive while the command to brake is on its way; the guard's next one is not to begin from there."""
    end_late(scene, late_ms, always=always, states_ms=states_ms)
    inputs = np.array(scene.inputs)
    assert (inputs[0] == FULL).all()
    assert (np.diff(inputs, axis=0) <= 1e-12).all(), "rounding"


@pytest.mark.parametrize(("after_ms", "names", "u"), [(20, "brake", 0.3), (20, "ramp", 0.3), (110, "driven", 0.5)])
def test_robot_that_has_heard_of_the_ramp_or_never_will_is_where_it_says(scene: Scene, after_ms: int, names: str, u: float) -> None:
    """It names the command to brake or its own ramp, or still the command before when that to brake is over."""
    begins, since_ns = told_after(scene, after_ms, names, u)
    on_the_ramp = u - LIMITS.slew[0] * 1e-9 * since_ns
    assert begins.u[0, 0] == pytest.approx(on_the_ramp, abs=1.01 * 0.1 * STEP[0]), "a step of the ramp"


@pytest.mark.parametrize("names", ["driven", "of a guard before"])
def test_robot_that_has_not_heard_of_the_ramp_yet_is_where_it_will_be_on_it(scene: Scene, names: str) -> None:
    """It names an older command, by epoch first: a guard before may have sent many more."""
    begins, since_ns = told_after(scene, 20, names, 0.5)
    assert begins.u[0, 0] <= 0.5 - LIMITS.slew[0] * 1e-9 * (since_ns + 20 * MS)


def told_after(scene: Scene, after_ms: int, names: str, u: float) -> tuple[Command, int]:
    """Return what a stopped guard tells a robot that reports an input and names a command, and how long after that report it acts."""
    scene.drive(1000)
    scene.wait(30)
    driven = scene.published[-1]
    scene.guard.stop(scene.local_ns)
    scene.heard = False
    scene.wait(after_ms)
    seq = {"brake": driven.seq + 1, "ramp": 0, "driven": driven.seq, "of a guard before": 100 * driven.seq}[names]
    epoch = driven.epoch - (names == "of a guard before")
    state = State(scene.epoch, scene.states + 1, scene.now_ns, np.zeros(5), u=np.array([u, 0.0]), command_epoch=epoch, command_seq=seq)
    scene.guard.receive_state(state, scene.local_ns)
    told = len(scene.published)
    while len(scene.published) == told:
        scene.step()
    return scene.published[-1], scene.published[-1].stamp_ns - state.stamp_ns


REASON = "asked for by ada@lab"
WAY = np.array([max(0.0, 0.25 - 0.25 * k) * np.array([1.0, 0.6]) for k in range(20)])  # of a controller that is stopped at FULL


def test_latched_guard_passes_the_way_to_rest_and_then_rest(scene: Scene) -> None:
    scene.drive(1000)
    scene.guard.latch(REASON, scene.local_ns)
    passed = scene.send(WAY)
    assert passed is not None
    np.testing.assert_array_equal(passed.u, WAY)
    scene.wait(300)
    assert not scene.actuator.u.any()
    for _ in range(10):
        assert scene.send(np.zeros(2)) is not None
        scene.wait(100)
    assert "command_stopped" not in scene.said()


@pytest.mark.parametrize(
    "rows",
    [
        np.tile(FULL, (20, 1)),  # goes on
        np.vstack([WAY[:1], WAY[:-1]])[:4] + 0.01,  # does not arrive
        np.vstack([WAY[:2], np.tile([0.05, 0.0], (10, 1)), WAY[-1:]]),  # moves again
        np.vstack([0.8 * WAY[:1], -0.1 * WAY[:1], WAY[2:]]),  # goes beyond rest
        np.vstack([FULL * np.array([1.0, 1.1]), WAY]),  # turns faster first
    ],
    ids=["goes on", "does not arrive", "moves again", "goes beyond rest", "turns faster"],
)
def test_latched_guard_passes_nothing_but_ways_to_rest_and_brakes_in_time_if_none_comes(scene: Scene, rows: Array) -> None:
    scene.drive(1000)
    scene.said()
    scene.guard.latch(REASON, scene.local_ns)
    assert scene.send(rows) is None
    assert scene.said() == ["stop", "command_stopped"]
    for _ in range(5):
        scene.send(rows)
        scene.wait(100)
    assert not scene.actuator.u.any(), "the last plan before has ended, and the guard has braked"
    assert scene.actuator.counters.starved == 0
    assert scene.send(rows) is None


def test_controller_that_ramps_down_anew_with_every_command_does_not_drive_on_against_a_latched_guard(scene: Scene) -> None:
    """Each of its plans leads to rest, but only the first row of each would act."""
    scene.drive(1000)
    scene.guard.latch(REASON, scene.local_ns)
    stubborn = np.vstack([FULL, FULL - [0.25, 0.3], WAY[1:]])
    assert scene.send(stubborn) is not None, "nearer to rest in every row"
    for _ in range(20):
        scene.wait(100)
        scene.send(stubborn)
    assert not scene.actuator.u.any()
    times, inputs = scene.trace()
    moving = times[np.abs(inputs).max(axis=1) > 0.0]
    assert moving.max() - 2000 <= 1e3 * LIMITS.settling_s + 200 + 30, "once it should stand, the guard brakes; it looks every 10 ms"


@pytest.mark.parametrize("seed", slow_but(range(4), 0, 1))
def test_nothing_moves_a_robot_away_from_rest_while_a_stop_is_latched_whatever_is_commanded(seed: int) -> None:
    """Ways to rest, late and early ones, and random plans."""
    rng = np.random.default_rng(seed)
    scene = Scene().ready()
    passed = 0
    for _ in range(25):
        scene.drive(600, rng.uniform(-BOUND, BOUND))
        scene.wait(int(rng.integers(0, 8)) * 10)
        scene.guard.latch(REASON, scene.local_ns)
        scene.inputs.clear()
        for _ in range(15):
            factors = rng.choice([rng.uniform(0.5, 1.0), 1.1, -0.2]) * np.append(np.linspace(1.0, 0.0, int(rng.integers(2, 6))), np.zeros(4))
            rows = np.outer(factors, scene.actuator.u) + (rng.uniform(-0.02, 0.02, 2) if rng.random() < 0.3 else 0.0)
            passed += scene.send(np.clip(rows, -BOUND, BOUND), stamp_ns=scene.now_ns - int(rng.integers(-3, 9)) * 10 * MS) is not None
            scene.wait(int(rng.integers(1, 11)) * 10)
        scene.wait(600)
        way = np.abs(scene.inputs)
        assert (np.diff(way, axis=0) <= 1e-6).all(), "the rounding that the guard allows"
        assert not scene.actuator.u.any()
        scene.guard.enable()
        scene.wait(-scene.now_ns // MS % 100)
    assert passed > 10


def test_controller_that_knows_of_no_stop_does_not_drive_a_robot_whose_guard_was_restarted_latched(scene: Scene) -> None:
    scene.power_up()
    scene.guard.latch(REASON, scene.local_ns)
    scene.ready()
    for _ in range(10):
        assert scene.send(FULL * 0.5) is None
        scene.wait(100)
    assert not scene.actuator.u.any()
    scene.guard.enable()
    assert scene.send(FULL * 0.5) is not None
    assert scene.said()[-2:] == ["enable", "guard_passing"]


def test_latch_before_the_first_state_and_across_another_life_of_the_robot_holds() -> None:
    scene = Scene()
    scene.guard.latch(REASON, scene.local_ns)
    scene.ready()
    assert scene.send(FULL * 0.5) is None
    assert scene.send(np.zeros(2)) is not None
    scene.restart()
    assert scene.send(FULL * 0.5) is None
    assert scene.send(np.zeros(2)) is not None


def test_guard_that_starts_latched_passes_rest_alone_from_the_time_on_that_commands_pass() -> None:
    """Whatever is commanded by then of a way to rest has had its time, and no clock of the robot was known when it was latched."""
    scene = Scene()
    scene.guard.latch(REASON, scene.local_ns)
    scene.ready().heard = False
    scene.wait(100)
    assert scene.state is not None
    scene.guard.receive_state(replace(scene.state, u=0.5 * FULL, command_epoch=scene.leader, command_seq=1), scene.local_ns)
    assert scene.send(0.5 * WAY) is None
    assert scene.send(np.zeros(2)) is not None


@pytest.mark.parametrize("rate", [0.5, 4.0])
def test_simulated_time_runs_at_its_own_rate(rate: float) -> None:
    scene = Scene(rate).ready()
    scene.drive(1000)
    scene.send()
    scene.wait(1000)
    assert scene.actuator.counters.starved == 0
    assert scene.guard.at_rest(scene.local_ns)


def test_inputs_without_slew_limits_rest_at_once() -> None:
    free = replace(LIMITS, lbdu=np.full(2, -np.inf), ubdu=np.full(2, np.inf))
    scene = Scene(limits=free).ready()
    assert scene.send() is not None
    scene.wait(240)
    assert scene.guard.tick(scene.local_ns) is None or not scene.published[-1].u.any()
    assert not scene.published[-1].u.any()


@pytest.mark.parametrize("samples", [3_000, pytest.param(10_000 if "CI" in os.environ else 50_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("regular", [True, False])
def test_no_command_whatsoever_moves_the_robot_outside_bounds_and_slew_limits(samples: int, regular: bool) -> None:
    """Random plans, epochs, times, gaps and silences, healthy ones among them; from sample to sample where stamps and periods are a controller's."""
    rng = np.random.default_rng(4)
    scene = Scene().ready()
    passed = 0
    acted = [scene.actuator.u.copy()]  # just before each state
    for _ in range(samples):
        scene.inputs.clear()
        scene.heard = rng.random() > 0.1
        kind = rng.integers(0, 4 if regular else 6)
        rows = scene.actuator.u + np.cumsum(rng.uniform(-1.0, 1.0, (20, 2)) * STEP * (1.05 if kind == 0 else 1.0), axis=0)
        change: dict[str, Any] = {"u": rows if kind == 1 else np.clip(rows, -BOUND, BOUND)}
        if kind == 4:
            change |= {"stamp_ns": scene.now_ns + int(rng.integers(-300, 300)) * MS}
        if kind == 5:
            change |= {"valid_until_ns": scene.now_ns + int(rng.integers(-300, 3000)) * MS, "period_ns": int(rng.integers(1, 300)) * MS}
        if kind == 2:
            change |= {"epoch": scene.leader + int(rng.integers(-2, 2)), "state_stamp_ns": scene.now_ns - int(rng.integers(-300, 400)) * MS}
        if kind == 3:
            change["u"] = np.tile(rng.uniform(-BOUND, BOUND), (20, 1))
        if rng.random() < 0.9:
            passed += scene.send(**change) is not None
        late_ms = int(rng.choice([0, 0, 10, 30]))  # of the next command
        scene.wait(100 - scene.now_ns // MS % 100)
        acted.append(scene.inputs[-1])
        scene.wait(late_ms)
        scene.leader = max(scene.leader, scene.guard._leader[0])
        assert (np.abs(scene.inputs) <= BOUND).all(), (kind, change)
        steps = np.abs(acted[-1] - acted[-2]) if regular else np.abs(np.diff(scene.inputs, axis=0)) / 2
        assert (steps <= 1.1 * STEP).all(), (kind, change)  # a step of the ramp aside
    assert passed > 0.3 * samples
