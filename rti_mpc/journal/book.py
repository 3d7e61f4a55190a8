# SPDX-License-Identifier: Apache-2.0
"""
The journal of one controller: a bounded queue of its calls, with snapshots and cases between them.

The thread that controls appends to the queue, which takes less than a microsecond; what
finds no room is dropped and counted. Another thread empties it into messages.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Protocol

from rti_mpc.contract.message import Journal, JournalKind
from rti_mpc.control.call import Call
from rti_mpc.control.controller import Controller
from rti_mpc.errors import JournalError
from rti_mpc.journal.entry import encode_call, join_entries
from rti_mpc.journal.snapshot import Camera, Snapshot

MAX_WAITING_ENTRIES = 4096  # several seconds of a controller at 100 Hz
MAX_BATCH_BYTES = 1 << 16  # from which on a message is complete
MAX_DATA_BYTES = 1 << 23  # of one message
PERIOD_NS = 10_000_000_000  # local time from one snapshot to the next


class Enclosure(Protocol):
    """QP of a failed or late sample, copied, for those who look at the recording; no command depends on it."""

    def encode(self, pause: Callable[[], object]) -> bytes:
        """Return its bytes; `pause` is called often, so that others get the interpreter's lock meanwhile."""


class Book:
    """
    The journal of one controller.

    Attributes:
        epoch: Number of the controller's process, to be set before the first message; its low bits are those of all epochs of its commands.
        dropped: Entries dropped since the start.
        failure: Why the last snapshot could not be taken or written; empty if it could.

    Args:
        controller: The controller, as it was built: before its first call that is `reported`.
        capacity: Entries that may wait.
    """

    def __init__(self, controller: Controller, capacity: int = MAX_WAITING_ENTRIES) -> None:
        self.epoch = 0
        self.dropped = 0
        self.failure = ""
        self._controller = controller
        self._camera = Camera(controller)
        self._capacity = capacity
        self._queue: deque[tuple[int, Call | Snapshot | Enclosure]] = deque()
        self._seq = 0
        self._last_ns: int | None = None  # local time of the last snapshot
        self._covered = 0  # entries dropped before it
        self._asked = False
        self._stamp_ns = 0  # of the last state in a message
        controller.on_call = self.note

    @property
    def _full(self) -> bool:
        return len(self._queue) >= self._capacity

    def note(self, call: Call) -> None:
        """Append an entry; on the thread that controls."""
        self._seq += 1
        if len(self._queue) < self._capacity:
            self._queue.append((self._seq, call))
        else:
            self.dropped += 1

    def keep(self, case: Enclosure) -> bool:
        """Append a case, and return whether there was room for it; on the thread that controls."""
        if self._full:
            return False
        self._seq += 1
        self._queue.append((self._seq, case))
        return True

    def ask(self) -> None:
        """Ask for a snapshot; in any thread."""
        self._asked = True

    def due(self, local_ns: int) -> bool:
        """Whether there is room for a snapshot, and it is time: at the start, every `PERIOD_NS`, when asked for, and after a drop."""
        if self._full:
            return False
        if self.dropped > self._covered and len(self._queue) < self._capacity // 2:
            return True
        return self._asked or self._last_ns is None or local_ns - self._last_ns >= PERIOD_NS

    def rehearse(self) -> None:
        """Take a snapshot for nobody, so that the first one does not take longer than later ones."""
        with suppress(JournalError):
            self._camera.take()

    def photograph(self, local_ns: int) -> None:
        """Append a snapshot if there is room; between two samples, while no other thread calls the controller."""
        if self._full:
            return
        self._controller.rewarm()
        self._last_ns, self._covered, self._asked = local_ns, self.dropped, False
        try:
            snapshot = self._camera.take()
        except JournalError as error:
            self.failure = str(error)
            return
        self._seq += 1
        self._queue.append((self._seq, snapshot))

    def end(self) -> None:
        """Drop what waits and all that follows; on the thread that takes the messages."""
        self._capacity = 0
        self._queue.clear()

    def messages(self, local_ns: int, pause: Callable[[], object] = lambda: None) -> Iterator[Journal]:
        """
        Take what waits, and yield it as messages.

        Args:
            local_ns: Local monotonic time.
            pause: Called often, so that others get the interpreter's lock meanwhile.

        Raises:
            JournalError: An entry cannot be encoded.
        """
        first, entries, size = 0, list[bytes](), 0
        while self._queue:
            seq, item = self._queue.popleft()
            if isinstance(item, Call) and item.name == "receive_state":
                self._stamp_ns = item.args[0].stamp_ns
            content = encode_call(item) if isinstance(item, Call) else item.encode(pause)
            pause()
            if entries and (not isinstance(item, Call) or seq != first + len(entries) or size + len(content) > MAX_BATCH_BYTES):
                yield self._message(first, local_ns, JournalKind.CALLS, join_entries(entries))
                entries, size = [], 0
            if isinstance(item, Snapshot):
                if len(content) > MAX_DATA_BYTES:
                    self.failure = f"it has {len(content)} bytes, and must have at most {MAX_DATA_BYTES}"
                    continue
                self.failure = ""
                yield self._message(seq, local_ns, JournalKind.SNAPSHOT, content)
                continue
            if not isinstance(item, Call):
                yield self._message(seq, local_ns, JournalKind.CASE, content if len(content) <= MAX_DATA_BYTES else b"")
                continue
            first = first if entries else seq
            entries.append(content)
            size += len(content)
        if entries:
            yield self._message(first, local_ns, JournalKind.CALLS, join_entries(entries))

    def _message(self, seq: int, local_ns: int, kind: JournalKind, data: bytes) -> Journal:
        return Journal(self.epoch, seq, self._stamp_ns, local_ns, self.dropped, kind, data)
