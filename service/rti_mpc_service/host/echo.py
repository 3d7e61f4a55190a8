# SPDX-License-Identifier: Apache-2.0
"""
The floor under every latency: a bare echo over the same bus, in a process of its own.

A message of a state's size goes out, one of a command's size comes back, and
nothing is computed between. `python -m rti_mpc_service.host.echo ENDPOINT PREFIX ROBOT BYTES`
answers; `Echo` asks, half a period after each sample, so that the two do
not get into each other's way.
"""

from __future__ import annotations

import sys
import time
from threading import Thread

from rti_mpc.contract.message import Command, State
from rti_mpc.wire.bus import Bus, BusSettings, Publisher, Subscriber
from rti_mpc.wire.cdr import encode
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.streams import PING, PONG
from rti_mpc_service import entry

ROLE = "echo"


class Pinger:
    """
    Asks.

    Attributes:
        round_trip_us: Every answer's time so far.
    """

    def __init__(self, bus: Bus, state: State) -> None:
        """
        Begin.

        Args:
            bus: Where the answering process is.
            state: What is sent.
        """
        self.round_trip_us: list[float] = []
        self._payload = encode(state)
        self._pings = bus.publisher(bus.keys.of(PING))
        self._pongs = bus.subscriber(bus.keys.of(PONG))

    def ping(self) -> bool:
        """Ask once; return whether there was an answer before the bus was closed."""
        self._pongs.drain()
        sent_ns = time.monotonic_ns()
        self._pings.put_bytes(self._payload)
        if self._pongs.recv() is None:
            return False
        self.round_trip_us.append(1e-3 * (time.monotonic_ns() - sent_ns))
        return True


class Echo(Pinger):
    """Pings, at the pace of telemetry."""

    def __init__(self, bus: Bus, state: State, pause_s: float) -> None:
        """
        Begin.

        Args:
            bus: Where telemetry and the answering process are.
            state: What is sent.
            pause_s: From hearing of a sample to the next ping.
        """
        super().__init__(bus, state)
        self._pause_s = pause_s
        self._samples = bus.subscriber(bus.keys.telemetry)
        Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        """Ping until the bus is closed."""
        for _ in iter(self._samples.recv, None):
            time.sleep(self._pause_s)
            if not self.ping():
                return


def main(settings: BusSettings, keys: Keys, size: int) -> None:
    """Answer every ping with so many bytes, until stopped."""
    stop = stop_on_signals()
    with Bus.join(settings, keys) as bus:
        pings, pongs = bus.subscriber(keys.of(PING)), bus.publisher(keys.of(PONG))
        bus.alive(ROLE)
        Thread(target=_answer, args=(pings, pongs, bytes(size)), daemon=True).start()
        stop.wait()


def _answer(pings: Subscriber, pongs: Publisher[Command], payload: bytes) -> None:
    """Receive, send, and nothing else."""
    while pings.recv() is not None:
        pongs.put_bytes(payload)


if __name__ == "__main__":
    _, endpoint, prefix, robot, size = sys.argv
    entry.enter(lambda: main(BusSettings(connect=(endpoint,)), Keys(prefix, robot), int(size)))
