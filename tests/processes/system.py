# SPDX-License-Identifier: Apache-2.0
"""A robot, its controller and a reference as the processes a user runs, and what tests need to watch them."""

from __future__ import annotations

import atexit
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.message import Command, Event, State, Telemetry
from rti_mpc.wire.bus import Bus, BusSettings, Subscriber
from rti_mpc.wire.cdr import M, decode
from rti_mpc_service.certs.folder import secured
from rti_mpc_service.config.config import load
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.shipped import SHIPPED
from tests.in_time import ends_in_time

ROOT = Path(__file__).parents[2]
CONFIG = load(SHIPPED)
KEYS = CONFIG.keys()
PATIENCE_S = 120.0  # to start processes and hear of them on a host that is busy; the first controller on a machine compiles
ANSWERED = ("--timeout", PATIENCE_S)  # of a request whose answer, not its time, is tested: whoever answers may be held up for seconds
SPEED = 4.0
MAX_SAID = 2000  # characters of a log that a failure shows
STATE = Path(tempfile.mkdtemp(prefix="rti-mpc-state-"))  # of commands that belong to no system; never the user's own
ARGUMENTS: dict[str, tuple[object, ...]] = {
    "robot": ("sim", "--speed", SPEED, "--x0", "x=0.5"),
    "controller": ("run",),
    "reference": ("reference", "--scenario", "eight", "--duration", 600),
    "guard": ("guard",),
}
T = TypeVar("T")
atexit.register(shutil.rmtree, STATE, ignore_errors=True)


def command_line(*arguments: object) -> list[str]:
    return [sys.executable, "-c", "from rti_mpc_service.cli import main; main()", *map(str, arguments)]


def rti_mpc(*arguments: object, timeout_s: float = 120.0) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(command_line(*arguments), cwd=ROOT, env=environment(), capture_output=True, text=True, timeout=timeout_s)


def environment(state: Path = STATE) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONFAULTHANDLER": "1", "STATE_DIRECTORY": str(state)}


class System:
    """The processes of one robot, and one that listens to them: peers, or clients of a router with TLS, which runs, by the bundle of a host."""

    def __init__(self, folder: Path, config: Path = SHIPPED, tls: Path | None = None, **arguments: tuple[object, ...]) -> None:
        self.folder = folder
        self.config = config
        self.keys = load(config).keys()
        self.arguments = ARGUMENTS | arguments
        self.endpoint = free_endpoint()
        self.meeting: tuple[object, ...] = ("-e", self.endpoint) if tls is None else ("--tls", tls)
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.lives: set[str] = set()
        self.fault_at_ns = 0  # when the last fault began, by the monotonic clock
        self._stack = ExitStack()
        settings = BusSettings(connect=(self.endpoint,)) if tls is None else secured(BusSettings(), tls, "view")
        self.bus = self._stack.enter_context(Bus.join(settings, self.keys))
        self.bus.watch_alive(lambda role, present: (self.lives.add if present else self.lives.discard)(role))

    def __enter__(self) -> System:
        return self

    def __exit__(self, *_: object) -> None:
        for name in list(self.running):
            self.kill(name)
        self._stack.close()

    def start(self, *roles: str) -> None:
        for role in roles:
            command, *options = self.arguments[role]
            if role == "robot":
                (self.folder / "robot.csv").unlink(missing_ok=True)  # of its last life
                options += ["--log", self.folder / "robot.csv"]
            with (self.folder / f"{role}.log").open("ab") as log:
                arguments, state = command_line(command, self.config, *self.meeting, *options), self.folder / "state"
                self.running[role] = subprocess.Popen(arguments, cwd=ROOT, env=environment(state), stdout=log, stderr=subprocess.STDOUT)

    def kill(self, role: str) -> None:
        """End a process without notice, as a crash does."""
        process = self.running.pop(role)
        process.kill()
        process.wait()

    def fault(self, number: signal.Signals, *roles: str) -> int:
        """Send a signal; return the robot's time at it, at real speed within a few ms."""
        self.fault_at_ns = time.monotonic_ns()
        now_ns = self.state(lambda _: True).stamp_ns
        for role in roles:
            self.running[role].send_signal(number)
        return now_ns

    def interrupt(self, role: str, limit_ms: float = 1e3 * PATIENCE_S, asked: Sequence[str] = ()) -> int:
        """Press Ctrl-C, hold the process to a time for its end, in which it may ask others, and return its exit status."""
        process = self.running.pop(role)
        until(lambda: handles(process.pid, signal.SIGTERM) or process.poll() is not None, f"{role} handles signals")
        self.fault_at_ns = time.monotonic_ns()
        process.send_signal(signal.SIGINT)
        try:
            return ends_in_time(process, f"the end of the {role}", limit_ms, PATIENCE_S, [self.running[other] for other in asked])
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGABRT)  # where every thread is, to its log
            process.wait(PATIENCE_S)
            raise AssertionError(f"{role} does not end:\n{self.said(role)}") from None
        finally:
            process.kill()

    def opened(self, role: str) -> None:
        """Wait until a process has joined the bus, even without other processes."""
        until(lambda: listening(self.running[role].pid), f"{role} listens")

    def said(self, role: str) -> str:
        return (self.folder / f"{role}.log").read_text()

    def tracking(self, epoch: int = 0) -> Command:
        """Wait for a command that follows the reference, for a robot of this epoch or a later one."""
        commands = self.bus.subscriber(self.keys.command)
        return heard(commands, Command, lambda command: command.mode.name == "TRACKING" and command.state_epoch >= epoch)

    def sample(self) -> Telemetry:
        return heard(self.bus.subscriber(self.keys.telemetry), Telemetry, lambda _: True)

    def event(self, code: str, source: str, act: Callable[[], object] = lambda: None) -> Event:
        """Repeat an action until an event follows it."""
        events = self.bus.subscriber(self.keys.event(source), capacity=64, history=False)

        def look() -> Event | None:
            act()
            return next((event for event in (decode(Event, r.payload) for r in events.drain()) if event.code == code), None)

        return until(look, f"{source} says {code}", pause_s=0.05)

    def state(self, condition: Callable[[State], bool]) -> State:
        try:
            return heard(self.bus.subscriber(self.keys.state), State, condition)
        except AssertionError as error:
            said = "\n".join(f"{role}: {self.said(role)[-MAX_SAID:]}" for role in self.running)
            raise AssertionError(f"{error}\n{said}") from None


