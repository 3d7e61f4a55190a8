# SPDX-License-Identifier: Apache-2.0
"""Second process of the bus tests: ``python peer.py WHAT ENDPOINT [listen]``; runs until it is killed or its work is done."""

from __future__ import annotations

import sys
import threading

import numpy as np

from rti_mpc.contract.message import Command, End, Event, Reference, Severity, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.cdr import decode
from rti_mpc.wire.keys import Keys
from rti_mpc_service.entry import enter

KEYS = Keys(robot="test")
FAST = ("transport/link/tx/lease:600",)  # ms: hangs are noticed soon


def echo(bus: Bus) -> None:
    """Answer every state with a command of its number, and with ten long events as load."""
    states = bus.subscriber(KEYS.state)
    commands = bus.publisher(KEYS.command)
    telemetry = bus.publisher(KEYS.telemetry)
    bus.alive("controller")
    while (received := states.recv()) is not None:
        state = decode(State, received.payload)
        commands.put(Command(1, state.seq, 0, 1, state.seq, 0, 1, 0, Mode.TRACKING, QpStatus.SOLVED, 10**8, np.ones((7, 2))))
        for seq in range(10):
            telemetry.put(Event(1, seq, 0, "controller", Severity.INFO, "load", 6000 * "x"))


def watch(bus: Bus) -> None:
    """Read telemetry, like a viewer."""
    telemetry = bus.subscriber(KEYS.telemetry)
    bus.alive("viewer")
    while telemetry.recv() is not None:
        pass


def plan(bus: Bus) -> None:
    """Publish one reference and stay."""
    reference = Reference(1, 1, 0, 10**8, End.HOLD, np.arange(6.0).reshape(2, 3), np.zeros((2, 0)))
    bus.publisher(KEYS.reference).put(reference)
    threading.Event().wait()


def farewell(bus: Bus) -> None:
    """Send a last message and leave."""
    bus.publisher(KEYS.state).put(State(1, 1, 0, np.zeros(5)))
    bus.close()


def careless(bus: Bus) -> None:
    """Leave with everything open and threads waiting."""
    threading.Thread(target=bus.subscriber(KEYS.state).recv, daemon=True).start()
    bus.subscriber(KEYS.events)
    bus.publisher(KEYS.event("x"))
    bus.serve(KEYS.request, lambda request: request)
    bus.watch_alive(lambda role, present: None)


if __name__ == "__main__":
    what, endpoint, *listen = sys.argv[1:]
    settings = BusSettings(listen=(endpoint,) if listen else (), connect=(endpoint,), cfg=FAST)
    enter(lambda: globals()[what](Bus.join(settings, KEYS)))  # as every process of ours: the interpreter is not finalized around threads of Zenoh
