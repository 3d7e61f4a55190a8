# SPDX-License-Identifier: Apache-2.0
"""
Ends of every kind of process, repeated: just after a peer has left or hangs, or the network has gone.

`make ends` ends each kind 50 times, `--ends` says how often. A daemon thread that is inside Zenoh when the interpreter
finalizes aborts the process (status 134); a link to somebody who hangs is closed for 10 s.
"""

from __future__ import annotations

import signal
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from rti_mpc_service.rig.endpoint import free_endpoint
from tests.guarded import write_robot
from tests.in_time import LOOK_MS, OwnWaits
from tests.processes.network import ip, missing, name_of
from tests.processes.system import PATIENCE_S, ROOT, command_line, environment, until

pytestmark = pytest.mark.slow

RAMP_S = 0.6  # that a controller or guard may take to bring the robot to rest; others take none
END_S = 2.0  # from the end of the ramp to the end of the process
ENDPOINT = "tcp/127.0.0.1:7447"  # of a network of its own
SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
LIVING = {  # what each process says once it can be ended, and the words that start it
    "router": ("routing", ("router",)),
    "robot": ("times real speed", ("sim",)),
    "guard": ("commands of epoch", ("guard",)),
    "controller": ("waiting to tracking", ("run",)),
    "reference": ("s of the robot on", ("reference",)),
    "standby": ("waiting to tracking", ("run", "--standby")),
    "recorder": ("recording", ("record",)),
    **({"viewer": ("open", ("view",))} if find_spec("rerun") else {}),
}


@dataclass(frozen=True)
class Before:
    """What happens just before the end: a signal to one process, or the network is gone."""

    router: bool  # whether all are clients of one, or peers
    victim: str = ""
    number: signal.Signals = signal.SIGKILL
    cut: bool = False

    @property
    def ended(self) -> set[str]:
        return LIVING.keys() - {self.victim} - (set() if self.router else {"router"})


BEFORE = {
    "nothing": Before(router=False),
    "nothing, behind a router": Before(router=True),
    "a peer is killed": Before(router=False, victim="robot"),
    "a peer hangs": Before(router=False, victim="robot", number=signal.SIGSTOP),
    "a client is killed": Before(router=True, victim="robot"),
    "a client hangs": Before(router=True, victim="robot", number=signal.SIGSTOP),
    "the router is killed": Before(router=True, victim="router"),
    "the router hangs": Before(router=True, victim="router", number=signal.SIGSTOP),
    "the network of peers is gone": Before(router=False, cut=True),
    "the network of clients is gone": Before(router=True, cut=True),
}


@dataclass(frozen=True)
class Ending:
    """How one process ended."""

    role: str
    before: str
    number: signal.Signals
    status: int
    took_s: float
    waited: OwnWaits = field(repr=False)
    said: str = field(repr=False)

    @property
    def clean(self) -> bool:
        """Whether it ended with status 0, without complaints, and in time, less that in which its own threads waited for a core."""
        in_time = self.waited.explain(1e3 * (self.took_s - RAMP_S - END_S))
        return self.status == 0 and in_time and "FATAL" not in self.said and "Traceback" not in self.said


