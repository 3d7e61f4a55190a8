# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
import time
from collections.abc import Callable
from queue import Queue

import numpy as np
import pytest

from rti_mpc.contract.message import State
from rti_mpc.errors import ConfigError, Stopped
from rti_mpc.wire import reach
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.rig.endpoint import free_endpoint

KEYS = Keys(robot="test")
PATIENCE_S = 30.0


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reach, "FIRST_REMINDER_S", 0.3)
    monkeypatch.setattr(reach, "REMINDER_INTERVAL_S", 0.1)


def expecting(bus: Bus) -> Callable[[], bool]:
    """Expect a state; return whether one has come."""
    states, heard = bus.subscriber(KEYS.state), threading.Event()

    def look() -> bool:
        if states.try_recv() is not None:
            heard.set()
        return heard.is_set()

    bus.expect("state", look)
    return heard.is_set


REASONS = {
    "tcp/127.0.0.1:9": "no process listens there, or the address is wrong",
    "tls/127.0.0.1:9": "no process listens there, or the address is wrong",
    "tcp/nowhere.invalid:7447": "this host does not know that name",
    "udp/127.0.0.1:9": "no process listens there, or the address is wrong",
}


@pytest.mark.parametrize("address", REASONS)
def test_process_that_reaches_nobody_says_so_again_and_again(address: str) -> None:
    said: Queue[str] = Queue()
    with Bus.join(BusSettings(connect=(address,)), KEYS, say=said.put) as bus:
        expecting(bus)
        for _ in range(3):
            text = said.get(timeout=PATIENCE_S)
            assert text == f"not connected, no state yet: no process answers at {address}: {REASONS[address]}"


def test_process_that_waits_to_be_reached_says_that_nobody_has_come() -> None:
    said: Queue[str] = Queue()
    with Bus.join(BusSettings(listen=(free_endpoint(),), connect=()), KEYS, say=said.put) as bus:
        expecting(bus)
        assert said.get(timeout=PATIENCE_S) == "not connected, no state yet: no process has connected yet"


def test_process_that_is_linked_says_what_does_not_come_until_it_has_come() -> None:
    endpoint, said = free_endpoint(), Queue[str]()
    with (
        Bus.join(BusSettings(listen=(endpoint,), connect=()), KEYS) as robot,
        Bus.join(BusSettings(connect=(endpoint,)), KEYS, say=said.put) as bus,
    ):
        heard = expecting(bus)
        text = "no state of rti_mpc/test yet, from 1 other on the bus: is it running, under this name?"
        while said.get(timeout=PATIENCE_S) != text:  # the link is made in its own time
            pass
        states, seq, deadline_s = robot.publisher(KEYS.state), 0, time.monotonic() + PATIENCE_S
        while not heard():
            states.put(State(1, seq := seq + 1, seq, np.zeros(5)))
            time.sleep(0.01)
            assert time.monotonic() < deadline_s
        watching = [thread for thread in threading.enumerate() if thread.name == "reach"]
        for thread in watching:
            thread.join(PATIENCE_S)
            assert not thread.is_alive(), "nothing more is said"


def test_client_that_waits_for_a_while_only_is_refused_with_the_reason() -> None:
    with pytest.raises(ConfigError, match=r"none has answered at tcp/127\.0\.0\.1:9: no process listens there"):
        Bus.join(BusSettings(mode="client", connect=("tcp/127.0.0.1:9",)), KEYS, timeout_s=0.1)


def test_client_without_a_router_says_so_and_ends_well_when_it_is_stopped() -> None:
    said, stop = Queue[str](), threading.Event()

    def say(text: str) -> None:
        said.put(text)
        if said.qsize() == 2:
            stop.set()

    with pytest.raises(Stopped, match="stopped before a router was there"):
        Bus.join(BusSettings(mode="client", connect=("tcp/127.0.0.1:9",)), KEYS, stop=stop, say=say)
    assert said.get() == "not connected: no router answers at tcp/127.0.0.1:9: no process listens there, or the address is wrong"
