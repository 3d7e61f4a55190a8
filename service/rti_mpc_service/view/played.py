# SPDX-License-Identifier: Apache-2.0
"""Recording played to a listener, as if its messages came from the bus now."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from typing import Any

from rti_mpc.recording import Recording
from rti_mpc.wire.bus import unix_s
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.keys import Key, Keys
from rti_mpc.wire.received import Received
from rti_mpc_service.view.listener import DRAIN_PERIOD_NS, Listener
from rti_mpc_service.view.recording import Entry


class PlayedSubscriber:
    """Messages of one stream that have come and wait."""

    def __init__(self) -> None:
        self.waiting: deque[Received] = deque()

    def drain(self) -> list[Received]:
        """Return and remove all messages, oldest first."""
        waiting = list(self.waiting)
        self.waiting.clear()
        return waiting


class PlayedBus:
    """
    As much of a `rti_mpc.wire.bus.Bus` as a listener needs.

    Attributes:
        keys: Keys of the robot.
    """

    def __init__(self, keys: Keys) -> None:
        self.keys = keys
        self._rings: defaultdict[str, PlayedSubscriber] = defaultdict(PlayedSubscriber)

    def subscriber(self, key: Key[Any], *, capacity: int) -> PlayedSubscriber:
        """Return the subscriber to a stream, which never drops anything."""
        return self._rings[key.stream.name]

    def intake(self, cls: type[Any], stale_s: float, *, unfit: Callable[[Any], str]) -> Intake[Any]:
        """Return an intake, as that of a bus."""
        return Intake(cls, stale_s, unix_s=unix_s, unfit=unfit)

    def put(self, stream: str, received: Received) -> None:
        """Let a message arrive."""
        if stream in self._rings:
            self._rings[stream].waiting.append(received)


def played(recording: Recording, robot: str, *, root: str = "", begun_ns: int | None = None) -> Iterator[list[Entry]]:
    """Yield what a listener makes of the messages of one robot, drained as often as live; `root` and `begun_ns` are those of the listener."""
    bus: PlayedBus | None = None
    end_ns = 0
    for recorded in recording.messages(robot):
        if bus is None:
            bus = PlayedBus(Keys(recorded.received.key.partition(f"/{robot}/")[0], robot))
            listener, end_ns = Listener(bus, root=root, begun_ns=begun_ns), recorded.local_ns + DRAIN_PERIOD_NS
        if recorded.local_ns >= end_ns:
            yield listener.drain(end_ns)
            end_ns = recorded.local_ns + DRAIN_PERIOD_NS
        bus.put(recorded.stream, recorded.received)
    if bus is not None:
        yield listener.drain(end_ns)
