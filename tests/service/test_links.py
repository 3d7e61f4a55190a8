# SPDX-License-Identifier: Apache-2.0
"""Links of a process to others, in its log: that all are lost is a fault, that there are links again is news."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from logging.handlers import QueueHandler
from queue import SimpleQueue
from threading import Event, Thread

import numpy as np
import pytest

from rti_mpc.model.path_following import path_following
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.tracks import track
from rti_mpc.wire import connection
from rti_mpc.wire.bus import BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service import path_reference, reference, router
from rti_mpc_service.config.config import load
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import SHIPPED
from rti_mpc_sim import robot
from rti_mpc_sim.settings import RobotSettings
from tests.robots import pushed
from tests.wire.fake_session import FakeSession

KEYS, TIMEOUT_S = Keys(robot="car"), 60.0
# What each process logs once it watches its links, and the process.
PROCESSES: dict[str, tuple[str, Callable[[Event], object]]] = {
    "reference": ("for car", lambda stop: reference.main(find_scenario(load(SHIPPED)), BusSettings(), KEYS, stop=stop)),
    "path": (
        "for car",
        lambda stop: path_reference.main("oval", path_following(pioneer_3dx()), (track("oval", 1.0),), BusSettings(), KEYS, stop=stop),
    ),
    "robot": ("of car", lambda stop: robot.main(RobotSettings(pushed(), np.zeros(2)), BusSettings(), KEYS, stop=stop)),
    "router": ("routing", lambda stop: router.main(BusSettings(listen=("tcp/127.0.0.1:1",)), KEYS, stop=stop)),
}


@pytest.fixture
def logged(caplog: pytest.LogCaptureFixture) -> Iterator[SimpleQueue[logging.LogRecord]]:
    """Everything that is logged from INFO on, as it comes."""
    caplog.set_level(logging.INFO)
    records: SimpleQueue[logging.LogRecord] = SimpleQueue()
    handler = QueueHandler(records)
    logging.getLogger().addHandler(handler)
    yield records
    logging.getLogger().removeHandler(handler)


@pytest.mark.parametrize("name", PROCESSES)
def test_loss_of_all_links_is_logged_as_an_error_and_that_they_are_back_as_news(
    name: str, session: FakeSession, logged: SimpleQueue[logging.LogRecord], monkeypatch: pytest.MonkeyPatch
) -> None:
    def level_of(text: str) -> str:
        return next(record.levelname for record in iter(lambda: logged.get(timeout=TIMEOUT_S), None) if text in record.getMessage())

    monkeypatch.setattr(connection, "LOOK_INTERVAL_S", 0.001)
    session.links, session.connects_to = 1, "tcp/127.0.0.1:7447"
    begun, main = PROCESSES[name]
    stop = Event()
    process = Thread(target=main, args=(stop,))
    process.start()
    try:
        assert level_of(begun) == "INFO"
        session.links = 0
        assert level_of("all links to other processes are lost") == "ERROR"
        session.links = 1
        assert level_of("linked to others again") == "INFO"
    finally:
        stop.set()
        process.join()
