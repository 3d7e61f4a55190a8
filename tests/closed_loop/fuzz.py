# SPDX-License-Identifier: Apache-2.0
"""
Fuzzer of a controller: robot, planner, operator, network and two clocks behave at random.

The controller may rely on this: messages are not lost on their way and take at most
`LATENCY_NS`; what takes longer does so inside the controller, which sees it. Everything
else may happen.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Command, End, Reference, State
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.wire.actuator import Actuator
from rti_mpc.wire.cdr import decode, encode, encoding
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.received import Received
from rti_mpc_service.injection import FAILURES, FaultyRti
from tests.problems import pioneer

MS = 1_000_000
DT = 100 * MS
STEP = np.array([0.25, 0.4])  # slew limit per dt
BOUND = np.array([0.5, 0.745])
ROUNDING = 1e-9
WINDOW_NS = 75 * MS  # in which inputs change by no more than the slew limits: a period, less what messages may be late
LATENCY_NS = 10 * MS
# One is a matter of clocks, here; the other is no failure to the controller.
FAULTS = tuple(failure for failure in FAILURES if failure not in ("over_budget", "gradient"))


class Fuzz:
    """
    One long life of everything.

    Attributes:
        samples: States sent so far.
        seen: What happened, by name: that it did is part of the test.
    """

    def __init__(self, seed: int, *, measured: bool = False) -> None:
        self.rng = np.random.default_rng(seed)
        self.rti = FaultyRti(pioneer(N=6, N_u=4))
        self.controller = Controller(self.rti, Timing(delay_s=None if measured else 0.0), epoch=7)
        self.samples = 0
        self.seen: Counter[str] = Counter()
        self._states = Intake(State, 1.0, {"x": 5})
        self._references = Intake(Reference, 60.0, {"y": 3, "p": self.controller.np_})
        self._seq = 0
        self._command_seq = 0
        self._epoch = 1
        self._rate = 1.0  # robot seconds per local second
        self._offset_ns = 10**15  # of the local clock
        self._queue: deque[tuple[int, Command]] = deque()  # commands on their way, by when they arrive
        self._x: Array = np.zeros(5)
        self._begin(0)

    def _begin(self, now_ns: int) -> None:
        """Begin a life of the robot."""
        self._now_ns = now_ns
        self._offset_ns += 10**15
        self._origin_ns = now_ns
        self._actuator = Actuator(np.zeros(2), STEP / 0.1, self._epoch)
        self._played: deque[tuple[int, float, float, bool]] = deque()  # until when, what, and whether the robot braked on its own
        self._queue.clear()
        self._waiting: Received | None = None  # the newest state that the controller has not had time for
        self._busy_ns = now_ns  # until when it has none
        self._settled_ns = 0  # until when after a jump nobody but the robot, and a guard beside it, knows what acts
        self._ordered_ns = 0  # until when no state overtakes another

    def local_ns(self, t_ns: int) -> int:
        """Local time at a robot time."""
        return self._offset_ns + round((t_ns - self._origin_ns) / self._rate)

    def _latency_ns(self) -> int:
        return min(round(self.rng.exponential(2 * MS)), LATENCY_NS)

    # What the robot plays.

    def _play(self, to_ns: int) -> None:
        """Advance the robot to a time, and check every input that acts."""
        while self._queue and self._queue[0][0] <= to_ns:
            arrival_ns, command = self._queue.popleft()
            self._advance(max(arrival_ns, self._now_ns))
            self.seen[self._actuator.accept(command, self._now_ns) or "accepted"] += 1
        self._advance(to_ns)

    def _advance(self, to_ns: int) -> None:
        played = self._played
        for until_ns, u in self._actuator.play(self._now_ns, to_ns):
            u_c, omega_c = u.tolist()
            assert abs(u_c) <= 0.5 + ROUNDING, (self.samples, u_c)
            assert abs(omega_c) <= 0.745 + ROUNDING, (self.samples, omega_c)
            if not (played and played[-1][1:3] == (u_c, omega_c)):
                while played and played[0][0] <= self._now_ns - WINDOW_NS:
                    played.popleft()
                for end_ns, u_before, omega_before, most in self._bounding():
                    assert abs(u_c - u_before) <= 0.25 * most, (self.samples, self._now_ns, end_ns, u_c, u_before)
                    assert abs(omega_c - omega_before) <= 0.4 * most, (self.samples, self._now_ns, end_ns, omega_c, omega_before)
                played.append((until_ns, u_c, omega_c, self._actuator.braking))
            else:
                played[-1] = (until_ns, *played[-1][1:])
            self._now_ns = until_ns

    def _bounding(self) -> Iterator[tuple[int, float, float, float]]:
        """Yield until when what acted that bounds what acts now, and the share of the slew limits by which it does."""
        if self._now_ns > self._settled_ns:
            # Braking is the robot's own: in steps, and from a row that may just have begun to act.
            for end_ns, u, omega, braked in list(self._played)[-1:] if self._actuator.braking else self._played:
                yield end_ns, u, omega, 1.1 + ROUNDING if braked else 1.0 + ROUNDING

    # One sample.

    def run(self, samples: int) -> None:
        """Go on until so many states were sent."""
        while self.samples < samples:
            self.step()

    def step(self) -> None:
        """Let one period pass, with random events in it."""
        rng, r = self.rng, self.rng.random()
        if r < 0.001:
            self._restart()
        elif r < 0.002:
            self._jump(int(rng.choice([-3000, -600, 600, 3000])) * MS)
        elif r < 0.01:
            self._silence(int(rng.integers(100, 1500)) * MS)
        elif r < 0.015:
            self._stall(int(rng.integers(300, 2500)) * MS)
        period_ns = DT if rng.random() < 0.5 else round(DT * rng.uniform(0.9, 1.1))
        if rng.random() < 0.02:
            self._plan()
        self._operate()
        self._send(self._now_ns + period_ns)

    def _send(self, stamp_ns: int) -> None:
        """Send a state; the controller takes it when it has time, if no newer one has come by then."""
        if self._waiting is not None and self._busy_ns <= stamp_ns:
            self._receive(self._waiting, self._busy_ns)
        self._play(stamp_ns)
        received = self._received(encode(self._state(stamp_ns)), encoding(State))
        arrival_ns = stamp_ns + self._latency_ns()
        if arrival_ns < self._busy_ns:
            self._waiting = received
        else:
            self._receive(received, arrival_ns)

    def _receive(self, received: Received, arrival_ns: int) -> None:
        """Let the controller answer a state."""
        rng, controller = self.rng, self.controller
        self._waiting = None
        local_ns = self.local_ns(arrival_ns)
        state = self._states.accept(received, local_ns)
        if state is None:
            self.seen["refused at the door"] += 1
            self._publish(self._silent(local_ns), arrival_ns)
            return
        command = controller.receive_state(state, local_ns)
        if command is None:
            return
        took_ns = round(rng.exponential(3 * MS)) if rng.random() < 0.98 else int(rng.integers(0, 400)) * MS
        self._busy_ns = arrival_ns + took_ns
        command = controller.in_time(command, self.local_ns(self._busy_ns))
        if command is None:
            self.seen["over budget"] += 1
        else:
            controller.commit(command, self.local_ns(self._busy_ns))
        self._publish(command, self._busy_ns + self._latency_ns())
        controller.prepare()
        if rng.random() < 0.05 and controller._issued.last is not None:
            encode(controller.telemetry(prepare_us=1.0, feedback_us=1.0, latency_us=1.0, slack_s=0.1))

    def _silent(self, local_ns: int) -> Command | None:
        """Let the controller look for silence."""
        if (command := self.controller.tick(local_ns)) is not None:
            self.controller.commit(command)
        return command

    def _publish(self, command: Command | None, arrival_ns: int) -> None:
        """Check a command as it goes over the wire, and send it on its way."""
        if command is None:
            return
        command = decode(Command, encode(command))  # which refuses what is not finite
        assert command.seq == self._command_seq + 1, self.samples
        self._command_seq = command.seq
        assert (np.abs(command.u) <= BOUND + ROUNDING).all(), (self.samples, command)
        assert (np.abs(np.diff(command.u, axis=0)) <= STEP + ROUNDING).all(), (self.samples, command)
        assert command.valid_until_ns - command.stamp_ns <= 300 * MS, (self.samples, command)
        self.seen[command.mode.name] += 1
        self._queue.append((max(arrival_ns, self._queue[-1][0] if self._queue else 0), command))

    def _state(self, stamp_ns: int) -> State:
        """Return the next state: mostly the robot's, sometimes an invalid one."""
        rng = self.rng
        self._seq += 1
        self.samples += 1
        self._x[:3] += 0.1 * np.array([self._x[3] * np.cos(self._x[2]), self._x[3] * np.sin(self._x[2]), self._x[4]])
        self._x[3:] += 0.4 * (self._actuator.u - self._x[3:])
        x = self._x + rng.standard_normal(5) * 0.003
        kind = rng.random()
        if kind < 0.002:
            self._x[:3] = rng.uniform(-3, 3, 3)
        elif kind < 0.01:
            x = rng.standard_normal(5) * 10.0 ** rng.integers(-3, 12)
        elif kind < 0.02:
            x[2] += 2 * np.pi * rng.integers(-5, 6)
        if rng.random() < 0.01 and stamp_ns > self._ordered_ns:
            stamp_ns -= int(rng.integers(0, 200)) * MS  # one that was sent before
        return State(self._epoch, self._seq, stamp_ns, x)

    def _received(self, payload: bytes, kind: str) -> Received:
        """Return the payload of a message as received: cut, changed or of another encoding at times."""
        rng, r = self.rng, self.rng.random()
        if r < 0.005:
            payload = payload[: int(rng.integers(0, len(payload)))]
        elif r < 0.01:
            data = bytearray(payload)
            data[-8:] = np.array([rng.choice([np.nan, np.inf, -np.inf])]).tobytes()
            payload = bytes(data)
        elif r < 0.012:
            payload = rng.bytes(int(rng.integers(0, 200)))
        elif r < 0.014:
            kind = "application/json"
        return Received(payload, kind, "")

    # What else happens.

    def _plan(self) -> None:
        """Let a planner send a reference, sensible or not."""
        rng = self.rng
        rows = int(rng.integers(1, 40))
        y = np.cumsum(rng.standard_normal((rows, 3)) * 0.03, axis=0) + self._x[:3]
        if rng.random() < 0.05:
            y = rng.standard_normal((rows, 3)) * 10.0 ** rng.integers(-2, 9)
        p = np.zeros((rows, 0))
        if rng.random() < 0.2:
            p = np.tile(np.array(self.rti.ocp.model.p_nominal), (rows, 1)) * rng.choice([1.0, 0.5, 0.0, -1.0, 1e200], p=[0.8, 0.1, 0.04, 0.03, 0.03])
        stamp_ns = STAMP_ON_ARRIVAL if rng.random() < 0.3 else self._now_ns + int(rng.integers(-3000, 1000)) * MS
        message = Reference(1, self._seq, stamp_ns, int(rng.integers(1, 300)) * MS, End(int(rng.integers(0, 2))), y, p)
        accepted = self._references.accept(self._received(encode(message), encoding(Reference)), self.local_ns(self._now_ns))
        if accepted is not None:
            self.controller.receive_reference(accepted)
            self.seen["reference"] += 1

    def _operate(self) -> None:
        """Let an operator stop and release, and a solver fail."""
        r = self.rng.random()
        if r < 0.002:
            self.controller.stop("fuzzed")
        elif r < 0.012:
            self.controller.enable()
        elif r < 0.022:
            failure = str(self.rng.choice(FAULTS))
            self.rti.inject({"failure": failure, "samples": int(self.rng.integers(1, 12))})
            self.seen[failure] += 1
        for notice in self.controller.notices():
            self.seen[notice.code] += 1

    def _silence(self, duration_ns: int) -> None:
        """Send no state for a while; the controller checks the clock."""
        if self._waiting is not None:
            self._receive(self._waiting, self._busy_ns)
        self._play(max(self._busy_ns, self._now_ns))
        for _ in range(duration_ns // (10 * MS)):
            self._play(self._now_ns + 10 * MS)
            self._publish(self._silent(self.local_ns(self._now_ns)), self._now_ns + self._latency_ns())

    def _stall(self, duration_ns: int) -> None:
        """Stop the controller for a while; then it receives some of the waiting states at once."""
        first_ns, last_ns = self._now_ns + DT, self._now_ns + duration_ns
        self._play(last_ns)
        self._busy_ns, self._ordered_ns = last_ns, last_ns + 10 * DT
        self._waiting = None
        kept = sorted(self.rng.choice(np.arange(first_ns, last_ns, DT), size=2))
        for stamp_ns in kept:
            self._receive(Received(encode(self._state(int(stamp_ns))), encoding(State), ""), self._busy_ns)

    def _restart(self) -> None:
        """Begin another life of the robot, which stands, on another clock, at another speed of time."""
        self._epoch += 1
        self._rate = float(self.rng.choice([0.5, 1.0, 4.0]))
        self._x[:] = 0.0
        self._begin(int(self.rng.integers(0, 10**12)))

    def _jump(self, by_ns: int) -> None:
        """Let the robot's clock jump: commands it holds for later are dropped, and it brakes."""
        u, local_ns = self._actuator.u.copy(), self.local_ns(self._now_ns)
        self._begin(max(0, self._now_ns + by_ns))
        self._offset_ns = local_ns
        self._settled_ns = self._now_ns + 10 * DT
        self._actuator._schedule.brake(u, self._now_ns)
        self.seen["jump"] += 1
