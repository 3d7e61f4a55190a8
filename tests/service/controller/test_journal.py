# SPDX-License-Identifier: Apache-2.0
"""Thread that publishes a controller's journal: what ends it is said, and nothing is kept for it afterwards."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from rti_mpc.errors import JournalError
from rti_mpc.journal.book import PERIOD_NS, Book
from rti_mpc.wire.bus import Bus, Declared
from rti_mpc.wire.keys import Key
from rti_mpc_service.controller.journal import JournalPublisher
from tests.control.test_call import made
from tests.recording.samples import KEYS
from tests.wire.fake_session import FakeSession

PATIENCE_S = 60.0


class WatchedSession(FakeSession):
    """A session that keeps those who watch for others."""

    def __init__(self) -> None:
        super().__init__()
        self.watchers: list[Callable[[str, bool], None]] = []

    def watch(self, key: Key[Any], tell: Callable[[str, bool], None]) -> Declared:
        self.watchers.append(tell)
        return super().watch(key, tell)


def test_each_recorder_that_appears_gets_a_snapshot_and_nobody_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one beside another, so that a recording of seconds can be replayed."""
    session, controller, asked = WatchedSession(), made(), list[str]()
    book = Book(controller)
    journal = JournalPublisher(Bus(session, KEYS), controller, book)
    journal.start()
    (tell,) = session.watchers
    monkeypatch.setattr(book, "ask", lambda: asked.append(role))
    for role in ("recorder", "recorder.7", "recorder.8", "viewer", "recorders"):
        tell(KEYS.alive(role), True)
    for role in ("recorder.7", "recorder"):
        tell(KEYS.alive(role), False)
    journal.close()
    assert asked == ["recorder", "recorder.7", "recorder.8"]


@pytest.mark.parametrize(
    ("error", "said"), [(JournalError("call tick"), "call tick"), (TypeError("of no kind"), "TypeError: of no kind")], ids=["foreseen", "unforeseen"]
)
def test_journal_that_has_ended_says_so_and_takes_no_more_snapshots(error: Exception, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise error

    controller = made()
    book = Book(controller)
    monkeypatch.setattr(book, "messages", fail)
    journal = JournalPublisher(Bus(FakeSession(), KEYS), controller, book)
    journal.start()
    journal._thread.join(PATIENCE_S)
    assert not journal._thread.is_alive()
    assert [(notice.code, notice.text.rpartition("beyond it: ")[2]) for notice in controller.notices()] == [("journal_failed", said)]
    assert not journal.due(10 * PERIOD_NS, 1.0)
    journal.photograph(10 * PERIOD_NS)
    monkeypatch.undo()
    assert list(book.messages(0)) == []
