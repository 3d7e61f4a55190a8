# SPDX-License-Identifier: Apache-2.0
"""
Conformance tests of a guard, over the bus alone; `deploy/guard.md` is the contract in words.

``pytest tests/guard_conformance --guard "my_guard --verbose"`` runs ``my_guard --verbose CONFIG.toml -e ENDPOINT``; ours without the option.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import Command
from rti_mpc.wire.cdr import encode
from rti_mpc_service.conformance.wrong import WRONG, wrong
from rti_mpc_service.host.hold_up import Host
from tests.guard_conformance.rig import MS, PATIENCE_S, Rig

OURS = f"{shlex.quote(sys.executable)} -c 'from rti_mpc_service.cli import main; main()' guard"


@pytest.fixture(scope="module")
def running(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, host: Host) -> Iterator[Rig]:
    rig = Rig(shlex.split(request.config.getoption("--guard") or OURS), tmp_path_factory.mktemp("guard"), host)
    yield rig
    rig.close()


@pytest.fixture
def rig(running: Rig) -> Iterator[Rig]:
    """A guard that lets the commands of a robot just started pass; whatever follows, inputs stay inside bounds and slew limits."""
    running.ready()
    yield running
    inputs = np.array(running.inputs)
    assert (inputs >= running.lbu).all() and (inputs <= running.ubu).all()
    if running.latest_ns < 50 * MS:  # or this machine is too busy: no guard knows that a message is still on its way
        assert (np.abs(np.diff(inputs, axis=0)) <= running.step + 1e-5).all()  # rounding that a guard may forgive


def test_healthy_command_passes_at_once_and_whole(rig: Rig) -> None:
    sent = []
    rows = np.array([[0.1 + 0.01 * k, 0.2] for k in range(20)])

    def pilot(_: object) -> Command:
        sent.append(rig.command(rows, config_hash=77))
        return sent[-1]

    rig.run(1000, pilot)
    passed = {told.state_seq: (at_ns, told) for at_ns, told in rig.heard if told.config_hash == 77}
    assert passed
    assert len(passed) >= len(sent) - 1 or not rig.on_time("that all pass but the last, which may be on its way")
    for command in sent:
        if command.state_seq in passed:
            _, told = passed[command.state_seq]
            assert encode(replace(told, epoch=command.epoch, seq=command.seq)) == encode(command)
    took_ms = float(np.median([at_ns - told.stamp_ns for at_ns, told in passed.values()])) / MS
    rig.in_time("the way through the guard", took_ms, 50.0, sent[0].stamp_ns)  # long before the next sample


def test_actuation_is_numbered_upwards_in_epochs_no_lower_than_any_controllers(rig: Rig) -> None:
    rig.drive()
    rig.run(700)
    rig.leader += 1
    rig.run(300, rig.towards(np.zeros(2)))
    numbers = [(told.epoch, told.seq) for _, told in rig.heard]
    assert numbers == sorted(set(numbers))
    lives = [told.state_epoch for _, told in rig.heard]  # what was told in the life before may arrive in this one
    assert lives == sorted(lives)
    assert lives[-1] == rig.epoch
    assert numbers[-1][0] >= rig.leader or rig.heard[-1][1].epoch >= rig.leader


@pytest.mark.parametrize("case", sorted({way.case for way in WRONG}))
def test_command_is_refused_as_a_whole(rig: Rig, case: str) -> None:
    for way in wrong(case):
        rig.drive()
        rig.send(way.make(rig.command(rig.ubu, config_hash=77), rig.limits))
        rig.run(50)
        assert not any(told.config_hash == 77 for _, told in rig.heard), f"a command {way.what}"
    rig.drive()  # and the next healthy one passes


def test_plan_plays_on_while_a_message_is_late(rig: Rig) -> None:
    rig.drive()
    rows = np.array([rig.ubu * (1 - 0.1 * k) for k in range(5)])
    rig.run(100, lambda _: rig.command(rows))
    stamp_ns = rig.state.stamp_ns
    rig.run(120)
    times, inputs = rig.acting(stamp_ns)
    between = (times >= 105) & (times < 195)
    if rig.on_time("the plan that plays on", stamp_ns):
        np.testing.assert_allclose(inputs[between], np.tile(rows[1], (between.sum(), 1)))


def test_silence_is_answered_in_time_inside_the_slew_limits_and_for_good(rig: Rig) -> None:
    """The fault comes right after a command; braking begins within 300 ms, and the command is zero within 500 ms."""
    rig.drive()
    fault_ns = rig.state.stamp_ns
    rig.run(1500)
    times, inputs = rig.acting(fault_ns)
    rig.in_time("braking", times[(inputs < rig.ubu - 1e-9).all(axis=1)][0], 300.0, fault_ns)
    zero_ms = times[~inputs.any(axis=1)][0]
    rig.in_time("the command zero", zero_ms, 500.0, fault_ns)
    assert not inputs[times >= zero_ms].any()
    smooth = np.array([np.interp(np.arange(0.0, 600.0, 10.0), times, column) for column in inputs.T]).T
    if rig.on_time("the ramp", fault_ns):
        assert (np.abs(smooth[10:] - smooth[:-10]) <= 1.12 * rig.step).all(), "over any 100 ms, a step of the ramp aside"


def test_standing_is_told_with_a_short_validity(rig: Rig) -> None:
    rig.drive()
    rig.run(1500)
    at_ns, told = rig.heard[-1]
    rig.in_time("news of the guard", (rig.now_ns - at_ns) / MS, 500.0, at_ns)
    assert not told.u.any()
    assert told.valid_until_ns - at_ns <= 300 * MS


def test_nothing_acts_longer_than_promised_whatever_a_command_says(rig: Rig) -> None:
    rig.run(400, lambda _: rig.command(0.5 * rig.step, valid_until_ns=2**62 - 1))
    assert all(told.valid_until_ns <= told.state_stamp_ns + 300 * MS for _, told in rig.heard if told.u.any())
    rig.run(1000)
    assert not rig.actuator.u.any()


def test_gap_is_left_without_a_jump(rig: Rig) -> None:
    """A controller that knows of none goes on at full inputs; the fixture watches the slew limits."""
    rig.drive()
    rig.run(800)
    assert not rig.actuator.u.any()
    rig.reach(rig.ubu, lambda _: rig.command(rig.ubu))


def test_higher_epoch_takes_over_and_the_old_leader_is_fenced_for_good(rig: Rig) -> None:
    rig.drive()
    old = rig.leader
    rig.leader += 5
    rig.reach(0.5 * rig.ubu, rig.towards(0.5 * rig.ubu))
    rig.leader, rig.seq = old, rig.seq + 1000
    rig.run(1500, lambda _: rig.command(rig.ubu, config_hash=77))  # while the new one is silent
    assert not any(told.config_hash == 77 for _, told in rig.heard)
    assert not rig.actuator.u.any()


def test_stale_commands_of_a_controller_that_was_stopped_do_not_pass(rig: Rig) -> None:
    rig.drive()
    waiting: list[Command] = []

    def collect(_: object) -> None:
        waiting.append(rig.command(rig.ubu, config_hash=77))

    rig.run(1500, collect)
    for command in waiting:
        rig.send(command)
    rig.run(60)
    for at_ns, told in rig.heard:
        if told.config_hash == 77:
            rig.in_time("a state that is answered", (at_ns - told.state_stamp_ns) / MS, 340.0, told.state_stamp_ns)


def test_guard_that_was_stopped_passes_nothing_stale_and_goes_on(rig: Rig) -> None:
    rig.drive()
    os.kill(rig.process.pid, signal.SIGSTOP)
    before = len(rig.heard)
    try:
        rig.run(1500, rig.towards(rig.ubu))
        assert not rig.actuator.u.any(), "the robot's own watchdog"
    finally:
        os.kill(rig.process.pid, signal.SIGCONT)
    rig.run(300)
    for at_ns, told in rig.heard[before:]:
        if told.u.any():
            rig.in_time("a state that is answered", (at_ns - told.state_stamp_ns) / MS, 500.0, told.state_stamp_ns)
    rig.drive()


def test_another_life_of_the_robot_forgets_leader_and_plan(rig: Rig) -> None:
    rig.drive()
    rig.new_robot()
    rig.leader -= 50
    rig.reach(0.2 * rig.ubu, rig.towards(0.2 * rig.ubu))


@pytest.mark.parametrize("ms", [-3000, 3000])
def test_clock_that_jumps_lets_nothing_old_pass(rig: Rig, ms: int) -> None:
    rig.drive()
    old = rig.command(rig.ubu, config_hash=77)
    rig.jump(ms)
    rig.run(150)
    rig.send(old)
    rig.run(400)
    assert not any(told.config_hash == 77 for _, told in rig.heard)
    assert not rig.actuator.u.any()
    rig.drive()


def not_stored(answers: list[dict[str, Any]]) -> bool:
    """Whether somebody has yet to store the stop, or nobody has answered."""
    return not answers or any("not_stored" in answer for answer in answers)


def test_stopped_guard_passes_only_ways_to_rest_and_so_does_one_that_was_restarted(rig: Rig) -> None:
    """Independent of the commands of a controller that has not received the stop."""

    def says(what: str) -> None:
        assert any(answer["ok"] is True for answer in rig.bus.answers(rig.bus.keys.stop, {"request": what}, 5.0))

    def rests_only() -> None:
        before = len(rig.heard)
        while not any(told.config_hash == 77 for _, told in rig.heard[before:]):
            assert rig.now_ns < deadline_ns, "rest must pass"
            rig.run(100, lambda _: rig.command(np.zeros(2), config_hash=77))
        rig.run(400, rig.towards(rig.ubu))
        assert not rig.actuator.u.any()

    rig.drive()
    says("stop")
    stopped_ns, deadline_ns = rig.now_ns, rig.now_ns + round(2e9 * PATIENCE_S)
    rig.run(900, rig.towards(rig.ubu))
    times, inputs = rig.acting(stopped_ns)
    assert not inputs[times > 600.0].any(), "the last plan before ends 300 ms after its state, its ramp 200 ms later"
    rests_only()
    while not_stored(list(rig.bus.answers(rig.bus.keys.stop, {"request": "stop"}, 5.0))):
        assert rig.now_ns < deadline_ns, "a stop must be stored; a guard may answer before"
    rig.kill()
    rig.start()
    rests_only()
    says("enable")
    rig.drive()


def test_guard_without_states_lets_nothing_pass(rig: Rig) -> None:
    rig.drive()
    rig.deaf = True
    try:
        rig.run(400, rig.towards(rig.ubu))
        before = len(rig.heard)
        rig.run(400, lambda _: rig.command(rig.ubu, config_hash=77))
        assert not any(told.config_hash == 77 for _, told in rig.heard[before:])
    finally:
        rig.deaf = False


def test_killed_guard_leaves_the_plan_with_the_robot_and_another_one_goes_on_in_a_higher_epoch(rig: Rig) -> None:
    rig.drive()
    fault_ns, epoch = rig.heard[-1][1].state_stamp_ns, rig.heard[-1][1].epoch
    rig.kill()
    rig.start()
    rig.run(600)
    times, inputs = rig.acting(fault_ns)
    if rig.on_time("the plan of a robot without a guard", fault_ns):
        assert (inputs[(times > 110.0) & (times < 240.0)] == rig.ubu).all(axis=1).any(), "the plan plays on"
    rig.in_time("rest without a guard", times[~inputs.any(axis=1)][0], 500.0, fault_ns)
    rig.drive()
    assert rig.heard[-1][1].epoch > epoch


def test_interrupted_guard_tells_the_robot_to_ramp_to_rest_and_to_stand(rig: Rig) -> None:
    rig.drive()
    rig.process.send_signal(signal.SIGINT)
    rig.run(700, rig.towards(rig.ubu))
    assert rig.process.wait(PATIENCE_S) == 0
    rig.run(700, rig.towards(rig.ubu))
    assert not rig.heard[-1][1].u[-1].any()
    assert not rig.actuator.u.any()
    rig.start()
