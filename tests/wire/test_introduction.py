# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import State
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.introduction import HELD_UP_S, LOOK_INTERVAL_S, Introduction
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


def hold_up(bus: Bus) -> None:
    """Have a process believe that it was held up."""
    bus._session._introduction.looked_s -= 2.0 * HELD_UP_S  # type: ignore[attr-defined]


def test_peer_that_was_held_up_meets_again_those_that_have_given_it_up(buses: list[Bus], endpoint: str) -> None:
    _, guard, controller = buses
    eventually(lambda: len(guard._session._introduction._met) == 2)  # type: ignore[attr-defined]
    for _ in range(3):
        assert heard(controller, guard)
        assert heard(guard, controller)
        assert cut(keep=port(endpoint)) >= 2, "both ends of a connection"
        hold_up(guard)


class Invited:
    """A session's peers, and how many guests were invited; a lost link is never made again."""

    def __init__(self) -> None:
        self.linked, self.guests = {"robot", "controller"}, 0
        self.introduction = Introduction(lambda: set(self.linked), self._guest, threading.Event())
        self.introduction._over.wait = lambda _=None: False  # type: ignore[method-assign]
        self.now_s = self.introduction.looked_s
        self.look()

    def _guest(self) -> AbstractContextManager[None]:
        self.guests += 1
        return nullcontext()

    def look(self, after_s: float = LOOK_INTERVAL_S) -> None:
        self.now_s += after_s
        self.introduction._look(self.now_s)
        self.introduction.looked_s = self.now_s


def test_only_who_was_held_up_and_has_lost_a_link_invites_guests_and_no_more_than_a_few() -> None:
    held_up, running, unharmed, alone = (Invited() for _ in range(4))
    for one in (held_up, unharmed, alone):
        one.look(HELD_UP_S + 1.0)
    assert [one.guests for one in (held_up, unharmed, alone)] == [0, 0, 0], "no link is known to be lost yet"
    for one in (held_up, running):
        one.linked.discard("controller")
    alone.linked.clear()
    for one in (held_up, running, unharmed, alone):
        for _ in range(100):
            one.look()
    assert [one.guests for one in (held_up, running, unharmed, alone)] == [6, 0, 0, 0]
    held_up.look(HELD_UP_S + 1.0)
    assert held_up.guests == 6, "what was lost long ago is not looked for"


def test_no_thread_of_a_session_is_left_when_it_has_closed(buses: list[Bus], endpoint: str) -> None:
    _, guard, controller = buses
    assert heard(controller, guard)
    before = [thread for bus in buses for thread in bus._session._following]  # type: ignore[attr-defined]
    assert [thread.name for thread in before] == len(buses) * ["introduction"]
    cut(keep=port(endpoint))
    for bus in buses:
        hold_up(bus)
        bus.close()
    deadline_s = time.monotonic() + 60.0
    for thread in before:
        thread.join(max(0.0, deadline_s - time.monotonic()))
        assert not thread.is_alive()
