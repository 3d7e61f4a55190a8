# SPDX-License-Identifier: Apache-2.0
"""Listener that collects the messages of a run: telemetry, events, reference and the controller's description."""

from __future__ import annotations

import time
from contextlib import suppress

from rti_mpc.contract.message import Event, Reference, Telemetry
from rti_mpc.errors import MessageError
from rti_mpc.wire.bus import RING_MESSAGES, Bus
from rti_mpc.wire.info import Info
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.streams import admitted

MAX_WAITING_MESSAGES = 4096  # per stream, between two calls of `listen`: several seconds at any rate
STALE_S = 60.0  # longer than a pause in a run: each process has one life per run


class Witness:
    """
    Collects telemetry, events and the reference.

    Attributes:
        telemetry: One message per sample.
        events: Events in the order of arrival.
        reference: The last reference, with its real stamp.
        began_ns: Stamp of the first one.
        info: The controller's description of itself.
        lives: Roles that are present now.
    """

    def __init__(self, bus: Bus) -> None:
        self.telemetry: list[Telemetry] = []
        self.events: list[Event] = []
        self.reference: Reference | None = None
        self.began_ns: int | None = None
        self.info: Info | None = None
        self.lives: set[str] = set()
        self._bus = bus
        self._samples, self._samples_in = bus.subscriber(bus.keys.telemetry, capacity=MAX_WAITING_MESSAGES), bus.intake(Telemetry, STALE_S)
        self._references, self._references_in = bus.subscriber(bus.keys.reference, capacity=RING_MESSAGES), bus.intake(Reference, STALE_S)
        self._events, self._events_in = bus.subscriber(bus.keys.events, capacity=MAX_WAITING_MESSAGES), dict[str, Intake[Event]]()
        self._infos = bus.subscriber(bus.keys.info("controller"), capacity=RING_MESSAGES)
        bus.watch_alive(self._notice)

    @property
    def lost(self) -> int:
        """Number of samples whose telemetry was lost."""
        return self._samples_in.source.lost

    @property
    def begun(self) -> bool:
        """Whether the robot is being driven."""
        return bool(self.telemetry) and self.reference is not None

    def missing(self, roles: set[str]) -> list[str]:
        """Return the roles that are not present, sorted; the controller is missing until its description has been received."""
        return sorted(role for role in roles if role not in self.lives or (role == "controller" and self.info is None))

    def listen(self) -> Witness:
        """Process the messages received since the last call."""
        now_ns = time.monotonic_ns()
        for received in self._samples.drain():
            if (sample := self._samples_in.accept(received, now_ns)) is not None:
                self.telemetry.append(sample)
        self.reference = self._references_in.newest(self._references.drain(), now_ns) or self.reference
        if self.began_ns is None and self.reference is not None:
            self.began_ns = self.reference.stamp_ns
        for received in self._infos.drain():
            with suppress(MessageError):
                self.info = Info.from_received(received)
        for received in self._events.drain():
            if not admitted(received.key, self._events_in):
                continue
            if received.key not in self._events_in:
                self._events_in[received.key] = self._bus.intake(Event, STALE_S)
            if (event := self._events_in[received.key].accept(received, now_ns)) is not None:
                self.events.append(event)
        return self

    def _notice(self, role: str, present: bool) -> None:
        """Note which roles appear and disappear; called in a thread of the bus."""
        if admitted(role, self.lives):
            (self.lives.add if present else self.lives.discard)(role)
