# SPDX-License-Identifier: Apache-2.0
"""Live viewer: a separate process that listens to one robot and draws it in Rerun."""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from urllib.parse import urlsplit

from rti_mpc.contract.message import Notice, Severity
from rti_mpc.errors import ConfigError
from rti_mpc.wire.announcer import Announcer
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Keys
from rti_mpc_service.announce import announce
from rti_mpc_service.view.listener import Listener
from rti_mpc_service.view.outlet import Outlet, file_outlet, viewer_outlet

ROLE = "viewer"
RERUN_ADDRESS = "127.0.0.1:9876"
DRAIN_PERIOD_S = 0.05

log = logging.getLogger(__name__)


def main(
    bus_settings: BusSettings,
    keys: Keys,
    *,
    rerun_spawn: bool = False,
    rerun_connect: str | None = None,
    rerun_save: Path | None = None,
    rerun_memory_limit: str = "25%",
    stop: Event | None = None,
) -> int:
    """
    Draw a robot until stopped; in a spawned viewer if neither a viewer nor a file is given.

    Args:
        bus_settings: How to join the bus.
        keys: Where the robot's streams are.
        rerun_spawn: Whether to start a viewer on this machine, listening on loopback; it stays open afterwards.
        rerun_connect: Address of a viewer, which may start later: ``HOST:PORT``, or a URL of Rerun.
        rerun_save: File to record to, overwritten.
        rerun_memory_limit: Memory a spawned viewer may fill before it forgets the oldest.
        stop: Event that stops the process; None: SIGINT and SIGTERM do.

    Returns:
        Exit status: 1 if a received message is missing in the recording, else 0.

    Raises:
        ConfigError: An address or a file is not valid.
    """
    rerun_spawn |= rerun_connect is None and rerun_save is None
    url = viewer_url(rerun_connect or RERUN_ADDRESS)
    stop = stop or stop_on_signals()
    with Bus.join(bus_settings, keys, stop=stop, say=log.warning) as bus:
        listener = Listener(bus)
        bus.expect("message", lambda: listener.received)
        outlets = [file_outlet(rerun_save, keys.robot)] if rerun_save is not None else []
        spawned = spawn_viewer(url, rerun_memory_limit) if rerun_spawn else None
        if rerun_spawn or rerun_connect is not None:
            outlets.append(viewer_outlet(url, keys.robot))
        bus.alive(ROLE)
        log.info("listening to %s", keys.below("*"))
        announcer = Announcer(bus, ROLE, time.time_ns() // 1_000_000_000)
        bus.watch_certificate(lambda notice: announce(log, announcer, notice, listener.now_ns))
        pump(listener, outlets, spawned, announcer, stop)
    log.info("%d messages, %d lost, %d refused", listener.received, listener.lost, listener.refused)
    complete = [outlet.close() for outlet in outlets]
    for notice in notices(outlets):
        log.error("%s", notice.text)
    return 0 if rerun_save is None or complete[0] else 1


def pump(listener: Listener, outlets: Sequence[Outlet], spawned: subprocess.Popen[bytes] | None, announcer: Announcer, stop: Event) -> None:
    """Pass messages on until stopped, then the remaining ones; announce failures of an outlet or viewer on the bus and to all outlets."""
    stopped = False
    while not stopped:
        stopped = stop.wait(DRAIN_PERIOD_S)
        entries = listener.drain()
        said = notices(outlets)
        if spawned is not None and spawned.poll() is not None:
            text = "the Rerun viewer has ended; where there is no screen, --rerun-save records to a file"
            said.append(Notice(Severity.WARNING, "viewer_ended", text))
            spawned = None
        for notice in said:
            announce(log, announcer, notice, listener.now_ns)
            entries.append(listener.own_entry(notice))
        for outlet in outlets:
            outlet.offer(entries)


def notices(outlets: Sequence[Outlet]) -> list[Notice]:
    """Return the outlets' notices, and remove them there."""
    return [outlet.notices.popleft() for outlet in outlets for _ in range(len(outlet.notices))]


def viewer_url(address: str) -> str:
    """
    Return Rerun's URL of an address, which is ``HOST:PORT`` or already such a URL.

    Raises:
        ConfigError: The address is neither.
    """
    url = address if "://" in address else f"rerun+http://{address}/proxy"
    try:
        parts = urlsplit(url)
        valid = parts.scheme.startswith("rerun") and bool(parts.hostname) and bool(parts.port)
    except ValueError:
        valid = False
    if not valid:
        raise ConfigError(f"rerun-connect must be HOST:PORT or rerun+http://HOST:PORT/proxy, got {address!r}")
    return url


def spawn_viewer(url: str, memory_limit: str) -> subprocess.Popen[bytes]:
    """
    Start a viewer on loopback that outlives this process.

    Rerun's own `spawn` listens on all interfaces.

    Raises:
        ConfigError: The URL is not one of this machine.
    """
    address = urlsplit(url)
    if address.hostname not in ("127.0.0.1", "localhost"):
        raise ConfigError(f"rerun-spawn must be on 127.0.0.1, got {url!r}")
    options = ["--bind", "127.0.0.1", "--port", str(address.port), "--memory-limit", memory_limit, "--expect-data-soon"]
    return subprocess.Popen([sys.executable, "-m", "rerun_cli", *options], start_new_session=True, stdin=subprocess.DEVNULL)
