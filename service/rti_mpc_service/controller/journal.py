# SPDX-License-Identifier: Apache-2.0
"""Publisher of a controller's journal: a thread that empties the queue into messages, while others control."""

from __future__ import annotations

import time
from threading import Event, Thread

from rti_mpc.contract.message import Notice, Severity
from rti_mpc.control.controller import Controller
from rti_mpc.errors import JournalError
from rti_mpc.journal.book import Book
from rti_mpc.wire.bus import Bus

PUBLISHING_PERIOD_S = 0.1
VALUES_AT_ONCE = 8  # values that are encoded before another thread may take the interpreter's lock
RECORDER = "recorder"  # role, with a number or without
SLACK_SHARE = 0.8  # of the slack that a snapshot may take
UNFIT_SAMPLES = 100  # samples in a row with too little slack, after which that is said


class JournalPublisher:
    """
    Publisher of one controller's journal.

    Attributes:
        taken_s: Time that the last snapshot has taken on the thread that controls, s.
    """

    def __init__(self, bus: Bus, controller: Controller, book: Book) -> None:
        self.taken_s = 0.0
        self._unfit = 0  # samples in a row whose slack was too short for a snapshot that was due
        self._bus = bus
        self._controller = controller
        self._book = book
        self._publisher = bus.publisher(bus.keys.journal)
        self._said_dropped = 0
        self._said = ""
        self._values = 0
        self._closing = Event()
        self._thread = Thread(target=self._publish, name="journal", daemon=True)

    def start(self) -> None:
        """Begin with a snapshot, before the first state."""
        self._book.rehearse()
        self.photograph(time.monotonic_ns())
        self._thread.start()
        self._bus.watch_alive(self._meet)

    def _meet(self, role: str, present: bool) -> None:
        """Ask for a snapshot when a recorder appears, so that a replay begins there and not up to ten seconds later."""
        if present and role.partition(".")[0] == RECORDER:
            self._book.ask()

    def close(self) -> None:
        """Publish what is left."""
        self._closing.set()
        self._thread.join(timeout=5.0)

    def due(self, local_ns: int, slack_s: float) -> bool:
        """
        Whether a snapshot is due that fits into the slack.

        Args:
            local_ns: Local monotonic time.
            slack_s: Local time until the next state, s; infinity if none is expected.
        """
        if not self._book.due(local_ns):
            return False
        if self.taken_s <= SLACK_SHARE * slack_s:
            self._unfit = 0
            return True
        self._unfit += 1
        if self._unfit == UNFIT_SAMPLES:
            text = f"the slack of {UNFIT_SAMPLES} samples was too short for a snapshot, which takes {1e3 * self.taken_s:.1f} ms"
            self._say("snapshot_waits", f"{text}: a replay begins at an earlier one")
        return False

    def photograph(self, local_ns: int) -> None:
        """Take a snapshot, while nobody else calls the controller."""
        self._book.photograph(local_ns)
        self.taken_s = 1e-9 * (time.monotonic_ns() - local_ns)

    def _publish(self) -> None:
        try:
            while not self._closing.wait(PUBLISHING_PERIOD_S):
                self._empty()
            self._empty()
        except Exception as error:
            if self._bus.closed:
                return  # by another thread, at the end of the process: the error does not matter
            self._book.end()
            why = str(error) if isinstance(error, JournalError) else f"{type(error).__name__}: {error}"
            self._say("journal_failed", f"the journal has ended, no replay goes beyond it: {why}")

    def _empty(self) -> None:
        """Publish what waits."""
        now_ns, book = time.monotonic_ns(), self._book
        for message in book.messages(now_ns, self._pause):
            self._publisher.put(message)
        if book.dropped > self._said_dropped:
            text = (
                f"{book.dropped - self._said_dropped} entries of the journal found no room and were dropped: a replay goes on with the next snapshot"
            )
            self._said_dropped = book.dropped
            self._say("journal_dropped", text)
        if book.failure and book.failure != self._said:
            self._say("snapshot_failed", f"a snapshot for the journal could not be taken: {book.failure}")
        self._said = book.failure

    def _say(self, code: str, text: str) -> None:
        self._controller.say(Notice(Severity.WARNING, code, text))

    def _pause(self) -> None:
        """Let another thread take the interpreter's lock now and then."""
        self._values += 1
        if self._values % VALUES_AT_ONCE == 0:
            time.sleep(0)
