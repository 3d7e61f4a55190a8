# SPDX-License-Identifier: Apache-2.0
"""Test rig for a guard: robot and controller in one thread, in real time, connected with the guard by the bus alone."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, State
from rti_mpc.contract.schedule import Schedule
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.wire.actuator import Actuator
from rti_mpc.wire.bus import Bus
from rti_mpc.wire.cdr import decode
from rti_mpc.wire.session import BusSettings
from rti_mpc_service.config.build import build_signals, guard_limits
from rti_mpc_service.config.config import load
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.guarded import write_robot
from tests.in_time import in_time, on_time

ROOT = Path(__file__).parents[2]
MS = 1_000_000
BIRTH_NS = 60_000 * MS
PERIOD_NS = 100 * MS  # of states and commands
POLL_S = 1e-3
PATIENCE_S = 60.0  # to start a guard and hear of it

Pilot = Callable[[State], Command | None]


class Rig:
    """
    Drives one guard.

    Attributes:
        config: Configuration file given to the guard.
        lbu, ubu, step: Bounds of the inputs, and how far they may move in a period, from it.
        heard: What the guard published, with the robot's time of its arrival, in this life of the robot.
        times, inputs: When which input began to act at the actuators, in ns and its unit.
        latest_ns: What a command has at most taken from the controller through the guard to the robot, in this life.
        epoch: Of the robot.
        leader: Epoch of the controller.
    """

    def __init__(self, guard: list[str], folder: Path, host: Host) -> None:
        self._host = host
        self.config = write_robot(folder / "robot.toml")
        loaded = load(self.config)
        limits = guard_limits(loaded, build_signals(loaded))
        self.lbu, self.ubu, self.step = limits.lbu, limits.ubu, np.minimum(-limits.lbdu, limits.ubdu)
        self._slew, self._guard, self._folder = limits.slew, guard, folder
        self._endpoint = free_endpoint()
        self.bus = Bus.join(BusSettings(listen=(self._endpoint,), connect=()), loaded.keys())
        keys = self.bus.keys
        self._states = self.bus.publisher(keys.state)
        self._commands = self.bus.publisher(keys.command)
        self._actuation = self.bus.subscriber(keys.actuation, capacity=4096)
        self.epoch, self.leader, self.seq = 1000, 100, 0
        self.deaf = False  # whether the robot's states reach nobody
        self.new_robot()
        self.start()

    def start(self) -> None:
        """Start a guard."""
        with (self._folder / "guard.log").open("ab") as log:
            command = [*self._guard, str(self.config), "-e", self._endpoint]
            environment = {**os.environ, "PYTHONPATH": str(ROOT), "STATE_DIRECTORY": str(self._folder / "state")}
            self.process = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def close(self) -> None:
        self.kill()
        self.bus.close()

    @property
    def now_ns(self) -> int:
        """The robot's clock."""
        return time.monotonic_ns() - self._zero_ns

    def new_robot(self) -> None:
        """Begin another life of the robot, at its time `BIRTH_NS`."""
        self.epoch += 1
        self.leader += 10
        self._zero_ns = time.monotonic_ns() - BIRTH_NS
        self._played_ns = self._due_ns = BIRTH_NS
        self.state = State(self.epoch, 0, BIRTH_NS, np.zeros(5))
        self.actuator = Actuator(np.zeros(2), self._slew, self.epoch)
        self.heard: list[tuple[int, Command]] = []
        self._sent_ns: dict[int, int] = {}  # by number of the state
        self.latest_ns = 0
        self.times: list[int] = []
        self.inputs: list[Array] = []

    def ready(self) -> None:
        """Begin a life of the robot, and wait until the guard lets its commands pass."""
        self.new_robot()
        deadline_s = time.monotonic() + PATIENCE_S
        while not any(told.state_epoch == self.epoch for _, told in self.heard):
            assert self.process.poll() is None, (self._folder / "guard.log").read_text()
            assert time.monotonic() < deadline_s, "a guard must let healthy commands pass"
            self.run(100, lambda state: self.command(np.zeros(2)))
        self.run(300, lambda state: self.command(np.zeros(2)))

    def jump(self, ms: int) -> None:
        """Let the robot's clock jump; its actuators brake from what acts."""
        u = self.actuator.u.copy()
        self._zero_ns -= ms * MS
        self._played_ns = self._due_ns = self.now_ns
        self.actuator = Actuator(np.zeros(2), self._slew, self.epoch)
        self.actuator._schedule = Schedule(np.zeros(2), self._slew)
        self.actuator._schedule.brake(u, self._played_ns)

    def run(self, ms: int, pilot: Pilot = lambda _: None) -> None:
        """Let the robot live for a while; a pilot answers each state, or not."""
        until_ns = self.now_ns + ms * MS
        while self.now_ns < until_ns:
            if self.now_ns >= self._due_ns:
                self.state = State(self.epoch, self.state.seq + 1, self.now_ns, np.zeros(5))
                self._due_ns = max(self._due_ns + PERIOD_NS, self.now_ns)
                if not self.deaf:
                    self._states.put(self.state)
                if (command := pilot(self.state)) is not None:
                    self.send(command)
            self.listen()
            time.sleep(POLL_S)

    def listen(self) -> None:
        """Take what the guard has published, and play up to now."""
        for received in self._actuation.drain():
            now_ns = self.now_ns
            self._play(now_ns)
            told = decode(Command, received.payload)
            self.heard.append((now_ns, told))
            if told.mode is Mode.TRACKING:
                self.latest_ns = max(self.latest_ns, now_ns - self._sent_ns.get(told.state_seq, now_ns))
            self.actuator.accept(told, now_ns)
        self._play(self.now_ns)

    def _play(self, to_ns: int) -> None:
        for until_ns, u in self.actuator.play(self._played_ns, to_ns):
            self.times.append(self._played_ns)
            self.inputs.append(u.copy())
            self._played_ns = until_ns

    def command(self, u: Any, **change: Any) -> Command:
        """A command that answers the last state: an input held over twenty rows, or those rows."""
        self.seq += 1
        stamp_ns = self.state.stamp_ns
        rows = np.tile(u, (20, 1)) if np.ndim(u) == 1 else np.array(u)
        healthy = Command(
            epoch=self.leader,
            seq=self.seq,
            stamp_ns=stamp_ns,
            state_epoch=self.epoch,
            state_seq=self.state.seq,
            state_stamp_ns=stamp_ns,
            valid_until_ns=stamp_ns + 250 * MS,
            config_hash=0,
            mode=Mode.TRACKING,
            status=QpStatus.SOLVED,
            period_ns=PERIOD_NS,
            u=rows,
        )
        return replace(healthy, **change)

    def send(self, command: Command) -> None:
        self._sent_ns[command.state_seq] = self.now_ns
        self._commands.put(command)

    def towards(self, u: Array) -> Pilot:
        """A healthy controller: it approaches an input inside the slew limits."""
        target = np.array(u)

        def pilot(state: State) -> Command:
            rows = [self.actuator.u + np.clip(target - self.actuator.u, -self.step, self.step)]
            while len(rows) < 20:
                rows.append(rows[-1] + np.clip(target - rows[-1], -self.step, self.step))
            return self.command(rows)

        return pilot

    def drive(self) -> None:
        """Bring the robot to full inputs."""
        self.reach(self.ubu, self.towards(self.ubu))

    def reach(self, u: Array, pilot: Pilot) -> None:
        """Let a controller command until an input acts."""
        deadline_s = time.monotonic() + PATIENCE_S
        self.run(300, pilot)
        while not np.allclose(self.actuator.u, u):
            assert time.monotonic() < deadline_s, "a guard must let a healthy controller drive"
            self.run(100, pilot)

    def in_time(self, what: str, took_ms: float, limit_ms: float, since_ns: int) -> None:
        """Hold something that began at a time of the robot to its limit, as `tests.in_time` does."""
        in_time(self._host, what, took_ms, limit_ms, since_ns + self._zero_ns)

    def on_time(self, what: str, since_ns: int = BIRTH_NS) -> bool:
        """Whether the host has let everybody be on time since a time of the robot, as `tests.in_time` says."""
        return on_time(self._host, what, PERIOD_NS / MS, since_ns + self._zero_ns)

    def acting(self, from_ns: int) -> tuple[Array, Array]:
        """Times in ms after an instant, and the inputs that began to act then."""
        times = (np.array(self.times) - from_ns) / MS
        after = times >= 0.0
        return times[after], np.array(self.inputs)[after]
