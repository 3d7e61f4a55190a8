# SPDX-License-Identifier: Apache-2.0
"""Announcer of events: changes are published each time, faults at a limited rate."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest

from rti_mpc.contract.message import Event, Notice, Severity
from rti_mpc.wire import announcer as announcer_module
from rti_mpc.wire.announcer import MIN_INTERVAL_NS, Announcer
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.cdr import decode
from rti_mpc.wire.keys import Keys
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.in_time import PATIENT
from tests.processes.system import until

FAULT = Notice(Severity.WARNING, "over_budget", "a sample was late")
CHANGE = Notice(Severity.WARNING, "qp_failed", "tracking to fallback: the QP is failed", change=True)
NEWS = Notice(Severity.INFO, "free", "the way is free again")
MET = Notice(Severity.INFO, "met", "here we are")
END = Notice(Severity.INFO, "end", "that is all")


def said(notices: list[tuple[float, Notice]], monkeypatch: pytest.MonkeyPatch) -> list[Event]:
    """Events that a peer hears of notices, each at a time in s."""
    endpoint, heard = free_endpoint(), dict[int, Event]()
    with Bus.join(BusSettings(listen=(endpoint,), cfg=PATIENT), Keys()) as bus, Bus.join(BusSettings(connect=(endpoint,)), Keys()) as peer:
        subscriber = peer.subscriber(peer.keys.event("controller"), capacity=64)
        announcer = Announcer(bus, "controller", epoch=1)

        def hears(code: str) -> Callable[[], bool]:
            def look() -> bool:
                heard.update((event.seq, event) for event in (decode(Event, received.payload) for received in subscriber.drain()))
                return any(event.code == code for event in heard.values())

            return look

        until(lambda: announcer.say(MET, 0) and hears("met")(), "the two have met")
        for at_s, notice in notices:
            monkeypatch.setattr(announcer_module, "time", SimpleNamespace(monotonic_ns=lambda at_s=at_s: round(at_s * MIN_INTERVAL_NS)))
            announcer.say(notice, 0)
        announcer.say(END, 0)
        until(hears("end"), "the last event")
    return [heard[seq] for seq in sorted(heard) if heard[seq].code not in ("met", "end")]


def test_each_change_of_mode_is_an_event_however_fast_they_follow_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [event.text for event in said([(5.0, CHANGE)] * 10, monkeypatch)] == [CHANGE.text] * 10


def test_fault_is_told_once_a_second_whatever_else_is_told_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    events = said([(5.0, FAULT), (5.5, NEWS), (5.9, FAULT), (6.0, FAULT), (6.1, FAULT)], monkeypatch)
    assert [event.code for event in events] == ["over_budget", "free", "over_budget"]
