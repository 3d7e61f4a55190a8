# SPDX-License-Identifier: Apache-2.0
"""
Bare echo over the same bus, in a process of its own: the lower limit of every latency.

A message of a state's size goes out, one of a command's size comes back, and
nothing is computed in between. `python -m rti_mpc_service.host.echo ENDPOINT PREFIX ROBOT BYTES`
answers. `Echo` sends its pings half a period after each sample, so that pings
and samples do not disturb each other.
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
    Sends pings and measures how long the answers take.

    Attributes:
        round_trip_us: Round-trip time of every answered ping so far.
    """

    def __init__(self, bus: Bus, state: State) -> None:
        """
        Open the publisher and the subscriber.

        Args:
            bus: Bus of the answering process.
            state: The message that is sent as a ping.
        """
        self.round_trip_us: list[float] = []
        self._payload = encode(state)
        self._pings = bus.publisher(bus.keys.of(PING))
        self._pongs = bus.subscriber(bus.keys.of(PONG))

    def ping(self) -> bool:
        """Send a ping and wait for its answer; return False if the bus was closed before it came."""
        self._pongs.drain()
        sent_ns = time.monotonic_ns()
        self._pings.put_bytes(self._payload)
        if self._pongs.recv() is None:
            return False
        self.round_trip_us.append(1e-3 * (time.monotonic_ns() - sent_ns))
        return True


class Echo(Pinger):
    """Sends one ping after each message of telemetry."""

    def __init__(self, bus: Bus, state: State, pause_s: float) -> None:
        """
        Start the thread that sends pings.

        Args:
            bus: Bus of telemetry and of the answering process.
            state: The message that is sent as a ping.
            pause_s: Time from the telemetry of a sample to the ping.
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
    """Answer every ping with a message of `size` bytes, until stopped."""
    stop = stop_on_signals()
    with Bus.join(settings, keys) as bus:
        pings, pongs = bus.subscriber(keys.of(PING)), bus.publisher(keys.of(PONG))
        bus.alive(ROLE)
        Thread(target=_answer, args=(pings, pongs, bytes(size)), daemon=True).start()
        stop.wait()


def _answer(pings: Subscriber, pongs: Publisher[Command], payload: bytes) -> None:
    """Answer each ping; a thread of its own."""
    while pings.recv() is not None:
        pongs.put_bytes(payload)


if __name__ == "__main__":
    _, endpoint, prefix, robot, size = sys.argv
    entry.enter(lambda: main(BusSettings(connect=(endpoint,)), Keys(prefix, robot), int(size)))
