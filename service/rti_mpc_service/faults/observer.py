# SPDX-License-Identifier: Apache-2.0
"""Observer of a run: the robot's time, its motion, and what its controller has answered."""

from __future__ import annotations

import time
from collections import deque
from itertools import takewhile
from threading import Thread

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, State
from rti_mpc.wire.bus import RING_MESSAGES, Bus, Subscriber
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.keys import Keys
from rti_mpc_service.faults.motion import Motion

STALE_S = 0.25  # silence after which another life of the sender is accepted
MAX_STATES = 40_000  # for more than the longest wait, at 10 ms
SPEED_WINDOW_NS = 200_000_000  # time over which the speed is measured


class RunObserver:
    """
    Follows the states of a robot at speed 1, and the commands for them.

    Args:
        bus: Bus of this process.
        robot: Keys of the robot's streams.
        motion: What its position is.

    Attributes:
        epoch: Epoch of the robot's present life, 0 before the first state.
        answered: Sequence numbers of states of that life that a controller has answered.
    """

    def __init__(self, bus: Bus, robot: Keys, motion: Motion) -> None:
        self._motion = motion
        self.epoch = 0
        self.answered: set[int] = set()
        self._states: deque[tuple[int, int, Array]] = deque(maxlen=MAX_STATES)  # stamp, local monotonic arrival, state
        states, commands = bus.subscriber(robot.state, capacity=RING_MESSAGES), bus.subscriber(bus.keys.command, capacity=RING_MESSAGES)
        Thread(target=self._receive, args=(states, bus.intake(State, STALE_S)), daemon=True).start()
        Thread(target=self._listen, args=(commands, bus.intake(Command, STALE_S)), daemon=True).start()

    def forget(self) -> None:
        """Wait for another life of the robot."""
        self.epoch = 0
        self._states.clear()
        self.answered.clear()

    @property
    def stamp_ns(self) -> int:
        """Stamp of the last state."""
        return self._states[-1][0]

    @property
    def position(self) -> Array:
        """Measured outputs of the last state, shape ``(k,)``."""
        return self._motion.position(self._states[-1][2])

    def now_ns(self) -> int:
        """Robot time now, whether its states still come or not."""
        stamp_ns, arrival_ns, _ = self._states[-1]
        return stamp_ns + time.monotonic_ns() - arrival_ns

    def arrival_ns(self, stamp_ns: int) -> int:
        """Return the arrival, by the monotonic clock, of the first state stamped at or after a time; of the last state if there is none."""
        return next((arrival_ns for stamp, arrival_ns, _ in self._states.copy() if stamp >= stamp_ns), self._states[-1][1])

    def speed_m_s(self) -> float:
        """Speed over the last states; 0 if they do not come."""
        states = self._states.copy()
        if not states or self.now_ns() - states[-1][0] > SPEED_WINDOW_NS:
            return 0.0
        *_, first = takewhile(lambda state: states[-1][0] - state[0] <= SPEED_WINDOW_NS, reversed(states))
        way = np.linalg.norm(self._motion.position(states[-1][2]) - self._motion.position(first[2]))
        return float(way) / max(1e-9 * (states[-1][0] - first[0]), 1e-3)

    def _receive(self, subscriber: Subscriber, intake: Intake[State]) -> None:
        """Note every state with the time of its arrival; a thread of its own."""
        for received in iter(subscriber.recv, None):
            arrival_ns = time.monotonic_ns()
            if (state := intake.read(received)) is None:
                continue
            self._states.append((state.stamp_ns, arrival_ns, state.x))
            self.epoch = state.epoch  # whoever sees it finds the state

    def _listen(self, subscriber: Subscriber, intake: Intake[Command]) -> None:
        """Note which states were answered; a thread of its own."""
        for received in iter(subscriber.recv, None):
            command = intake.read(received)
            if command is not None and command.state_epoch == self.epoch:
                self.answered.add(command.state_seq)
