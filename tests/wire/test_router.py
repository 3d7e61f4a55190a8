# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from queue import Queue

import numpy as np
import pytest

from rti_mpc.contract.message import Notice, Severity, State
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.in_time import ends_in_time

ROOT = Path(__file__).parents[2]
KEYS = Keys(robot="test")
TIMEOUT_S = 60.0
ROUTER = """
from rti_mpc.wire.bus import BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.entry import enter
from rti_mpc_service.router import main
enter(lambda: main(BusSettings(listen=({!r},)), Keys(robot="test")))
"""


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def router(endpoint: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-c", ROUTER.format(endpoint)]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(ROOT)}) as process:
        yield process
        process.kill()


def test_clients_wait_for_the_router_and_reach_each_other_through_it(router: subprocess.Popen[bytes], endpoint: str) -> None:
    settings = BusSettings(mode="client", connect=(endpoint,))
    with Bus.join(settings, KEYS) as robot, Bus.join(settings, KEYS) as controller:  # the router is still starting
        states, seen = robot.publisher(KEYS.state), controller.subscriber(KEYS.state)
        waiting = threading.Thread(target=seen.recv)
        waiting.start()
        deadline_s = time.monotonic() + TIMEOUT_S
        while waiting.is_alive() and time.monotonic() < deadline_s:
            states.put(State(1, 1, 0, np.zeros(5)))
            waiting.join(0.01)
        assert not waiting.is_alive()


def test_clients_say_that_their_router_is_gone_and_that_it_is_back(router: subprocess.Popen[bytes], endpoint: str) -> None:
    told: Queue[Notice] = Queue()
    with Bus.join(BusSettings(mode="client", connect=(endpoint,)), KEYS) as client:
        client.watch_connection(told.put)
        router.kill()
        lost = told.get(timeout=TIMEOUT_S)
        text = f"all links to other processes are lost: no process answers at {endpoint}: no process listens there, or the address is wrong"
        assert (lost.severity, lost.code, lost.text) == (Severity.ERROR, "unlinked", text)
        with subprocess.Popen([sys.executable, "-c", ROUTER.format(endpoint)], env={**os.environ, "PYTHONPATH": str(ROOT)}) as another:
            try:
                back = told.get(timeout=TIMEOUT_S)
            finally:
                another.kill()
        assert (back.severity, back.code) == (Severity.INFO, "linked")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_router_ends_cleanly_within_a_second(router: subprocess.Popen[bytes], endpoint: str, number: int) -> None:
    with Bus.join(BusSettings(mode="client", connect=(endpoint,)), KEYS) as client:
        assert client.is_alive("router", TIMEOUT_S)
        router.send_signal(number)
        assert ends_in_time(router, "the end", 1000.0) == 0
