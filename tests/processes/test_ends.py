# SPDX-License-Identifier: Apache-2.0
"""
Every kind of process, ended again and again just after somebody it talks to has left, hangs, or the network is gone.

`make ends` ends each kind 50 times, `--ends` says how often. A daemon thread that is inside Zenoh when the interpreter
finalizes aborts the process (status 134); a link to somebody who hangs is closed for 10 s.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from service.cli import SHIPPED
from service.host import Host
from tests.in_time import explained
from tests.processes.system import ROOT, command_line, environment, free_endpoint, until

pytestmark = pytest.mark.slow

RAMP_S = 0.6  # that a controller or guard may take to bring the robot to rest; others take none
END_S = 2.0  # from the end of the ramp to the end of the process
PATIENCE_S = 120.0  # for all to be driven: a busy host takes its time
ENDPOINT = "tcp/127.0.0.1:7447"  # of a network of its own
LIVING = {  # what each process says once it can be ended, and the words that start it
    "router": ("routing", ("router",)),
    "robot": ("times real speed", ("sim",)),
    "guard": ("commands of epoch", ("guard",)),
    "controller": ("waiting to tracking", ("run",)),
    "reference": ("s of the robot on", ("reference",)),
    "standby": ("waiting to tracking", ("run", "--standby")),
    "viewer": ("open", ("view",)),
}


@dataclass
class Ending:
    """How one process ended."""

    role: str
    before: str
    status: int
    signal_ns: int
    took_s: float
    said: str = field(repr=False)

    def clean(self, host: Host) -> bool:
        """Whether it ended with status 0, nothing to complain about, and in time, but for what the host took of it."""
        late_ms = 1e3 * (self.took_s - RAMP_S - END_S)
        in_time = late_ms <= 0.0 or explained(host, f"{self}", late_ms, self.signal_ns, self.signal_ns + round(1e9 * self.took_s))
        return self.status == 0 and in_time and "FATAL" not in self.said and "Traceback" not in self.said


@dataclass
class Network:
    """One robot's processes, in a network of their own where the host allows it."""

    folder: Path
    router: bool
    namespace: str | None
    endpoint: str
    running: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def start(self, role: str) -> None:
        _, words = LIVING[role]
        command, *options = words
        options += ["--rerun-save", str(self.folder / "run.rrd")] if role == "viewer" else []
        options += ["-l", self.endpoint] if role == "router" else ["-m", "client" if self.router else "peer", "-e", self.endpoint]
        line = command_line(command, self.folder / "robot.toml", *options)
        if self.namespace is not None:
            line = ["ip", "netns", "exec", self.namespace, *line]
        with (self.folder / f"{role}.log").open("wb") as log:
            self.running[role] = subprocess.Popen(line, cwd=ROOT, env=environment(), stdout=log, stderr=subprocess.STDOUT)

    def drive(self) -> None:
        """Start everybody, and wait until the robot is driven and all have met."""
        roles = [role for role in LIVING if (role != "router" or self.router) and (role != "viewer" or find_spec("rerun"))]
        for role in roles:
            if role == "standby":
                self.living("controller")
            self.start(role)
        for role in roles:
            self.living(role)

    def living(self, role: str) -> None:
        words, _ = LIVING[role]
        until(lambda: words in self.said(role) or self.running[role].poll() is not None, f"{role} says {words!r}", 0.02, PATIENCE_S)
        assert self.running[role].poll() is None, self.said(role)

    def said(self, role: str) -> str:
        return (self.folder / f"{role}.log").read_text(errors="replace")

    def kill(self, role: str) -> None:
        process = self.running.pop(role)
        process.kill()
        process.wait()

    def end(self, before: str) -> Iterator[Ending]:
        """End all that run and are not stopped, all at once."""
        signal_ns = time.monotonic_ns()
        for process in self.running.values():
            process.send_signal(signal.SIGTERM)
        left = dict(self.running)
        while left and (took_s := 1e-9 * (time.monotonic_ns() - signal_ns)) < PATIENCE_S:
            for role, process in list(left.items()):
                if (status := process.poll()) is not None:
                    yield Ending(role, before, status, signal_ns, took_s, self.said(role))
                    del left[role]
            time.sleep(2e-3)
        for role in left:
            yield Ending(role, before, -signal.SIGKILL, signal_ns, PATIENCE_S, self.said(role))


