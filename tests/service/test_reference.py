# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from threading import Event
from typing import Any

import pytest

from rti_mpc.model.path_following import path_following
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.tracks import track
from rti_mpc.wire.bus import BusSettings
from rti_mpc.wire.keys import Key, Keys
from rti_mpc_service import path_reference, reference
from rti_mpc_service.config.config import load
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import SHIPPED
from tests.wire.fake_session import FakeSession

KEYS = Keys(robot="car")
SOURCES: dict[str, Callable[[Event], int]] = {
    "scenario": lambda stop: reference.main(find_scenario(load(SHIPPED)), BusSettings(), KEYS, stop=stop),
    "path": lambda stop: path_reference.main("oval", path_following(pioneer_3dx()), (track("oval", 1.0),), BusSettings(), KEYS, stop=stop),
}


@pytest.mark.parametrize("what", SOURCES)
def test_source_does_not_start_beside_another_one_of_the_same_robot(
    what: str, session: FakeSession, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = list[str]()

    def present(key: Key[Any], timeout_s: float) -> bool:
        asked.append(key)
        return True

    monkeypatch.setattr(session, "present", present)
    stop = Event()  # nobody sets it: a source that starts would go on
    assert SOURCES[what](stop) == 1
    said = "car already has a source of references: stop it first"
    assert capsys.readouterr().err == f"rti-mpc: {said}\n"
    assert (asked, session.put, session.said) == ([KEYS.alive("reference")], {}, set())


@pytest.mark.parametrize("what", SOURCES)
def test_source_that_was_stopped_has_status_0(what: str, session: FakeSession) -> None:
    stop = Event()
    stop.set()
    assert SOURCES[what](stop) == 0
