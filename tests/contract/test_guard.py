# SPDX-License-Identifier: Apache-2.0
"""Guard without clock and network, in front of the actuators of the simulated robot, judged by the inputs that act there."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.guard import Guard
from rti_mpc.contract.limits import MAX_VALID_NS
from rti_mpc.contract.message import Command, Severity, State
from rti_mpc.contract.status import Mode
from rti_mpc.wire.actuator import Actuator
from tests.contract.scene import BOUND, FULL, LIMITS, LOCAL_NS, MS, STEP, Scene


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


def test_a_state_in_the_future_is_told_by_how_far_it_is_ahead(scene: Scene) -> None:
    ahead = 100 * MS
    assert scene.send(state_stamp_ns=scene.now_ns + ahead, stamp_ns=scene.now_ns + ahead, valid_until_ns=scene.now_ns + 350 * MS) is None
    (text,) = [notice.text for notice in scene.guard.notices if notice.code == "command_early"]
    assert text.endswith("was refused: it answers a state 0.100 s ahead of now")


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
