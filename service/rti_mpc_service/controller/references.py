# SPDX-License-Identifier: Apache-2.0
"""
References on their way to a controller.

One that is to start on arrival is given its stamp by the controller that leads,
which publishes it so; those that stand by wait for that, or two controllers
would follow it a sample apart.
"""

from __future__ import annotations

import time
from collections import deque

from rti_mpc.array import Array
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Reference
from rti_mpc.control.controller import Controller
from rti_mpc.wire.bus import Bus, Subscriber

STALE_S = 60.0  # silence of a planner after which one of a lower epoch may take over; a restarted planner has a higher epoch

LaidOut = tuple[Reference, Array | None]  # a reference, and what `Controller.lay_out` has made of it


class References:
    """
    Takes references in, in threads of the caller, and hands them over when asked to: always the newest.

    Those threads lay them out, too, so that to hand one over takes the thread that controls equally long, however many rows it has.

    Attributes:
        planners: Door of what planners send.
        leaders: Door of what a leader has given a stamp.
    """

    def __init__(self, bus: Bus, controller: Controller, ny: int) -> None:
        widths = {"y": ny, "p": controller.np_}
        self.planners, self.leaders = bus.intake(Reference, STALE_S, widths), bus.intake(Reference, STALE_S, widths)
        self._controller = controller
        self._planned: deque[LaidOut] = deque(maxlen=1)  # by a planner; each has one writer, the thread of its door, whose references only get newer
        self._stamped: deque[LaidOut] = deque(maxlen=1)  # by a leader
        self._last_planned = (0, 0)  # order of the last one taken from a planner
        self._publisher = bus.publisher(bus.keys.anchored)
        self._waiting: LaidOut | None = None  # for its stamp
        self._anchored: Reference | None = None
        self._leading = False

    def from_planner(self, subscriber: Subscriber) -> None:
        """Take in what planners send."""
        for received in iter(subscriber.recv, None):
            if (reference := self.planners.accept(received, time.monotonic_ns())) is not None:
                self._planned.append((reference, self._controller.lay_out(reference)))

    def from_leader(self, subscriber: Subscriber) -> None:
        """Take in what a leader has given a stamp."""
        for received in iter(subscriber.recv, None):
            reference = self.leaders.accept(received, time.monotonic_ns())
            if reference is not None and not self._leading:
                self._stamped.append((reference, self._controller.lay_out(reference)))

    def hand_over(self, leading: bool) -> None:
        """Let the controller follow the newest of what has come, and publish what it has given a stamp."""
        led, self._leading = self._leading, leading
        newest = self._take(led)
        if newest is None and leading and not led:
            newest = self._waiting
            if newest is None and self._anchored is not None:
                self._publisher.put(self._anchored)  # who published it first may be gone
        if newest is not None:
            self._follow(*newest)

    def _take(self, led: bool) -> LaidOut | None:
        """Take the newest of what has come; of one and the same reference the one that a leader has given a stamp."""
        planned = self._planned.pop() if self._planned else None
        stamped = self._stamped.pop() if self._stamped else None
        if planned is not None:
            self._last_planned = epoch_and_seq(planned[0])
            if self._anchored is not None and planned[0].stamp_ns == STAMP_ON_ARRIVAL and epoch_and_seq(self._anchored) == self._last_planned:
                planned = None  # the leader was faster: it has started already
        if stamped is not None and not led and epoch_and_seq(stamped[0]) >= self._last_planned:
            return stamped
        return planned

    def _follow(self, reference: Reference, rows: Array | None) -> None:
        """Let the controller follow a reference, unless it is to wait for the stamp that a leader gives it."""
        arriving = reference.stamp_ns == STAMP_ON_ARRIVAL
        self._waiting = (reference, rows) if arriving and not self._leading else None
        if self._waiting is not None:
            return
        anchored = self._controller.receive_reference(reference, rows)
        if anchored is not None:
            self._publisher.put(anchored)
        self._anchored = anchored if arriving else reference


def epoch_and_seq(reference: Reference) -> tuple[int, int]:
    """Return what references are ordered by, within one planner and across its restarts."""
    return reference.epoch, reference.seq