def hang(role: str) -> Callable[[Network], None]:
    def act(network: Network) -> None:
        network.running.pop(role).send_signal(signal.SIGSTOP)

    return act


def cut(network: Network) -> None:
    subprocess.run(["ip", "-n", network.namespace or "", "link", "set", "lo", "down"], check=True)


BEFORE: dict[str, tuple[bool, Callable[[Network], None]]] = {  # what happens just before, and whether there is a router
    "nothing": (False, lambda _: None),
    "a peer is killed": (False, lambda network: network.kill("robot")),
    "the router is killed": (True, lambda network: network.kill("router")),
    "a peer hangs": (False, hang("robot")),
    "the router hangs": (True, hang("router")),
    "a client is killed": (True, lambda network: network.kill("robot")),
    "the network is gone": (True, cut),
    "the network of peers is gone": (False, cut),
}


@contextmanager
def network(folder: Path, *, router: bool, own: bool) -> Iterator[Network]:
    folder.mkdir()
    (folder / "robot.toml").write_text(SHIPPED.read_text() + "\n[guard]\nenabled = true\n")
    namespace = f"ends-{os.getpid()}" if own else None
    if namespace is not None:
        subprocess.run(["ip", "netns", "add", namespace], check=True)
        subprocess.run(["ip", "-n", namespace, "link", "set", "lo", "up"], check=True)
    made = Network(folder, router, namespace, ENDPOINT if own else free_endpoint())
    everybody = []
    try:
        made.drive()
        everybody = list(made.running.values())
        yield made
    finally:
        for process in {*everybody, *made.running.values()}:
            process.kill()
            process.wait()
        if namespace is not None:
            subprocess.run(["ip", "netns", "delete", namespace], check=True)


def isolates() -> bool:
    """Whether this host lets us make networks of our own."""
    name = f"probe-{os.getpid()}"
    if shutil.which("ip") is None or subprocess.run(["ip", "netns", "add", name], capture_output=True).returncode:
        return False
    return subprocess.run(["ip", "netns", "delete", name]).returncode == 0


def test_every_kind_of_process_ends_with_status_0_whatever_has_just_happened_to_its_links(
    tmp_path: Path, pytestconfig: pytest.Config, host: Host
) -> None:
    count: int = pytestconfig.getoption("--ends")
    rng = np.random.default_rng(1)
    befores = [before for before, (_, act) in BEFORE.items() if act is not cut or isolates()]
    endings: list[Ending] = []
    for n in range(10 * count):
        ended = [sum(ending.role == role for ending in endings) for role in LIVING if role != "viewer" or find_spec("rerun")]
        if min(ended) >= count:
            break
        before = befores[n % len(befores)]
        router, act = BEFORE[before]
        with network(tmp_path / str(n), router=router, own=act is cut) as made:
            act(made)
            # Links are lost in their own time, and ends meet every part of it.
            time.sleep(rng.choice([0.0, rng.uniform(0.0, 0.1), rng.uniform(0.0, 2.0)]))
            endings += made.end(before)
    print()
    for role in LIVING:
        times_s = [ending.took_s for ending in endings if ending.role == role]
        if times_s:
            print(f"{role:10} {len(times_s)} ends, from signal to end p50 {np.median(times_s):.2f}, max {max(times_s):.2f} s")
    bad = [ending for ending in endings if not ending.clean(host)]
    for ending in bad:
        print(f"{ending.role} after {ending.before!r}: status {ending.status}, {ending.took_s:.2f} s\n{ending.said[-2000:]}")
    assert not bad
