# SPDX-License-Identifier: Apache-2.0
"""
Two controllers behind a guard: real processes, real signals, by the robot's own record, at 10 Hz and speed 1.

Under each leader, the robot is sent answers to states that only this leader has
answered, without a gap of more than three periods.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from rti_mpc.contract.message import Command
from rti_mpc.contract.status import Mode
from rti_mpc_service.host.hold_up import Host
from tests.guarded import GUARDED
from tests.in_time import explained, in_time, on_time
from tests.processes.record import FAST_STATES, MS, recorded, rests, within_slew
from tests.processes.system import KEYS, until
from tests.processes.watched import Watched, relieved

pytestmark = pytest.mark.slow

DT_S = 0.1
PROMISE_MS = 300.0  # three periods
FORGED = 1  # configuration hash by which a command of this test is known again


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    """A robot that is being driven through its guard by a leader, beside whom another stands by."""
    with Watched(tmp_path_factory.mktemp("guarded"), DT_S, more=GUARDED + FAST_STATES) as system:
        system.drive("guard")
        yield system


def passed(system: Watched, first: int = 0) -> list[Command]:
    """Commands of controllers that the guard has passed, from a message on."""
    system.listen()
    return [command for command in system.actuation[first:] if command.mode is not Mode.BRAKING]


def leaders(host: Host, system: Watched, passed: list[Command], since_ns: int) -> list[int]:
    """Epochs of the only controllers that have answered the states of commands; where the host was in the way, two may have answered one."""
    answers = [{command.epoch for command in system.commands if command.state_seq == one.state_seq} for one in passed]
    assert all(len(epochs) == 1 for epochs in answers) or relieved(host, system, since_ns), answers
    return [epoch for epochs in answers if len(epochs) == 1 for epoch in epochs]


def passes(system: Watched, first: int, count: int) -> list[Command]:
    """Wait until this number of commands has passed the guard, from a message on."""

    def look() -> list[Command] | None:
        found = passed(system, first)
        return found if len(found) >= count else None

    return until(look, "commands pass the guard", pause_s=0.02)


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL], ids=lambda number: number.name)
def test_commands_of_the_standby_pass_the_guard_in_time_and_none_of_the_old_leader_after_them(
    system: Watched, host: Host, number: signal.Signals
) -> None:
    """A stopped leader continues later; then its successor is killed, and it leads again."""
    epoch = system.tracking().epoch
    dying = system.process(epoch)
    died_ns = system.fault(number, dying)
    try:
        second = system.led_by_another(epoch)
        first = until(lambda: next((c for c in passed(system) if c.state_seq == second.state_seq), None), "the first command of another passes")
        start = system.actuation.index(first)
        passes(system, start, 10)
    finally:
        system.running[dying].send_signal(signal.SIGCONT)
    took_ms = (system.answered_ns(first) - died_ns) / MS
    print(f"\n{number.name}: the standby's command reached the robot through the guard after {took_ms:.0f} ms, {PROMISE_MS:.0f} promised")
    in_time(host, "the takeover", took_ms, PROMISE_MS, system.fault_at_ns)
    if number is signal.SIGSTOP:
        until(lambda: "standby" in system.lives, "the old leader stands by")
        fence(system, epoch)
    else:
        system.kill(dying)
    after = passes(system, start, 20)
    epochs = leaders(host, system, after, system.fault_at_ns)
    assert epochs == sorted(epochs), "whoever was relieved says nothing more"
    assert epochs[0] == second.epoch or relieved(host, system, system.fault_at_ns)
    assert FORGED not in {command.config_hash for command in after}
    gap_ms = np.diff([command.state_stamp_ns for command in after]).max() / MS
    if (late_ms := gap_ms - PROMISE_MS) > 0.0:
        assert explained(host, f"the gap between two answers was {gap_ms:.0f} ms", late_ms, system.fault_at_ns, time.monotonic_ns())
    record = recorded(system, died_ns, (after[-1].state_stamp_ns - died_ns) // MS)
    starved = record.starved[-1] - record.starved[0]
    assert starved == 0 or not on_time(host, "what acts", 1e3 * DT_S, system.fault_at_ns), "the robot braked on its own"
    within_slew(record)


def fence(system: Watched, epoch: int) -> None:
    """Command like an old leader that has not noticed its successor: the new leader's commands, in the old epoch."""
    forger = system.bus.publisher(KEYS.command)

    def forge() -> None:
        latest = system.listen()[-1]
        forger.put(replace(latest, epoch=epoch, seq=latest.seq + 1_000_000, config_hash=FORGED))

    system.event("command_fenced", "guard", forge)


def test_restarted_guard_passes_one_leader_and_none_has_taken_over_for_want_of_a_guard(system: Watched, host: Host) -> None:
    begun_ns = time.monotonic_ns()
    system.tracking()
    killed_ns = system.fault(signal.SIGKILL, "guard")
    system.kill("guard")
    system.state(rests)
    passed(system)
    before = len(system.actuation)
    system.start("guard")
    driven = system.state(lambda state: abs(state.x[3]) > 0.05)
    print(f"\nguard restarted: driven again {(driven.stamp_ns - killed_ns) / MS:.0f} ms after it was killed, process start included")
    epochs = leaders(host, system, passes(system, before, 1), begun_ns)
    assert epochs == sorted(epochs)
    answers = [command for command in system.commands if command.state_stamp_ns > killed_ns]
    changes = [(one, other) for one, other in pairwise(answers) if one.epoch != other.epoch]
    silent = all(other.state_stamp_ns - one.state_stamp_ns >= 1.5e9 * DT_S for one, other in changes)
    assert silent or not on_time(host, "a takeover", 1e3 * DT_S, begun_ns), "relieved though it was not silent"
    within_slew(recorded(system, killed_ns, (driven.stamp_ns - killed_ns) // MS))
