# SPDX-License-Identifier: Apache-2.0
"""
Hours in small: 200 samples a second in real time, by real processes, for as long as `--soak-s` says; `make soak` says half an hour.

Beside them a bare timer runs on each core. It computes nothing, so what makes it
late is the host, and a period missed at such a moment is the host's.
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
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from rti_mpc.message import Command, Telemetry
from rti_mpc.wire.cdr import decode
from service import machine, realtime
from service.robot_log import RobotLog
from tests.bench.driven import Driven, driven, quantiles
from tests.processes.system import ROOT, anonymous_bytes, environment, until

pytestmark = pytest.mark.slow

DT_S = 0.005
TICK_S = 0.002  # of the bare timers: whatever holds a core up for most of a period meets one
HELD_UP_NS = 500_000  # lateness of a bare timer that explains missed periods
AFTERMATH_NS = 50_000_000  # in which they may be: all that was held up is then done at once
COLD = 400  # first samples, left out: everybody starts
LOOK_S = 1.0
ROLES = ("controller", "robot", "reference")
WARM_UP_S = 600.0  # in which the arenas of the allocator meet their stalls; a quarter of a shorter run
LONG_S = 900.0  # from which on a slope per hour can be told from a high-water mark that a stall has left
MIB = 2**20

TIMER = """
import os, signal, sys
import numpy as np
from service.jitter import bare_timer
os.sched_setaffinity(0, {int(sys.argv[1])})
going = [True]
signal.signal(signal.SIGINT, lambda *_: going.clear())
np.save(sys.argv[2], bare_timer(float(sys.argv[3]), lambda: going))
"""


class Timers:
    """A bare timer on each core; `ticks` holds when each was due and how late it was, ns, once they have ended."""

    def __init__(self, folder: Path) -> None:
        self.ticks: list[np.ndarray] = []
        self._paths = {core: folder / f"timer-{core}.npy" for core in realtime.available()}

    @contextmanager
    def running(self) -> Iterator[None]:
        commands = [[sys.executable, "-c", TIMER, str(core), str(path), str(TICK_S)] for core, path in self._paths.items()]
        timers = [subprocess.Popen(command, cwd=ROOT, env=environment()) for command in commands]
        try:
            yield
        finally:
            for timer in timers:
                timer.send_signal(signal.SIGINT)
            status = [timer.wait(10.0) for timer in timers]
        assert not any(status)
        self.ticks = [np.load(path) for path in self._paths.values()]

    def held_up(self, at_ns: np.ndarray) -> np.ndarray:
        """Whether the host held a core up about these times, shape ``(n,)``."""
        stalls = np.concatenate([rows[rows[:, 1] > HELD_UP_NS] for rows in self.ticks])
        from_ns, to_ns = stalls[:, 0] - AFTERMATH_NS, stalls.sum(axis=1) + AFTERMATH_NS
        return np.array([bool(((from_ns < at) & (at < to_ns)).any()) for at in at_ns], bool)

    def share(self, from_ns: float, to_ns: float) -> float:
        """The share of a time in which the host held a core up."""
        return float(self.held_up(np.linspace(from_ns, to_ns, 1000)).mean())


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
    return 3600.0 * float(scipy.stats.theilslopes(mib, times_s).slope)


@dataclass
class Soak:
    """What was seen of a long drive, from a first sample to a last one."""

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
        """Every state that was sent, by what became of it."""
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


def soak(folder: Path, duration_s: float) -> Soak:
    """Drive, and look at the memory."""
    looks = []
    with driven(folder, DT_S, duration_s + 60.0) as robot:
        first = robot.samples(COLD)[-1]
        commands = Commands(robot)
        commands.start()
        samples = robot.bus.subscriber(robot.bus.keys.telemetry)
        until_s = time.monotonic() + duration_s
        while time.monotonic() < until_s:
            time.sleep(LOOK_S)
            looks.append((time.monotonic(), *(anonymous_bytes(robot.pids[role]) / MIB for role in ROLES)))
        last = decode(Telemetry, until(samples.try_recv, "a last sample").payload)
        for role in ("controller", "robot", "reference"):
            assert robot.children.end(role) == 0, role
    silences = (folder / "controller.log").read_text().count("no state for")
    return Soak(first, last, commands.heard, np.array(looks), silences, robot.log())


def test_hours_of_samples_miss_no_period_lose_no_message_and_take_no_memory(
    tmp_path: Path, pytestconfig: pytest.Config, capsys: pytest.CaptureFixture[str]
) -> None:
    duration_s = float(pytestconfig.getoption("--soak-s"))
    timers = Timers(tmp_path)
    with timers.running():
        seen = soak(tmp_path, duration_s)
    account, missed_ns = seen.account(), seen.missed_ns()
    explained = int(timers.held_up(missed_ns).sum())
    warm = seen.looks[seen.looks[:, 0] > seen.looks[0, 0] + min(WARM_UP_S, 0.25 * duration_s)]
    with capsys.disabled():
        print(f"\n{machine.describe()}")
        print(f"{duration_s:g} s at {1 / DT_S:g} Hz, {seen.span.sum()} states: {account}, {seen.silences} silences, {seen.log.counters}")
        print(
            f"state to command  {quantiles(seen.log.latency_us[seen.span])}; {len(missed_ns)} missed the period, {explained} of them while the host"
        )
        print(f"held a core up, as it did in {timers.share(*(1e9 * seen.looks[[0, -1], 0])):.1%} of the time")
        for core, rows in enumerate(timers.ticks):
            held_up = (rows[:, 1] > HELD_UP_NS).sum()
            print(f"bare timer {core}      {quantiles(1e-3 * rows[:, 1])}; {held_up} of {len(rows)} later than {1e-6 * HELD_UP_NS:g} ms")
        for role, used in zip(ROLES, warm[:, 1:].T, strict=True):
            print(f"{role:17} {used[-1]:.1f} MiB, {growth(warm[:, 0], used):+.2f} MiB/h fitted, {np.ptp(used):.2f} MiB between least and most")
    assert explained == len(missed_ns)
    assert account["rest"] >= 0 if seen.silences else account["rest"] == 0
    for used in warm[:, 1:].T:
        assert growth(warm[:, 0], used) < 1.0 if duration_s >= LONG_S else np.ptp(used) < 1.0
