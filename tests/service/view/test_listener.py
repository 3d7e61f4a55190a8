# SPDX-License-Identifier: Apache-2.0
"""Listener of a viewer, on a bus made of lists: of many senders, those that belong to the robot are heard."""

from __future__ import annotations

import json
from collections import defaultdict
from typing import Any

import pytest

pytest.importorskip("rerun")

from rti_mpc.contract.message import Event, Severity
from rti_mpc.wire.bus import Received
from rti_mpc.wire.cdr import encode, encoding
from rti_mpc.wire.info import Info
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.streams import KNOWN_ROLES, MAX_UNKNOWN_ROLES
from rti_mpc_service.view.listener import Listener


class ListBus:
    """As much of a bus as a `Listener` uses; `waiting` is what comes next, by key expression."""

    def __init__(self) -> None:
        self.keys = Keys()
        self.waiting: defaultdict[str, list[Received]] = defaultdict(list)
        self.intake = Intake

    def subscriber(self, key: str, **_: object) -> Any:
        bus = self

        class Subscriber:
            def drain(self) -> list[Received]:
                return bus.waiting.pop(key, [])

        return Subscriber()

    def say(self, role: str, source: str | None = None, seq: int = 1) -> None:
        event = Event(1, seq, 0, role if source is None else source, Severity.INFO, "code", "text")
        self.waiting[self.keys.events].append(Received(encode(event), encoding(Event), self.keys.event(role)))

    def describe(self, role: str, document: Any, key: str | None = None) -> None:
        self.waiting[self.keys.infos].append(Received(json.dumps(document).encode(), "application/json", key or self.keys.info(role)))


@pytest.fixture
def bus() -> ListBus:
    return ListBus()


@pytest.fixture
def listener(bus: ListBus) -> Listener:
    made: Any = Listener(bus)
    return made


def sources(listener: Listener) -> list[str]:
    return [entry.message.source for entry in listener.drain() if isinstance(entry.message, Event) and entry.message.source != "viewer"]


def test_invented_roles_take_no_place_of_those_that_everybody_knows(bus: ListBus, listener: Listener) -> None:
    invented = [f"role_{k}" for k in range(70)]
    for role in (*invented, *KNOWN_ROLES):
        bus.say(role)
    assert sources(listener) == [*invented[:MAX_UNKNOWN_ROLES], *(role for role in KNOWN_ROLES if role != "viewer")]
    for role in (*invented[::-1], *KNOWN_ROLES):
        bus.say(role, seq=2)
    assert set(sources(listener)) == {*invented[:MAX_UNKNOWN_ROLES], *KNOWN_ROLES} - {"viewer"}


def test_events_are_of_whom_their_key_names(bus: ListBus, listener: Listener) -> None:
    bus.say("robot", source="controller")
    bus.say("standby.²")
    bus.say("A" * 5000)
    assert sources(listener) == []
    assert listener.refused == 1


@pytest.mark.parametrize("document", [[], {}, {"role": "guard"}, {"role": "robot", "states": 5 * "x"}, {"role": "robot", "dt_s": float("inf")}])
def test_a_description_that_is_none_or_anothers_is_counted(bus: ListBus, listener: Listener, document: Any) -> None:
    bus.describe("robot", document)
    assert listener.drain() == []
    assert listener.refused == 1


def test_the_last_description_of_a_role_counts_and_invented_ones_are_few(bus: ListBus, listener: Listener) -> None:
    for k in range(70):
        bus.describe(f"role_{k}", {"role": f"role_{k}"})
    for model in ("first", "last"):
        bus.describe("robot", {"role": "robot", "model": model})
    infos = [entry.message for entry in listener.drain() if isinstance(entry.message, Info)]
    assert len(infos) == MAX_UNKNOWN_ROLES + 1
    assert (infos[-1].role, infos[-1].model) == ("robot", "last")
