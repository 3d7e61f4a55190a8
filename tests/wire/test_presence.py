# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from queue import Queue
from threading import Event
from typing import Any

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.wire import presence
from rti_mpc.wire.keys import Key, Keys
from rti_mpc.wire.presence import LOOKS, unseen, watch

KEY = Keys().alive("reference.17")
HERE, THERE, NOWHERE = frozenset({"router"}), frozenset({"another router"}), frozenset[str]()


class Client:
    """A session that is linked to some routers at one look after the other, and sees presence or not."""

    def __init__(self, *routers: frozenset[str], sees: bool = False, others: Client | None = None) -> None:
        self.looks = 0
        self.shown: list[str] = []
        self.closed = False
        self._routers = routers
        self._sees = sees
        self._others = others

    @property
    def routers(self) -> frozenset[str]:
        return self._routers[min(self.looks, len(self._routers) - 1)]

    def again(self, timeout_s: float, stop: Event) -> Client:
        if self._others is None:
            raise ConfigError("bus: a router must be reachable")
        return self._others

    def token(self, key: Key[Any]) -> Client:
        self.shown.append(key)
        return self

    def undeclare(self) -> None:
        self.shown.remove(str(KEY))

    def present(self, key: Key[Any], timeout_s: float) -> bool:
        self.looks += 1
        return self._sees

    def close(self) -> None:
        self.closed = True


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presence, "FIRST_LOOK_S", 0.0)
    monkeypatch.setattr(presence, "LOOK_INTERVAL_S", 0.0)


@pytest.fixture
def over() -> Iterator[Event]:
    event = Event()
    yield event
    event.set()


def test_presence_that_is_seen_is_seen_at_the_first_look(over: Event) -> None:
    other = Client(HERE, sees=True)
    assert not unseen(Client(HERE), other, KEY, over)
    assert other.looks == 1


def test_presence_that_no_look_finds_at_the_same_router_is_unseen(over: Event) -> None:
    other = Client(HERE)
    assert unseen(Client(HERE), other, KEY, over)
    assert other.looks == LOOKS


@pytest.mark.parametrize("gap", [NOWHERE, THERE], ids=["the link was lost", "another router"])
def test_looks_count_only_while_both_sessions_are_linked_to_one_router(gap: frozenset[str], over: Event) -> None:
    other = Client(*[HERE] * LOOKS, gap, HERE)
    assert unseen(Client(HERE), other, KEY, over)
    assert other.looks == 2 * LOOKS, "all looks before the gap are void"


def test_ending_process_says_nothing() -> None:
    ending = Event()
    ending.set()
    assert not unseen(Client(HERE), Client(HERE), KEY, ending)


@pytest.mark.parametrize("seen", [True, False])
def test_process_that_is_not_heard_is_told_once_and_shows_nothing_more_afterwards(seen: bool, over: Event) -> None:
    told, other = Queue[str](), Client(HERE, sees=seen)
    session = Client(HERE, others=other)
    watch(session, KEY, lambda: told.put("not heard"), over)
    while not (other.closed and not session.shown):
        over.wait(0.001)
    assert told.qsize() == (0 if seen else 1)


@pytest.mark.parametrize("routers", [NOWHERE, HERE], ids=["no router", "a router that is gone"])
def test_process_that_reaches_no_router_says_nothing_here(routers: frozenset[str], over: Event, monkeypatch: pytest.MonkeyPatch) -> None:
    raised = Queue[object]()
    monkeypatch.setattr("threading.excepthook", raised.put)
    threads = []
    thread = presence.Thread
    monkeypatch.setattr(presence, "Thread", lambda **options: threads.append(thread(**options)) or threads[-1])
    session = Client(routers)
    watch(session, KEY, lambda: raised.put("told"), over)
    threads[0].join(30.0)
    assert raised.empty()
    assert not session.shown
