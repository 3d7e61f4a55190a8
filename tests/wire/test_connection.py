# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
from collections.abc import Iterable
from queue import Queue

import pytest

from rti_mpc.contract.message import Notice
from rti_mpc.wire import connection

PATIENCE_S = 30.0


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "LOOK_INTERVAL_S", 1e-4)


def told(links: Iterable[int], why: str = "nobody is there") -> list[str]:
    """Codes of the notices while the number of links changes so, up to the end of the session."""
    found: Queue[Notice] = Queue()
    counts = iter(links)
    connection.watch(lambda: next(counts, None), lambda: why, found.put, threading.Event())
    for thread in threading.enumerate():
        if thread.name == "connection":
            thread.join(PATIENCE_S)
            assert not thread.is_alive(), "the end of the session ends the watch"
    return [notice.code for notice in found.queue]


def test_each_loss_of_all_links_is_told_once_and_so_is_its_end() -> None:
    assert told([1, 3, 1, 0, 0, 0, 2, 1, 0, 0, 1]) == ["unlinked", "linked", "unlinked", "linked"]


def test_process_that_was_never_linked_has_lost_nothing() -> None:
    """What it waits for is told by `rti_mpc.wire.reach`."""
    assert told([0, 0, 0]) == []


def test_process_that_others_connect_to_does_not_complain_of_being_alone() -> None:
    assert told([1, 0, 0, 1], why="") == []


def test_end_of_the_process_ends_the_watch() -> None:
    over, asked = threading.Event(), threading.Event()

    def links() -> int:
        asked.set()
        return 1

    connection.watch(links, lambda: "", lambda _: None, over)
    watching = next(thread for thread in threading.enumerate() if thread.name == "connection")
    assert asked.wait(PATIENCE_S)
    over.set()
    watching.join(PATIENCE_S)
    assert not watching.is_alive()
