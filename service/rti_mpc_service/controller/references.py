# SPDX-License-Identifier: Apache-2.0
"""
Intake of references for a controller.

A reference that starts on arrival gets its stamp from the leading controller, which
publishes it with that stamp: at once, or with the first state that counts if there was
none. Standbys wait for the stamped reference; otherwise two controllers could follow it
one sample apart. It is withdrawn when the leader forgets it, as the robot was restarted:
a standby that starts later would follow it on another clock.
"""

from __future__ import annotations

import time
from collections import deque

from rti_mpc.array import Array
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Reference
from rti_mpc.control.controller import Controller
from rti_mpc.wire.bus import Bus, Subscriber
from rti_mpc.wire.rival import PLANNER_STALE_S

LaidOut = tuple[Reference, Array | None]  # a reference and its rows from `Controller.lay_out`


class References:
    """
    Receives references in threads of the caller, and hands the newest one over on request.

    The receiving threads lay references out, so that handing one over takes the same time for any number of rows.

    Attributes:
        planners: Intake of the planners' references.
        leaders: Intake of references that a leader has stamped.
    """

    def __init__(self, bus: Bus, controller: Controller, ny: int) -> None:
        widths = {"y": ny, "p": controller.np_}
        self.planners, self.leaders = bus.intake(Reference, PLANNER_STALE_S, widths), bus.intake(Reference, PLANNER_STALE_S, widths)
        self._controller = controller
        self._planned: deque[LaidOut] = deque(maxlen=1)  # from a planner; each deque has one writer, the thread of its intake, in order of age
        self._stamped: deque[LaidOut] = deque(maxlen=1)  # from a leader
        self._last_planned = (0, 0)  # epoch and number of the last reference taken from a planner
        self._bus = bus
        self._publisher = bus.publisher(bus.keys.anchored)
        self._waiting: LaidOut | None = None  # waits for its stamp
        self._given: Reference | None = None  # to the controller, as it came
        self._known: Reference | None = None  # to standbys, with its stamp
        self._leading = False

    def from_planner(self, subscriber: Subscriber) -> None:
        """Receive the references of planners."""
        for received in iter(subscriber.recv, None):
            if (reference := self.planners.accept(received, time.monotonic_ns())) is not None:
                self._planned.append((reference, self._controller.lay_out(reference)))

    def from_leader(self, subscriber: Subscriber) -> None:
        """Receive the references that a leader has stamped."""
        for received in iter(subscriber.recv, None):
            reference = self.leaders.accept(received, time.monotonic_ns())
            if reference is not None and not self._leading:
                self._stamped.append((reference, self._controller.lay_out(reference)))

    def hand_over(self, leading: bool) -> None:
        """Let the controller follow the newest received reference, and publish what it follows if that got its stamp here."""
        led, self._leading = self._leading, leading
        newest = self._take(led)
        if leading and not led:
            newest = newest or self._waiting
            self._known = None  # its first publisher may be gone
        if newest is not None:
            self._follow(*newest)
        if leading:
            self._publish()

    def _take(self, led: bool) -> LaidOut | None:
        """Return the newest received reference; the stamped one, if the same reference came from a planner and from a leader."""
        planned = self._planned.pop() if self._planned else None
        stamped = self._stamped.pop() if self._stamped else None
        if planned is not None:
            self._last_planned = epoch_and_seq(planned[0])
            if self._given is not None and planned[0].stamp_ns == STAMP_ON_ARRIVAL and epoch_and_seq(self._given) == self._last_planned:
                planned = None  # the leader has stamped it before, and it has started already
        if stamped is not None and not led and epoch_and_seq(stamped[0]) >= self._last_planned:
            return stamped
        return planned

    def _follow(self, reference: Reference, rows: Array | None) -> None:
        """Let the controller follow a reference, unless it has to wait for the leader's stamp."""
        arriving = reference.stamp_ns == STAMP_ON_ARRIVAL
        self._waiting = (reference, rows) if arriving and not self._leading else None
        if self._waiting is not None:
            return
        self._given = reference
        if not arriving:
            self._known = reference
        self._controller.receive_reference(reference, rows)

    def _publish(self) -> None:
        """Publish what the controller follows, or withdraw what it has forgotten, unless it is known, or older than what still waits for a state."""
        followed, given = self._controller.followed, self._given
        if followed is None and self._known is not None:
            self._bus.withdraw(self._bus.keys.anchored)
            self._publisher, self._known = self._bus.publisher(self._bus.keys.anchored), None
        if followed is None or followed is self._known or given is None or epoch_and_seq(followed) != epoch_and_seq(given):
            return
        self._publisher.put(followed)
        self._known = followed


def epoch_and_seq(reference: Reference) -> tuple[int, int]:
    """Return epoch and sequence number, which order references within one planner and across its restarts."""
    return reference.epoch, reference.seq
