# SPDX-License-Identifier: Apache-2.0
"""Listener to all streams of one robot, which are drained together and placed on its timeline."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Protocol

from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Event, Notice, State
from rti_mpc.errors import MessageError
from rti_mpc.wire.bus import RING_MESSAGES, Received
from rti_mpc.wire.info import Info
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.keys import Key, Keys
from rti_mpc.wire.streams import Stream, admitted, role_of
from rti_mpc_service.view.playback import Actuation
from rti_mpc_service.view.recording import Entry, Message
from rti_mpc_service.view.timeline import Timeline

DRAIN_PERIOD_NS = 50_000_000  # after which a listener is drained again
MAX_WAITING_MESSAGES = 2048  # per stream: 2 s at 1 kHz
STALE_S = 2.0

Door = Intake[Any]


class Ring(Protocol):
    """Messages of a stream that wait."""

    def drain(self) -> list[Received]:
        """Return and remove all messages, oldest first."""


class Hears(Protocol):
    """As much of a `rti_mpc.wire.bus.Bus` as a listener needs; a recording has it, too."""

    @property
    def keys(self) -> Keys:
        """Keys of the robot."""

    def subscriber(self, key: Key[Any], *, capacity: int) -> Ring:
        """Return the subscriber to a stream."""

    def intake(self, cls: type[Any], stale_s: float, *, unfit: Callable[[Any], str]) -> Door:
        """Return an intake for messages of a class."""


class Listener:
    """
    Subscriptions to all streams that a viewer draws.

    Messages wait in rings that drop the oldest ones; missing sequence numbers are
    counted. No message of a peer can raise an exception.

    Attributes:
        received: Number of accepted messages.
    """

    def __init__(self, bus: Hears, capacity: int = MAX_WAITING_MESSAGES, *, root: str = "", begun_ns: int | None = None) -> None:
        """
        Subscribe.

        Args:
            bus: Bus of the robot.
            capacity: Messages of a stream that wait.
            root: Entity below which the robot is drawn; empty for the only one.
            begun_ns: See `rti_mpc_service.view.timeline.Timeline`.
        """
        keys = bus.keys
        self._actuation = keys.actuation
        self.received = 0
        self._bad_infos = 0
        self._root = root
        self._timeline = Timeline(begun_ns)
        self._bus = bus
        self._doors: dict[str, Door] = {}
        self._events: set[str] = set()  # keys of events
        self._described: set[str] = set()  # keys of descriptions
        self._infos = bus.subscriber(keys.infos, capacity=RING_MESSAGES)
        heard: tuple[Key[Any], ...] = (keys.state, keys.reference, keys.anchored, keys.command, keys.actuation, keys.telemetry, keys.events)
        self._streams = [(key.stream, bus.subscriber(key, capacity=capacity)) for key in heard]

    @property
    def lost(self) -> int:
        """Number of messages that never came or that the rings dropped."""
        return sum(door.source.lost for door in self._doors.values())

    @property
    def refused(self) -> int:
        """Number of refused payloads."""
        return self._bad_infos + sum(door.refused.total() for door in self._doors.values())

    @property
    def now_ns(self) -> int:
        """Time of the newest state on the robot's timeline."""
        return self._timeline.now_ns

    def _entry(self, time_ns: int, message: Message) -> Entry:
        return Entry(time_ns, message, self._root)

    def own_entry(self, notice: Notice) -> Entry:
        """Return a notice of the viewer as an event at `now_ns`."""
        return self._entry(self.now_ns, Event(0, 0, self.now_ns, "viewer", notice.severity, notice.code, notice.text))

    def drain(self, now_ns: int | None = None) -> list[Entry]:
        """
        Return the messages received since the last call, states before other streams because they advance the timeline.

        Args:
            now_ns: Local monotonic time; None: the present.
        """
        now_ns = time.monotonic_ns() if now_ns is None else now_ns
        entries = [*self._descriptions(), *self._messages(now_ns)]
        self.received += len(entries)
        return [*entries, *self._notices(now_ns)]

    def _descriptions(self) -> Iterator[Entry]:
        """Yield the last description of each role."""
        infos: dict[str, Info] = {}
        for received in self._infos.drain():
            try:
                info = Info.from_received(received)
            except MessageError:
                self._bad_infos += 1
                continue
            if admitted(received.key, self._described):
                self._described.add(received.key)
                infos[received.key] = info
        for info in infos.values():
            yield self._entry(self._timeline.now_ns, info)

    def _messages(self, now_ns: int) -> Iterator[Entry]:
        for stream, subscriber in self._streams:
            waiting = subscriber.drain()
            for behind, received in zip(range(len(waiting) - 1, -1, -1), waiting, strict=True):
                door = self._door(stream, received)
                message = None if door is None else door.accept(received, now_ns)
                if message is None:
                    continue
                if isinstance(message, State):
                    # When each state arrived is not known: they are spread over the period. If all had arrived at once,
                    # those of a robot whose clock is much faster than the local one would be drawn on top of each other.
                    arrived_ns = now_ns - DRAIN_PERIOD_NS * behind // len(waiting)
                    yield self._entry(self._timeline.place_state(message.epoch, message.stamp_ns, arrived_ns), message)
                elif received.key == self._actuation:
                    yield self._entry(self._timeline.place(message.stamp_ns, now_ns), Actuation(message))
                elif message.stamp_ns != STAMP_ON_ARRIVAL:  # such a reference follows with its real stamp
                    yield self._entry(self._timeline.place(message.stamp_ns, now_ns), message)

    def _door(self, stream: Stream[Any], received: Received) -> Door | None:
        """Return the intake of a key; None for events of a role beyond the limit of roles."""
        key, cls = received.key, stream.message
        if cls is not None and key not in self._doors and (not stream.by_role or admitted(key, self._events)):
            self._doors[key] = self._bus.intake(cls, STALE_S, unfit=partial(_foreign, role_of(key)))
            if stream.by_role:
                self._events.add(key)
        return self._doors.get(key)

    def _notices(self, now_ns: int) -> Iterator[Entry]:
        """Yield the notices of the intakes as events of the viewer."""
        for door in self._doors.values():
            for notice in door.notices(now_ns):
                yield self.own_entry(notice)


def _foreign(role: str, message: Any) -> str:
    """Return a complaint if an event names another source than its key does, else an empty string."""
    return "foreign_source" if isinstance(message, Event) and message.source != role else ""
