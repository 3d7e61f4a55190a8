# SPDX-License-Identifier: Apache-2.0
"""Robot, guard and controller without clock and network, in steps of 10 ms of the robot."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.guard import Guard
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command, State
from rti_mpc.wire.actuator import Actuator
from rti_mpc_service.conformance.answer import answer

MS = 1_000_000
LOCAL_NS = 10**15  # local time when the robot's clock is 0
BOUND, STEP = np.array([0.5, 0.745]), np.array([0.25, 0.4])  # of the shipped configuration, the latter over 100 ms
LIMITS = Limits(np.zeros(2), -BOUND, BOUND, -STEP, STEP, dt_s=0.1)
FULL = np.array([0.5, 0.3])


class Scene:
    """A robot, its guard and a controller that can be told what to command."""

    def __init__(self, rate: float = 1.0, limits: Limits = LIMITS) -> None:
        self.rate = rate
        self.limits = limits
        self.now_ns = 0  # the robot's clock
        self.local_ns = LOCAL_NS
        self.epoch = 7
        self.seq = 0
        self.states = 0  # sent
        self.leader = 100
        self.state: State | None = None
        self.published: list[Command] = []
        self.times_ms: list[float] = []
        self.inputs: list[Array] = []
        self.refused = 0  # by the robot's own watchdog
        self.heard = True  # whether states reach the guard
        self.power_up()

    def power_up(self) -> None:
        """Start a guard."""
        self.guard = Guard(self.limits, epoch=10 if not self.published else self.published[-1].epoch + 10)
        self.actuator = getattr(self, "actuator", None) or Actuator(np.zeros(2), LIMITS.slew, self.epoch)

    def publish(self, told: Command | None) -> Command | None:
        if told is not None:
            self.refused += self.actuator.accept(told, self.now_ns) != ""
            self.published.append(told)
        return told

    def step(self) -> None:
        """Let 10 ms pass: in the end a state, if it is time, and a tick."""
        for until_ns, u in self.actuator.play(self.now_ns, self.now_ns + 10 * MS):
            self.times_ms.append(self.now_ns / MS)
            self.inputs.append(u.copy())
            self.now_ns = until_ns
        self.local_ns += round(10 * MS / self.rate)
        if self.now_ns % (100 * MS) == 0:
            self.states += 1
            self.state = State(self.epoch, self.states, self.now_ns, np.zeros(5))
            if self.heard:
                self.guard.receive_state(self.state, self.local_ns)
        self.publish(self.guard.tick(self.local_ns))

    def wait(self, ms: int) -> None:
        for _ in range(ms // 10):
            self.step()

    def restart(self) -> None:
        """Stop the robot for a second, restart it, and wait until the new epoch is accepted."""
        self.heard = False
        self.wait(1000)
        self.epoch += 1
        self.actuator = Actuator(np.zeros(2), LIMITS.slew, self.epoch)
        self.heard = True
        self.wait(500)
        self.refused = 0  # told to the life before, until this one was sure

    def command(self, u: Any = FULL, **change: Any) -> Command:
        """A command that answers the last state; constant rows, or those given."""
        assert self.state is not None
        self.seq += 1
        rows = np.tile(u, (20, 1)) if np.ndim(u) == 1 else np.array(u)
        healthy = answer(self.state, rows, epoch=self.leader, seq=self.seq, period_ns=100 * MS, valid_ns=250 * MS)
        return replace(healthy, **{"config_hash": 5, **change})

    def send(self, u: Any = FULL, **change: Any) -> Command | None:
        return self.publish(self.guard.receive_command(self.command(u, **change), self.local_ns))

    def drive(self, ms: int, u: Array = FULL) -> None:
        """Command an input, approached inside the slew limits, at every state; end with a state that is not answered."""
        for _ in range(ms // 100):
            rows = [self.actuator.u + np.clip(u - self.actuator.u, -STEP, STEP)]
            while len(rows) < 20:
                rows.append(rows[-1] + np.clip(u - rows[-1], -STEP, STEP))
            assert self.send(rows) is not None
            self.wait(100)

    def ready(self) -> Scene:
        """Wait until the guard lets commands pass."""
        self.wait(1000)
        return self

    def said(self) -> list[str]:
        codes = [notice.code for notice in self.guard.notices]
        self.guard.notices.clear()
        return codes

    def trace(self) -> tuple[Array, Array]:
        """Times in ms, and the inputs that acted from then on."""
        return np.array(self.times_ms), np.array(self.inputs)