class Round:
    """One robot with every kind of process, all of which end at once."""

    def __init__(self, folder: Path, before: str) -> None:
        self.folder = folder
        self._before, self._name = BEFORE[before], before
        self._namespace = name_of("ends") if self._before.cut else ""
        self._endpoint = ENDPOINT if self._before.cut else free_endpoint()
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Round:
        self.folder.mkdir()
        write_robot(self.folder / "robot.toml")
        with ExitStack() as stack:
            if self._namespace:
                ip("netns", "add", self._namespace)
                stack.callback(ip, "netns", "del", self._namespace)
                ip("-n", self._namespace, "link", "set", "lo", "up")
            for role in LIVING:
                if role == "standby":
                    self._living("controller")
                if role != "router" or self._before.router:
                    self._running[role] = process = self._start(role)
                    stack.callback(process.wait)
                    stack.callback(process.kill)
            for role in self._running:
                self._living(role)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def end(self, pause_s: float, number: signal.Signals) -> Iterator[Ending]:
        """Do what happens before the end, and end all other processes a while later."""
        if self._before.cut:
            ip("-n", self._namespace, "link", "set", "lo", "down")
        if self._before.victim:
            self._running.pop(self._before.victim).send_signal(self._before.number)
        time.sleep(pause_s)
        waited = {role: OwnWaits(process.pid) for role, process in self._running.items()}
        signal_ns = time.monotonic_ns()
        for process in self._running.values():
            process.send_signal(number)
        left = dict(self._running)
        while left and (took_s := 1e-9 * (time.monotonic_ns() - signal_ns)) < PATIENCE_S:
            for role, process in list(left.items()):
                waited[role].look()
                if (status := process.poll()) is not None:
                    yield Ending(role, self._name, number, status, took_s, waited[role], self._said(role))
                    del left[role]
            time.sleep(1e-3 * LOOK_MS)
        for role in left:
            yield Ending(role, self._name, number, -signal.SIGKILL, PATIENCE_S, waited[role], self._said(role))

    def _start(self, role: str) -> subprocess.Popen[bytes]:
        _, (command, *options) = LIVING[role]
        written = {"viewer": ("--rerun-save", "run.rrd"), "recorder": ("--out", "run.mcap")}
        if role in written:
            option, name = written[role]
            options += [option, str(self.folder / name)]
        options += ["-l", self._endpoint] if role == "router" else ["-m", "client" if self._before.router else "peer", "-e", self._endpoint]
        inside = ["ip", "netns", "exec", self._namespace] if self._namespace else []
        with (self.folder / f"{role}.log").open("wb") as log:
            line = [*inside, *command_line(command, self.folder / "robot.toml", *options)]
            return subprocess.Popen(line, cwd=ROOT, env=environment(self.folder / "state"), stdout=log, stderr=subprocess.STDOUT)

    def _living(self, role: str) -> None:
        words, _ = LIVING[role]
        until(lambda: words in self._said(role) or self._running[role].poll() is not None, f"{role} says {words!r}", 0.02)
        assert self._running[role].poll() is None, self._said(role)

    def _said(self, role: str) -> str:
        return (self.folder / f"{role}.log").read_text(errors="replace")


def test_every_kind_of_process_ends_with_status_0_whatever_has_just_happened_to_its_links(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    count: int = pytestconfig.getoption("--ends")
    rng = np.random.default_rng(1)
    befores = [name for name, before in BEFORE.items() if not before.cut or missing() is None]
    endings: list[Ending] = []
    used: Counter[str] = Counter()
    ended = Counter(dict.fromkeys(LIVING, 0))
    while min(ended.values()) < count:
        least = min(ended, key=lambda role: ended[role])
        before = min((name for name in befores if least in BEFORE[name].ended), key=lambda name: used[name])
        used[before] += 1
        with Round(tmp_path / str(used.total()), before) as made:
            # Links are lost in their own time, and ends meet every part of it.
            pause_s = rng.choice([0.0, rng.uniform(0.0, 0.1), rng.uniform(0.0, 2.0)])
            endings += made.end(pause_s, SIGNALS[used.total() % len(SIGNALS)])
        ended = Counter({role: sum(ending.role == role for ending in endings) for role in LIVING})
    print("", *(f"{number:3} rounds after {before}" for before, number in used.items()), sep="\n")
    for role in LIVING:
        times_s = [ending.took_s for ending in endings if ending.role == role]
        print(f"{role:10} {len(times_s)} ends, from signal to end p50 {np.median(times_s):.2f}, max {max(times_s):.2f} s")
    bad = [ending for ending in endings if not ending.clean]
    for ending in bad:
        print(f"{ending}\n{ending.said[-2000:]}")
    assert not bad