def begun_ns(logs: Path) -> int:
    """Return when the drive of a demo began, by the monotonic clock: all its processes were there when the reference was anchored to the robot."""
    lines = map(json.loads, (logs / "reference.log").read_text().splitlines())
    began = next(line["time"] for line in lines if "s of the robot on" in line["text"])
    return time.monotonic_ns() - round(1e9 * (datetime.now(UTC) - datetime.fromisoformat(began)).total_seconds())


def owner(log: str) -> int:
    """Return the digits that end all epochs of a controller, from its log: ``epoch 123 controls``, ``123 stands by``."""
    texts = (json.loads(line)["text"] for line in log.splitlines())
    found = next(match for text in texts if (match := re.match(r"(?:epoch )?(\d+) (?:controls|stands by)", text)))
    return int(found[1]) % (1 << NUMBER_BITS)


def heard(subscriber: Subscriber, cls: type[M], condition: Callable[[M], bool]) -> M:
    """Wait for a message."""

    def look() -> M | None:
        for received in subscriber.drain():
            message = decode(cls, received.payload)
            if condition(message):
                return message
        return None

    return until(look, f"a {cls.__name__} as wanted")


def until(look: Callable[[], T | None], what: str, pause_s: float = 0.002, patience_s: float = PATIENCE_S) -> T:
    """Return the first value that is neither None nor False."""
    deadline_s = time.monotonic() + patience_s
    while time.monotonic() < deadline_s:
        if (value := look()) is not None and value is not False:
            return value
        time.sleep(pause_s)
    raise AssertionError(f"waited {patience_s} s in vain: {what}")


def handles(pid: int, number: signal.Signals) -> bool:
    """
    Whether a process handles a signal, one that Python leaves alone.

    Whoever starts tests in the background has them ignore Ctrl-C, and a process that
    does not handle it yet then loses it.
    """
    with suppress(FileNotFoundError):  # it has ended
        status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
        return bool(int(status["SigCgt"], 16) >> (number - 1) & 1)
    return False


def listening(pid: int) -> bool:
    """Whether a process listens on a TCP port."""
    sockets = set()
    for path in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # closed since it was listed
            sockets.add(os.readlink(path))
    lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return any(line[3] == "0A" and f"socket:[{line[9]}]" in sockets for line in lines)
