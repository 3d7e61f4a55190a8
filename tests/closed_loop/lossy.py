# SPDX-License-Identifier: Apache-2.0
"""
The same life as in `tests.closed_loop.fuzz`, where every link loses, delays, repeats and reorders.

The links are robot to controller, to standby and to guard, controller to guard and
standby, and whoever commands to the robot, which approaches by itself and may report
what acts. Leaders change. Nothing is left out of the check: no two inputs within
three quarters of a period differ by more than a slew limit, whatever has happened.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from itertools import count
from typing import Any

import numpy as np

from rti_mpc.contract.approach import Increments
from rti_mpc.contract.guard import Guard
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command, State
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.actuator import Actuator
from rti_mpc.wire.cdr import decode, encode
from rti_mpc.wire.received import Received
from tests.closed_loop.fuzz import BOUND, DT, MS, ROUNDING, STEP, Fuzz
from tests.problems import pioneer

TICK_NS = 20 * MS  # of the guard
LIMITS = Limits(np.zeros(2), -BOUND, BOUND, -STEP, STEP, dt_s=0.1)


class Lossy(Fuzz):
    """A long random run of all processes, on links that lose messages."""

    def __init__(self, seed: int, *, guarded: bool, reports: bool = True) -> None:
        self._guarded, self._reports = guarded, reports
        self._events: list[tuple[int, int, str, Any]] = []  # messages on their way, by when they arrive
        self._numbers = count()
        self._bad: dict[str, bool] = {}  # links, and whether they lose nearly everything now
        self._guard = Guard(LIMITS, epoch=1 << 40)
        self._ticked_ns = 0
        super().__init__(seed)
        self._standby = Controller(Rti(pioneer(N=6, N_u=4)), Timing(), epoch=8)
        self._standby.stand_by()

    def _begin(self, now_ns: int) -> None:
        super()._begin(now_ns)
        self._actuator = Actuator(np.zeros(2), STEP / 0.1, self._epoch, increments=Increments(-STEP, STEP, DT))
        self._events.clear()
        self._ticked_ns = now_ns

    def _link(self, to: str, message: Any, sent_ns: int) -> None:
        """Send a message: it may be lost, late, repeated, and overtaken."""
        rng = self.rng
        bad = self._bad[to] = bool(rng.random() < (0.9 if self._bad.get(to) else 0.02))
        if rng.random() < (0.95 if bad else 0.03):
            self.seen[f"lost to {to}"] += 1
            return
        for _ in range(1 + (rng.random() < 0.03)):
            late_ns = int(rng.integers(0, 500)) * MS if rng.random() < 0.04 else self._latency_ns()
            heapq.heappush(self._events, (sent_ns + late_ns, next(self._numbers), to, message))

    def _play(self, to_ns: int) -> None:
        while True:
            tick_ns = self._ticked_ns + TICK_NS if self._guarded else to_ns + 1
            event_ns = self._events[0][0] if self._events else to_ns + 1
            if min(tick_ns, event_ns) > to_ns:
                break
            if tick_ns <= event_ns:
                self._advance(max(tick_ns, self._now_ns))
                self._ticked_ns = tick_ns
                self._tell(self._guard.tick(self.local_ns(self._now_ns)))
            else:
                _, _, to, message = heapq.heappop(self._events)
                self._advance(max(event_ns, self._now_ns))
                getattr(self, f"_at_{to}")(message)
        self._advance(to_ns)

    def _tell(self, told: Command | None) -> None:
        if told is not None:
            self._link("robot", told, self._now_ns)

    def _at_robot(self, command: Command) -> None:
        self.seen[self._actuator.accept(command, self._now_ns) or "accepted"] += 1

    def _at_guard(self, message: Command | State) -> None:
        local_ns = self.local_ns(self._now_ns)
        if isinstance(message, Command):
            self._tell(self._guard.receive_command(message, local_ns))
        else:
            self._guard.receive_state(message, local_ns)

    def _at_standby(self, message: Command | State) -> None:
        standby = self._standby
        if isinstance(message, Command):
            standby.overhear(message)
        elif (command := standby.receive_state(message, local_ns := self.local_ns(self._now_ns))) is not None:
            if (command := standby.in_time(command, local_ns + MS)) is not None:
                standby.commit(command, local_ns + MS)
            standby.prepare()
        standby.notices()

    def _bounding(self) -> Iterator[tuple[int, float, float, float]]:
        for end_ns, u, omega, _ in self._played:
            yield end_ns, u, omega, 1.0 + ROUNDING

    def _state(self, stamp_ns: int) -> State:
        state = super()._state(stamp_ns)
        if self._reports:
            actuator = self._actuator
            state.u, (state.command_epoch, state.command_seq) = actuator.u.copy(), actuator.source
        for to in ("guard",) * self._guarded + ("standby",):
            self._link(to, state, self._now_ns)
        return state

    def _receive(self, received: Received, arrival_ns: int) -> None:
        if self.rng.random() < 0.03:
            self._waiting = None
            self.seen["lost to controller"] += 1
            return
        super()._receive(received, arrival_ns)

    def _publish(self, command: Command | None, arrival_ns: int) -> None:
        super()._publish(command, arrival_ns)
        while self._queue:
            _, sent = self._queue.popleft()
            self._link("guard" if self._guarded else "robot", sent, arrival_ns)
            self._link("standby", decode(Command, encode(sent)), arrival_ns)

    def _operate(self) -> None:
        super()._operate()
        self._guard.notices.clear()
        if self.rng.random() < 0.003:
            self.controller, self._standby = self._standby, self.controller
            self._standby.stand_by()
            epoch = self._standby._issued.epoch + 1
            self.controller.lead(epoch)
            self._command_seq = self.controller._issued.seq
            self.seen["takeover"] += 1

    def _jump(self, by_ns: int) -> None:
        """Let the robot's clock jump: it brakes from what acts, and no input jumps."""
        before_ns, actuator, played = self._now_ns, self._actuator, list(self._played)
        super()._jump(by_ns)
        self._actuator = actuator
        actuator._schedule.cut(before_ns, self._now_ns)
        shift_ns = self._now_ns - before_ns
        self._played.extend((end_ns + shift_ns, *rest) for end_ns, *rest in played)  # type: ignore[misc]
