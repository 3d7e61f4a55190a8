# SPDX-License-Identifier: Apache-2.0
"""Test stand of a guard: robot and controller in one thread, in real time, connected with the guard by the bus alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command, State
from rti_mpc.contract.schedule import Schedule
from rti_mpc.contract.status import Mode
from rti_mpc.wire.actuator import STALE_NS, Actuator
from rti_mpc.wire.bus import Bus
from rti_mpc_service.conformance.answer import answer
from rti_mpc_service.conformance.level import Levels

MS = 1_000_000
BIRTH_NS = 60_000 * MS
POLL_S = 1e-3
VALID_NS = 250 * MS  # of commands, after their state

Steering = Callable[[State], Command | None]


class Stand:
    """
    A robot that plays what a guard publishes, and its controller.

    Attributes:
        bus: Its bus.
        limits: Limits of the inputs.
        levels: Levels between which a case moves them.
        lbu, ubu, step: Bounds of the inputs, and how far they may move in a period.
        heard: What the guard published, with the robot's time of its arrival, in this life of the robot.
        numbers: Life of the robot, epoch and number of all that it published.
        times, inputs: When which input began to act at the actuators, in ns and its unit.
        latest_ns: What a command has at most taken from the controller through the guard to the robot, in this life.
        state: Last state of the robot.
        epoch: Of the robot.
        leader: Epoch of the controller.
        deaf: Whether the robot's states reach nobody.
    """

    def __init__(self, bus: Bus, limits: Limits, *, epoch: int = 1000, leader: int = 100) -> None:
        """
        Begin the first life of the robot.

        Args:
            bus: Its bus.
            limits: Limits of the inputs.
            epoch: Epoch below all of the robot's lives.
            leader: Epoch below all of the controllers.
        """
        self.bus, self.limits, self.levels = bus, limits, Levels.of(limits)
        self.lbu, self.ubu, self.step = limits.lbu, limits.ubu, self.levels.step
        self.period_ns = round(1e9 * limits.dt_s)
        keys = bus.keys
        self._states, self._commands = bus.publisher(keys.state), bus.publisher(keys.command)
        self._actuation, self._intake = bus.subscriber(keys.actuation, capacity=4096), bus.intake(Command, 1e-9 * STALE_NS)
        self.epoch, self.leader, self.seq = epoch, leader, 0
        self.numbers: list[tuple[int, int, int]] = []
        self.deaf = False
        self.new_robot()

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
        self.state = State(self.epoch, 0, BIRTH_NS, np.zeros(self.limits.rotations.size))
        self.actuator = self._standing()
        self.heard: list[tuple[int, Command]] = []
        self._sent_ns: dict[int, int] = {}  # by number of the state
        self.latest_ns = 0
        self.times: list[int] = []
        self.inputs: list[Array] = []

    def jump(self, ms: int) -> None:
        """Let the robot's clock jump; its actuators brake from what acts."""
        u = self.actuator.u.copy()
        self._zero_ns -= ms * MS
        self._played_ns = self._due_ns = self.now_ns
        self.actuator = self._standing()
        self.actuator._schedule = Schedule(self.limits.u_rest, self.limits.slew)
        self.actuator._schedule.brake(u, self._played_ns)

    def run(self, ms: float, pilot: Steering = lambda _: None) -> None:
        """Let the robot live for a while; a pilot answers each state, or not."""
        until_ns = self.now_ns + round(ms * MS)
        while self.now_ns < until_ns:
            if self.now_ns >= self._due_ns:
                self.state = State(self.epoch, self.state.seq + 1, self.now_ns, np.zeros(self.limits.rotations.size))
                self._due_ns = max(self._due_ns + self.period_ns, self.now_ns)
                self.actuator.measure(self.state.x, self.now_ns)
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
            if (told := self._intake.read(received)) is None:
                continue
            self.heard.append((now_ns, told))
            self.numbers.append((told.state_epoch, told.epoch, told.seq))
            if told.mode is Mode.TRACKING:
                self.latest_ns = max(self.latest_ns, now_ns - self._sent_ns.get(told.state_seq, now_ns))
            self.actuator.accept(told, now_ns)
        self._play(self.now_ns)

    def command(self, u: Any, **change: Any) -> Command:
        """A command that answers the last state: an input held over twenty rows, or those rows."""
        self.seq += 1
        rows = np.tile(u, (20, 1)) if np.ndim(u) == 1 else np.array(u)
        healthy = answer(self.state, rows, epoch=self.leader, seq=self.seq, period_ns=self.period_ns, valid_ns=VALID_NS)
        return replace(healthy, **{"state_epoch": self.epoch, **change})

    def send(self, command: Command | bytes) -> None:
        """Send a command of the controller, or bytes that are none."""
        if isinstance(command, bytes):
            self._commands.put_bytes(command)
        else:
            self._sent_ns[command.state_seq] = self.now_ns
            self._commands.put(command)

    def towards(self, u: Any, **change: Any) -> Steering:
        """A healthy controller: it approaches an input inside the slew limits."""
        target = np.array(u)
        return lambda _: self.command(self.levels.towards(self.actuator.u, target), **change)

    def acting(self, from_ns: int) -> tuple[Array, Array]:
        """Times in ms after an instant, and the inputs that began to act then."""
        times = (np.array(self.times) - from_ns) / MS
        after = times >= 0.0
        return times[after], np.array(self.inputs)[after]

    def _standing(self) -> Actuator:
        """Return actuators at rest, which approach nothing: what the guard sends is what acts."""
        return Actuator(self.limits.u_rest, self.limits.slew, self.epoch, rotations=self.limits.rotations)

    def _play(self, to_ns: int) -> None:
        for until_ns, u in self.actuator.play(self._played_ns, to_ns):
            self.times.append(self._played_ns)
            self.inputs.append(u.copy())
            self._played_ns = until_ns
