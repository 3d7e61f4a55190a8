# SPDX-License-Identifier: Apache-2.0
"""Inbox of the recorder: what has arrived and waits for the disk."""

from __future__ import annotations

from collections import deque
from threading import Lock
from typing import Any, NamedTuple

from rti_mpc.wire.received import Received
from rti_mpc.wire.streams import Stream

MAX_WAITING_BYTES = 1 << 28  # 256 MB: a minute of many robots, while a disk stands still
ENTRY_BYTES = 500  # of an entry without its payload


class Arrived(NamedTuple):
    """
    A payload with the time at which it came.

    Attributes:
        robot: Name of its robot.
        stream: Its stream.
        local_ns: Monotonic time of its arrival.
        received: Payload, encoding and key.
    """

    robot: str
    stream: Stream[Any]
    local_ns: int
    received: Received


class Inbox:
    """
    Queue of limited size that drops the oldest.

    Attributes:
        dropped: Number of entries dropped: the disk was too slow.
    """

    def __init__(self, max_bytes: int = MAX_WAITING_BYTES) -> None:
        self.dropped = 0
        self._max_bytes = max_bytes
        self._bytes = 0
        self._entries: deque[Arrived] = deque()
        self._lock = Lock()

    def put(self, entry: Arrived) -> None:
        """Add an entry, in any thread."""
        with self._lock:
            self._entries.append(entry)
            self._bytes += ENTRY_BYTES + len(entry.received.payload)
            while self._bytes > self._max_bytes:
                self._bytes -= ENTRY_BYTES + len(self._entries.popleft().received.payload)
                self.dropped += 1

    def take(self) -> deque[Arrived]:
        """Return all entries, oldest first, and remove them."""
        with self._lock:
            taken, self._entries, self._bytes = self._entries, deque(), 0
        return taken
