# SPDX-License-Identifier: Apache-2.0
"""Events of a process of this package: every mode change, and faults of one code at most once per second."""

from __future__ import annotations

import time
from threading import Lock

from rti_mpc.contract.message import Event, Notice, Severity
from rti_mpc.wire.bus import Bus
from rti_mpc.wire.layout import STAMP_LIMIT_NS

MIN_INTERVAL_NS = 1_000_000_000  # local time between two faults of one code


class Announcer:
    """
    Publisher of the events of one role.

    Attributes:
        role: Role of the process, the last part of its key.
    """

    def __init__(self, bus: Bus, role: str, epoch: int) -> None:
        self._publisher = bus.publisher(bus.keys.event(role))
        self.role = role
        self._epoch = epoch
        self._seq = 0
        self._lock = Lock()
        self._last_ns: dict[str, int] = {}  # by code

    def say(self, notice: Notice, stamp_ns: int) -> bool:
        """Publish a notice, unless it is a fault and one of its code was published just before; return whether it was published. In any thread."""
        now_ns, code = time.monotonic_ns(), notice.code
        each = notice.change or notice.severity is Severity.INFO
        with self._lock:
            due = each or now_ns - self._last_ns.get(code, -MIN_INTERVAL_NS) >= MIN_INTERVAL_NS
            if due:
                self._last_ns[code] = now_ns
                self._seq += 1
                stamp_ns = min(max(stamp_ns, 1 - STAMP_LIMIT_NS), STAMP_LIMIT_NS - 1)  # a robot's clock may exceed the limits of the message
                self._publisher.put(Event(self._epoch, self._seq, stamp_ns, self.role, notice.severity, code, notice.text))
        return due
