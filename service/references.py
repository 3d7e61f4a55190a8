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
from rti_mpc.controller import Controller
from rti_mpc.message import STAMP_ON_ARRIVAL, Reference
from rti_mpc.wire.bus import Bus, Subscriber

STALE_S = 60.0  # silence of a planner after which one of a lower epoch may take over; a restarted one has a higher


class References:
    """
    Takes them in, in threads of the caller, and hands them over when asked to.

    Those threads lay them out, too, so that to hand one over takes the thread that controls equally long, however many rows it has.

    Attributes:
        planners: Door of what planners send.
        leaders: Door of what a leader has given a stamp.
    """

    def __init__(self, bus: Bus, controller: Controller, ny: int) -> None:
        widths = {"y": ny, "p": controller.np_}
        self.planners, self.leaders = bus.intake(Reference, STALE_S, widths), bus.intake(Reference, STALE_S, widths)
        self._controller = controller
        self._inbox: deque[tuple[Reference, Array | None]] = deque(maxlen=1)
        self._publisher = bus.publisher(bus.keys.anchored, Reference, cached=True)
        self._waiting: tuple[Reference, Array | None] | None = None  # for its stamp
        self._anchored: Reference | None = None
        self._leading = False

    def from_planner(self, subscriber: Subscriber) -> None:
        """Take in what planners send."""
        for received in iter(subscriber.recv, None):
            if (reference := self.planners.accept(received, time.monotonic_ns())) is not None:
                self._inbox.append((reference, self._controller.lay_out(reference)))

    def from_leader(self, subscriber: Subscriber) -> None:
        """Take in what a leader has given a stamp, unless a planner has sent something later."""
        for received in iter(subscriber.recv, None):
            reference = self.leaders.accept(received, time.monotonic_ns())
            planner = self.planners.source
            if reference is not None and not self._leading and (reference.epoch, reference.seq) >= (planner.epoch or 0, planner.seq):
                self._inbox.append((reference, self._controller.lay_out(reference)))

    def hand_over(self, leading: bool) -> None:
        """Let the controller follow what has come, and publish what it has given a stamp."""
        if leading and not self._leading:
            if self._waiting is not None:
                self._inbox.append(self._waiting)
            elif self._anchored is not None:
                self._publisher.put(self._anchored)  # who published it first may be gone
        self._leading = leading
        while self._inbox:
            reference, rows = self._inbox.pop()
            arriving = reference.stamp_ns == STAMP_ON_ARRIVAL
            self._waiting = (reference, rows) if arriving and not leading else None
            if self._waiting is None:
                anchored = self._controller.receive_reference(reference, rows)
                if anchored is not None:
                    self._publisher.put(anchored)
                self._anchored = anchored if arriving else reference
