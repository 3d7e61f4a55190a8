# SPDX-License-Identifier: Apache-2.0
"""
Soak test: 200 samples per second in real time, by real processes, for as long as `--soak-s` says; `make soak` says half an hour.

Beside them a bare timer runs on each core. It computes nothing, so what makes it
late is the host, and a period missed at such a moment is attributed to the host, as is one at
which our processes waited for a core for half a period. A second bare timer
goes before everybody else (SCHED_FIFO, where that is allowed): what it meets the
host alone has done, and it tells how much is explained if nothing else counts.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Command, Telemetry
from rti_mpc.wire.cdr import decode
from rti_mpc_service.host import machine, realtime
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.rig.robot_log import RobotLog
from tests.bench.driven import Driven, driven, quantiles
from tests.memory import PARTS, anonymous_bytes
from tests.processes.system import PATIENCE_S, ROOT, environment, until

pytestmark = pytest.mark.slow

DT_S = 0.005
TICK_S = 0.002  # of the bare timers: whatever holds a core up for most of a period meets one
HELD_UP_NS = 500_000  # lateness of a bare timer that explains missed periods
EXPLAINED_NS = 50_000_000  # after a late tick, in which missed periods are explained: all that was held up is then done at once
FIRST, SOON_NS = 50, 10_000_000  # priority of the timers that see the host alone, and their aftermath: two periods
COLD_SAMPLES = 400  # first samples, left out: everybody starts
MEMORY_PERIOD_S = 1.0
ROLES = ("controller", "robot", "reference")
WARM_UP_S = 600.0  # in which the arenas of the allocator meet their stalls; a quarter of a shorter run
MIN_SLOPE_RUN_S = 900.0  # in a shorter run, a growth per hour cannot be distinguished from the step that a stall leaves
SHORT_RUN_GROWTH = 100.0  # MiB/h, limit in a shorter run: a leak of a hundred bytes per sample
MIB = 2**20

TIMER = """
import os, signal, sys
from contextlib import suppress
import numpy as np
from rti_mpc_service.host.jitter import bare_timer
os.sched_setaffinity(0, {int(sys.argv[1])})
with suppress(PermissionError):
    if priority := int(sys.argv[4]):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
