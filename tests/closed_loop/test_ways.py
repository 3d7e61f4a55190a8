# SPDX-License-Identifier: Apache-2.0
"""Commands that carry ways to rest, on links that lose, delay, repeat and reorder: no input leaves its bounds or its slew limits."""

from __future__ import annotations

import heapq
import os
from collections import Counter, deque
from itertools import count
from typing import Any

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.approach import Increments
from rti_mpc.contract.guard import Guard
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command, State
from rti_mpc.rotation import Rotations
from rti_mpc.wire.actuator import Actuator
from rti_mpc.wire.cdr import decode, encode
from rti_mpc_service.conformance.answer import answer

MS = 1_000_000
DT = 100 * MS
BOUND, STEP = np.array([0.5, 0.745]), np.array([0.25, 0.4])  # the latter over 100 ms
WINDOW_NS = 75 * MS
ROUNDING = 1e-9
LIMITS = Limits(np.zeros(2), -BOUND, BOUND, -STEP, STEP, dt_s=0.1, rotations=Rotations(3, (1,)))
TICK_NS = 10 * MS  # of the guard
LONG = 20_000 if "CI" in os.environ else 500_000


class Ways:
    """
    One long life of a robot, with or without a guard, and of a controller that commands whatever it likes, inside its own limits.

    Attributes:
        samples: States sent so far.
        seen: What happened, by name.
    """

    def __init__(self, seed: int, *, guarded: bool) -> None:
        self.rng = np.random.default_rng(seed)
        self.guarded = guarded
        self.samples = self.seq = self.now_ns = 0
        self.seen: Counter[str] = Counter()
        self.x = np.zeros(3)
        self._offset_ns = 10**15
        self._links: list[tuple[int, int, str, Any]] = []
        self._numbers = count()
        self._guard = Guard(LIMITS, epoch=1 << 40)
        self._played: deque[tuple[int, Array]] = deque()
        self._actuator = Actuator(np.zeros(2), LIMITS.slew, 1, 0, (-BOUND, BOUND), Increments(-STEP, STEP, DT), LIMITS.rotations)
        self._ticked_ns = 0

    def run(self, samples: int) -> None:
        """Go on until so many states were sent."""
        while self.samples < samples:
            self.step()

    def step(self) -> None:
        """Let one period pass: a state, and as a rule a command."""
        rng = self.rng
        self._play(self.now_ns + int(rng.integers(95, 106)) * MS)
        self.samples += 1
        self.x = 0.9 * self.x + rng.normal(size=3)
        u = self._actuator
        state = State(1, self.samples, self.now_ns, self.x + 2 * np.pi * rng.integers(-2, 3) * np.array([0.0, 1.0, 0.0]), u.u.copy(), *u.source)
        if rng.random() < 0.9:
            u.measure(state.x, self.now_ns)
        self._send("guard", state)
        if rng.random() < (0.5 if self.samples // 20 % 2 else 0.97):  # it falls silent, too
            self._send("guard" if self.guarded else "robot", self._command(state))
        if rng.random() < 0.01:
            self._jump(int(rng.integers(-3000, 3000)) * MS)
        if rng.random() < 0.01:
            self._guard.latch("fuzzed", self._local_ns)
        elif rng.random() < 0.02:
            self._guard.enable()
        self.seen.update(notice.code for notice in self._guard.notices)
        self._guard.notices.clear()

    @property
    def _local_ns(self) -> int:
        return self._offset_ns + self.now_ns

    def _command(self, state: State) -> Command:
        """Rows near what acts, and a way to rest with or without feedback; by chance it goes nowhere near rest."""
        rng, self.seq = self.rng, self.seq + 1
        stamp_ns = state.stamp_ns + int(rng.integers(0, 150)) * MS
        u = self._walk(self._actuator.u + rng.uniform(-1.2, 1.2) * STEP, int(rng.integers(1, 6)), 1.0)
        valid_until_ns = stamp_ns + int(rng.integers(1, 350)) * MS
        command = answer(state, u, epoch=100, seq=self.seq, period_ns=DT, valid_ns=valid_until_ns - state.stamp_ns)
        command.stamp_ns = stamp_ns
        if rng.random() < 0.8:
            command.rest_period_ns = int(rng.choice([10, 37, 100, 130])) * MS
            rows = int(rng.integers(1, 40))
            last = u[min(len(u), -(-(command.valid_until_ns - stamp_ns) // DT)) - 1]
            share = min(1.0, command.rest_period_ns / DT)
            command.u_rest = self._walk(last + rng.uniform(-1.0, 1.0) * share * STEP, rows, share)
            if rng.random() < 0.6:
                command.x_rest, command.K = rng.normal(size=(rows, 3)), rng.normal(size=(2, 3)) * rng.choice([0.01, 0.3, 10.0])
        return decode(Command, encode(command))

    def _walk(self, first: Array, rows: int, share: float) -> Array:
        """Rows that follow each other inside bounds and slew limits."""
        walk = [np.clip(first, -BOUND, BOUND)]
        for _ in range(rows - 1):
            walk.append(np.clip(walk[-1] + self.rng.choice([-1.0, 0.0, 1.0, 0.3], 2) * share * STEP, -BOUND, BOUND))
        return np.array(walk)

    def _send(self, to: str, message: Any) -> None:
        rng = self.rng
        if rng.random() < 0.1:
            self.seen[f"lost to {to}"] += 1
            return
        for _ in range(1 + (rng.random() < 0.05)):
            late_ns = int(rng.integers(0, 400)) * MS if rng.random() < 0.1 else int(rng.integers(0, 10)) * MS
            heapq.heappush(self._links, (self.now_ns + late_ns, next(self._numbers), to, message))

    def _play(self, to_ns: int) -> None:
        while True:
            tick_ns = self._ticked_ns + TICK_NS
            event_ns = self._links[0][0] if self._links else to_ns + 1
            if min(tick_ns, event_ns) > to_ns:
                break
            self._advance(max(min(tick_ns, event_ns), self.now_ns))
            if tick_ns <= event_ns:
                self._ticked_ns = tick_ns
                self._told(self._guard.tick(self._local_ns))
            else:
                self._arrive(*heapq.heappop(self._links)[2:])
        self._advance(to_ns)

    def _arrive(self, to: str, message: Any) -> None:
        if to == "robot":
            self.seen[self._actuator.accept(message, self.now_ns) or "accepted"] += 1
        elif isinstance(message, State):
            self._guard.receive_state(message, self._local_ns)
        else:
            self._told(self._guard.receive_command(message, self._local_ns))

    def _told(self, told: Command | None) -> None:
        if told is not None and self.guarded:
            self._send("robot", decode(Command, encode(told)))

    def _advance(self, to_ns: int) -> None:
        """Let the inputs act until a time, and check each."""
        played = self._played
        for until_ns, u in self._actuator.play(self.now_ns, to_ns):
            assert until_ns > self.now_ns
            assert (np.abs(u) <= BOUND + ROUNDING).all(), (self.samples, u)
            while played and played[0][0] <= self.now_ns - WINDOW_NS:
                played.popleft()
            for _, before in played:
                assert (np.abs(u - before) <= STEP + ROUNDING).all(), (self.samples, self.now_ns, u, before)
            self.seen["on its way"] += self._actuator.braking and not self._actuator.at_rest
            self.seen["at rest"] += self._actuator.at_rest
            played.append((until_ns, u.copy()))
            self.now_ns = until_ns

    def _jump(self, by_ns: int) -> None:
        """Let the robot's clock jump: it goes its way to rest from what acts."""
        before_ns, local_ns = self.now_ns, self._local_ns
        self.now_ns = max(0, before_ns + by_ns)
        self._offset_ns = local_ns - self.now_ns
        self._actuator._schedule.cut(before_ns, self.now_ns)
        shift_ns = self.now_ns - before_ns
        self._played = deque((until_ns + shift_ns, u) for until_ns, u in self._played)
        self._links.clear()
        self._ticked_ns = self.now_ns
        self.seen["jump"] += 1


HAPPENED = {"accepted", "lost to robot", "on its way", "at rest", "jump"}


@pytest.mark.parametrize("guarded", [False, True], ids=["no guard", "guard"])
def test_no_input_leaves_its_limits_on_any_way_to_rest(guarded: bool) -> None:
    ways = Ways(seed=1, guarded=guarded)
    ways.run(300)
    assert set(ways.seen) >= HAPPENED
    assert not guarded or {"guard_passing", "guard_braking", "stop", "command_stopped"} <= set(ways.seen)


@pytest.mark.slow
@pytest.mark.parametrize("guarded", [False, True], ids=["no guard", "guard"])
@pytest.mark.parametrize("seed", [2, 3])
def test_no_input_of_half_a_million_samples_leaves_its_limits_on_any_way_to_rest(seed: int, guarded: bool) -> None:
    ways = Ways(seed, guarded=guarded)
    ways.run(int(os.environ.get("FUZZ_SAMPLES", LONG)))
    print(f"\n{ways.samples} samples: {dict(ways.seen)}")
