# SPDX-License-Identifier: Apache-2.0
"""The router: a Zenoh router in Python, for hosts without zenohd. It forwards between clients and keeps nothing."""

from __future__ import annotations

import logging
import signal
from dataclasses import replace
from threading import Event
from types import FrameType

from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.keys import Keys

log = logging.getLogger("router")


def main(settings: BusSettings, keys: Keys) -> None:
    """
    Route until interrupted or terminated.

    Args:
        settings: How to join the bus; the mode is the router's, and without an endpoint to listen on it takes the rendezvous.
        keys: Where to show presence, as `router`.

    Raises:
        ConfigError: If an endpoint is taken, or Zenoh refuses a setting.
    """
    done = Event()

    def stop(number: int, frame: FrameType | None) -> None:
        done.set()

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with Bus(replace(settings, mode="router"), keys) as bus:
            bus.alive("router")
            log.info("routing")
            done.wait()
        log.info("stopped")
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
