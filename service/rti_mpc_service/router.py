# SPDX-License-Identifier: Apache-2.0
"""Zenoh router in Python, for hosts without zenohd. It forwards between clients and stores nothing."""

from __future__ import annotations

import logging
from dataclasses import replace
from threading import Event

from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.session import open_endpoints

log = logging.getLogger("router")


def main(settings: BusSettings, keys: Keys, *, stop: Event | None = None) -> None:
    """
    Route until stopped.

    Args:
        settings: How to join the bus; the mode is the router's, and without an endpoint to listen on it takes the rendezvous.
        keys: Where to show presence, as `router`.
        stop: Event that stops the router; None: SIGINT, SIGTERM and SIGHUP do.

    Raises:
        ConfigError: If an endpoint is taken, or Zenoh refuses a setting.
    """
    stop = stop or stop_on_signals()
    settings = replace(settings, mode="router")
    for endpoint in open_endpoints(settings):
        log.warning(f"{endpoint} is open: whoever reaches it can command the robot; use TLS, see `rti-mpc certs`")
    with Bus.join(settings, keys, stop=stop, say=log.warning) as bus:
        bus.alive("router")
        bus.watch_connection(lambda notice: log.log(notice.severity.level, notice.text))
        log.info("routing")
        stop.wait()
    log.info("stopped")
