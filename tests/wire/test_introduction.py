# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import State
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.introduction import listens
from rti_mpc.wire.keys import Keys
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.wire.test_bus import eventually

KEYS = Keys(robot="test")
ESTABLISHED = "01"


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def buses(endpoint: str) -> Iterator[list[Bus]]:
    """Three peers: one at the rendezvous, and two that have met there."""
    with ExitStack() as stack:
        yield [stack.enter_context(Bus.join(BusSettings(connect=(endpoint,), listen=listen), KEYS)) for listen in ((endpoint,), (), ())]


def port(endpoint: str) -> int:
    return int(endpoint.rpartition(":")[2])


def connections() -> list[tuple[int, int, int]]:
    """File number and ports of both ends, this one first, of all open connections of this process with itself."""
    files = {}
    for path in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):
            files[os.readlink(path)] = int(path.name)
    found = []
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        _, here, there, state, *_, number = line.split()[:10]
        if state == ESTABLISHED and (socket_name := f"socket:[{number}]") in files:
            found.append((files[socket_name], int(here.rpartition(":")[2], 16), int(there.rpartition(":")[2], 16)))
    ends = {(here, there) for _, here, there in found}
    return [(number, here, there) for number, here, there in found if (there, here) in ends]


def cut(keep: int) -> int:
    """Break all connections between sessions of this process but those with a port; return how many ends there were."""
    ends = []
    for number, *ports in connections():
        if keep not in ports:
            with suppress(OSError):  # closed since it was listed
                ends.append(socket.socket(fileno=os.dup(number)))
    for end in ends:
        with suppress(OSError), end:  # closed by the other end, which is broken already
            end.shutdown(socket.SHUT_RDWR)
    return len(ends)


def heard(sender: Bus, receiver: Bus) -> bool:
    """Whether messages arrive, waiting for the first."""
    states, seen = sender.publisher(KEYS.state), receiver.subscriber(KEYS.state)

    def look() -> bool:
        states.put(State(1, 1, 0, np.zeros(5)))
        return seen.try_recv() is not None

    return eventually(look)


def test_peers_that_have_met_by_gossip_meet_again_after_their_link_is_lost(buses: list[Bus], endpoint: str) -> None:
    _, guard, controller = buses
    for _ in range(3):
        assert heard(controller, guard)
        assert heard(guard, controller)
        assert cut(keep=port(endpoint)) >= 2, "both ends of a connection"


def test_peer_that_has_ended_is_not_looked_for(buses: list[Bus], endpoint: str) -> None:
    """Nor one that was a guest, whose end would have the others look for it."""
    robot, guard, controller = buses
    assert heard(controller, guard)
    guests: list[int] = []
    for bus in (robot, controller):
        introduction: Callable[..., object] = bus._session._introduction._guest  # type: ignore[attr-defined]
        bus._session._introduction._guest = lambda join=introduction: guests.append(1) or join()  # type: ignore[attr-defined]
    guard.close()
    lost = [bus._session._introduction for bus in (robot, controller)]  # type: ignore[attr-defined]
    eventually(lambda: all(len(one._links) == 1 and not one._lost for one in lost))
    assert not guests


def test_end_is_only_called_gone_if_its_host_says_so(endpoint: str) -> None:
    assert not listens(endpoint)
    with socket.create_server(("127.0.0.1", port(endpoint))):
        assert listens(endpoint)
        assert listens(endpoint.replace("tcp/", "tls/"))
    assert listens("udp/127.0.0.1:9")
    assert listens("tcp/nowhere.invalid:7447")


def test_no_thread_of_a_session_is_left_when_it_has_closed(buses: list[Bus], endpoint: str) -> None:
    _, guard, controller = buses
    assert heard(controller, guard)
    before = [thread for bus in buses for thread in bus._session._following]  # type: ignore[attr-defined]
    assert [thread.name for thread in before] == len(buses) * ["introduction"]
    cut(keep=port(endpoint))
    for bus in buses:
        bus.close()
    deadline_s = time.monotonic() + 60.0
    for thread in before:
        thread.join(max(0.0, deadline_s - time.monotonic()))
        assert not thread.is_alive()