going = [True]
signal.signal(signal.SIGINT, lambda *_: going.clear())
np.save(sys.argv[2], bare_timer(float(sys.argv[3]), lambda: going))
"""


class Timers:
    """A bare timer on each core; `ticks` holds when each was due and how late it was, ns, once they have ended."""

    def __init__(self, folder: Path, *, priority: int, aftermath_ns: int) -> None:
        self.ticks: list[np.ndarray] = []
        self._paths = {core: folder / f"timer-{core}-{priority}.npy" for core in realtime.available()}
        self._priority = str(priority)
        self._aftermath_ns = aftermath_ns

    @contextmanager
    def running(self) -> Iterator[None]:
        commands = [[sys.executable, "-c", TIMER, str(core), str(path), str(TICK_S), self._priority] for core, path in self._paths.items()]
        timers = [subprocess.Popen(command, cwd=ROOT, env=environment()) for command in commands]
        try:
            yield
        finally:
            for timer in timers:
                timer.send_signal(signal.SIGINT)
            status = [timer.wait(PATIENCE_S) for timer in timers]
        assert not any(status)
        self.ticks = [np.load(path) for path in self._paths.values()]

    def held_up(self, at_ns: np.ndarray) -> np.ndarray:
        """Whether the host held a core up about these times, shape ``(n,)``."""
        stalls = np.concatenate([rows[rows[:, 1] > HELD_UP_NS] for rows in self.ticks])
        from_ns, to_ns = stalls[:, 0] - self._aftermath_ns, stalls.sum(axis=1) + self._aftermath_ns
        return np.array([bool(((from_ns < at) & (at < to_ns)).any()) for at in at_ns], bool)

    def share(self, from_ns: float, to_ns: float) -> float:
        """The share of a time in which the host held a core up."""
        return float(self.held_up(np.linspace(from_ns, to_ns, 1000)).mean())

    def late(self, from_ns: float, to_ns: float) -> float:
        """The share of ticks in a time that were late."""
        ticks = np.concatenate(self.ticks)
        return float((ticks[(from_ns <= ticks[:, 0]) & (ticks[:, 0] < to_ns), 1] > HELD_UP_NS).mean())


class Commands(threading.Thread):
    """When, by the monotonic clock, a command that answers a state came past: seq of the state, time in ns."""

    def __init__(self, robot: Driven) -> None:
        super().__init__(daemon=True)
        self.heard: list[tuple[int, int]] = []
        self._subscriber = robot.bus.subscriber(robot.bus.keys.command, capacity=64)

    def run(self) -> None:
        for received in iter(self._subscriber.recv, None):
            self.heard.append((decode(Command, received.payload).state_seq, time.monotonic_ns()))


def growth(times_s: np.ndarray, mib: np.ndarray) -> float:
    """Fitted (Theil 1950, Sen 1968: the median of all slopes, which a single step does not move), in MiB per hour."""
    from scipy.stats import theilslopes

    return 3600.0 * float(theilslopes(mib, times_s).slope)


@dataclass
class Soak:
    """Observations of a long drive, from a first sample to a last one."""

    first: Telemetry
    last: Telemetry
    commands: list[tuple[int, int]]
    looks: np.ndarray  # time, s, and memory of each of `ROLES`, MiB
    silences: int  # that the controller reported; it starts cold after each, and counts no sample as skipped
    log: RobotLog

    @property
    def span(self) -> np.ndarray:
        return (self.log.seq > self.first.state_seq) & (self.log.seq <= self.last.state_seq)

    def account(self) -> dict[str, int]:
        """Count every state that was sent, by outcome."""
        seq, latency_us = self.log.seq[self.span], self.log.latency_us[self.span]
        assert np.all(np.diff(seq) == 1)
        answered = set(seq[np.isfinite(latency_us)].tolist())
        refused = set(seq.tolist()) & {state_seq for state_seq, _ in self.commands} - answered
        skipped = self.last.skipped - self.first.skipped
        withheld = self.last.shifted - self.first.shifted  # over their budget, for no QP fails here; what is answered by a ramp is answered
        return {
            "answered": len(answered),
            "not accepted": len(refused),
            "skipped": skipped,
            "over budget": withheld,
            "rest": len(seq) - len(answered) - len(refused) - skipped - withheld,
        }

    def missed_ns(self) -> np.ndarray:
        """When each state passed that was not answered within a period, by the monotonic clock."""
        seq = self.log.seq[self.span][~(self.log.latency_us[self.span] <= 1e6 * DT_S)]
        return np.interp(seq, *np.array(self.commands, float).T)


def by_minute(seen: Soak, missed_ns: np.ndarray, timers: Timers) -> list[tuple[float, float]]:
    """Each minute, the quietest first: the share of late ticks of the bare timers, and of missed periods."""
    from_s, to_s = seen.looks[[0, -1], 0]
    edges = 1e9 * np.linspace(from_s, to_s, 1 + max(1, int((to_s - from_s) // 60.0)))
    missed, _ = np.histogram(missed_ns, edges)
    return sorted((timers.late(*between), 1e9 * DT_S * count / np.ptp(between)) for between, count in zip(pairwise(edges), missed, strict=True))


def soak(folder: Path, duration_s: float) -> Soak:
    """Drive, and record the memory of the processes."""
    looks = []
    with driven(folder, DT_S, duration_s + 60.0) as robot:
        first = robot.samples(COLD_SAMPLES)[-1]
        commands = Commands(robot)
        commands.start()
        samples = robot.bus.subscriber(robot.bus.keys.telemetry)
        until_s = time.monotonic() + duration_s
        while time.monotonic() < until_s:
            time.sleep(MEMORY_PERIOD_S)
            looks.append((time.monotonic(), *(anonymous_bytes(robot.pids[role]) / MIB for role in ROLES)))
        last = decode(Telemetry, until(samples.try_recv, "a last sample").payload)
        for role in ("controller", "robot", "reference"):
            assert robot.children.end(role) == 0, role
    silences = (folder / "controller.log").read_text().count("no state for")
    return Soak(first, last, commands.heard, np.array(looks), silences, robot.log())


def test_hours_of_samples_miss_no_period_lose_no_message_and_take_no_memory(
    tmp_path: Path, host: Host, pytestconfig: pytest.Config, capsys: pytest.CaptureFixture[str]
) -> None:
    duration_s = float(pytestconfig.getoption("--soak-s"))
    timers, first = Timers(tmp_path, priority=0, aftermath_ns=EXPLAINED_NS), Timers(tmp_path, priority=FIRST, aftermath_ns=SOON_NS)
    with timers.running(), first.running():
        seen = soak(tmp_path, duration_s)
    account, missed_ns = seen.account(), seen.missed_ns()
    warm = seen.looks[seen.looks[:, 0] > seen.looks[0, 0] + min(WARM_UP_S, 0.25 * duration_s)]
    with capsys.disabled():
        print(f"\n{machine.machine_info()}")
        print(f"{duration_s:g} s at {1 / DT_S:g} Hz, {seen.span.sum()} states: {account}, {seen.silences} silences, {seen.log.counters}")
        print(f"state to command  {quantiles(seen.log.latency_us[seen.span])}; {len(missed_ns)} missed the period")
        between = 1e9 * seen.looks[[0, -1], 0]
        for which, those in {"a bare timer": timers, "one that goes before everybody": first}.items():
            print(
                f"{those.held_up(missed_ns).sum()} of them while the host held up {which}, as in {those.share(*between):.1%} of the time; its ticks:"
            )
            for rows in those.ticks:
                late = (rows[:, 1] > HELD_UP_NS).mean()
                print(f"                  {quantiles(1e-3 * rows[:, 1])}, {late:.2%} of them later than {1e-6 * HELD_UP_NS:g} ms")
        minutes = by_minute(seen, missed_ns, first)
        for which, (late, missed) in {"quietest": minutes[0], "loudest": minutes[-1]}.items():
            print(f"the {which} minute: of the latter {late:.2%}, and {missed:.2%} of all periods missed")
        for role, used in zip(ROLES, warm[:, 1:].T, strict=True):
            print(f"{role:17} {used[-1]:.1f} MiB, {growth(warm[:, 0], used):+.2f} MiB/h fitted, {np.ptp(used):.2f} MiB between least and most")
    waited_ms = np.array([host.held_up_ms(at - round(3e9 * DT_S), at + round(2e9 * DT_S)) for at in missed_ns.astype(int).tolist()])
    explained = timers.held_up(missed_ns) | (waited_ms > 0.5e3 * DT_S)
    assert explained.all(), waited_ms[~explained]
    assert account["rest"] >= 0 if seen.silences else account["rest"] == 0
    parts, limit = (1, 1.0) if duration_s >= MIN_SLOPE_RUN_S else (PARTS, SHORT_RUN_GROWTH)
    for used in warm[:, 1:].T:
        grown = [growth(*part.T) for part in np.array_split(np.column_stack((warm[:, 0], used)), parts)]
        assert min(grown) < limit, grown
