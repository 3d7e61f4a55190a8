# SPDX-License-Identifier: Apache-2.0
"""Live viewer: a separate process that listens to one robot and draws it in Rerun."""

from __future__ import annotations

import logging
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event

from rti_mpc.contract.message import Notice, Severity
from rti_mpc.wire.announcer import Announcer
from rti_mpc.wire.bus import Bus, BusSettings, new_epoch
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.reach import remind
from rti_mpc_service.announce import announce
from rti_mpc_service.view.listener import DRAIN_PERIOD_NS, Listener
from rti_mpc_service.view.outlet import Outlet, file_outlet, load_arrow, viewer_outlet
from rti_mpc_service.view.screen import RERUN_ADDRESS, VIEWER_ENDED, check_memory_limit, end_page, page, reached, serve_page, spawn_viewer, viewer_url

ROLE = "viewer"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Screens:
    """
    Where to draw; in a spawned viewer if neither a viewer, nor a file, nor a page is given.

    Raises:
        ConfigError: A size is none.

    Attributes:
        rerun_spawn: Whether to start a viewer on this machine, listening on loopback; it stays open afterwards.
        rerun_connect: Address of a viewer, which may start later: ``HOST:PORT``, or a URL of Rerun.
        rerun_save: File to record to, overwritten.
        rerun_memory_limit: Memory a spawned viewer may fill before it forgets the oldest.
        web_port: Port at which to serve a page for browsers, on loopback; None: none is served.
    """

    rerun_spawn: bool = False
    rerun_connect: str | None = None
    rerun_save: Path | None = None
    rerun_memory_limit: str = "25%"
    web_port: int | None = None

    def __post_init__(self) -> None:
        """Check what Rerun does not."""
        check_memory_limit(self.rerun_memory_limit)

    @property
    def url(self) -> str:
        """
        Rerun's URL of the viewer.

        Raises:
            ConfigError: The address is none.
        """
        return viewer_url(RERUN_ADDRESS if self.rerun_connect is None else self.rerun_connect)

    @property
    def spawned(self) -> bool:
        """Whether a viewer is started."""
        return self.rerun_spawn or (self.rerun_connect is None and self.rerun_save is None and self.web_port is None)

    @property
    def shown(self) -> bool:
        """Whether anything but a file is drawn into."""
        return self.spawned or self.rerun_connect is not None or self.web_port is not None


def main(bus_settings: BusSettings, keys: Keys, screens: Screens, *, robots: Sequence[str] = (), stop: Event | None = None) -> int:
    """
    Draw a robot until stopped.

    Args:
        bus_settings: How to join the bus.
        keys: Where the robot's streams are.
        screens: Where to draw.
        robots: Names of several robots below the same prefix, to draw in one view instead.
        stop: Event that stops the process; None: SIGINT and SIGTERM do.

    Returns:
        Exit status: 1 if a received message is missing in the recording, else 0.

    Raises:
        ConfigError: An address, a file or the name of a robot is not valid.
    """
    url = screens.url
    stop = stop or stop_on_signals()
    names = [*dict.fromkeys(robots)] or [keys.robot]
    drawn = [Keys(keys.prefix, name) for name in names]
    with Bus.join(bus_settings, keys, stop=stop, say=log.warning) as bus:
        roots, begun_ns = (names, time.monotonic_ns()) if len(names) > 1 else ((), None)
        buses = [bus if one == keys else bus.beside(one) for one in drawn]
        listeners = [Listener(one, root=one.keys.robot if roots else "", begun_ns=begun_ns) for one in buses]
        for one, listener in zip(buses, listeners, strict=True):
            one.expect("message", partial(getattr, listener, "received"))
        load_arrow()
        for one in buses:
            one.alive(ROLE)
        title = " and ".join(names)
        outlets = [file_outlet(screens.rerun_save, title, roots)] if screens.rerun_save is not None else []
        spawned = spawn_viewer(url, screens.rerun_memory_limit) if screens.spawned else None
        server = None if screens.web_port is None else serve_page(url, screens.web_port, screens.rerun_memory_limit)
        if screens.web_port is not None:
            log.info("open %s", page(url, screens.web_port))
        if screens.shown:
            outlets.append(viewer_outlet(url, title, roots))
        log.info("listening to %s", " and ".join(one.keys.below("*") for one in buses))
        announcer = Announcer(buses[0], ROLE, new_epoch())
        bus.watch_connection(lambda notice: announce(log, announcer, notice, listeners[0].now_ns))
        pump(listeners, outlets, spawned, announcer, stop)
    counts = (sum(getattr(listener, name) for listener in listeners) for name in ("received", "lost", "refused"))
    log.info("%d messages, %d lost, %d refused", *counts)
    complete = [outlet.close() for outlet in outlets]
    if server is not None:
        end_page(server)
    for notice in notices(outlets):
        log.error("%s", notice.text)
    return 0 if screens.rerun_save is None or complete[0] else 1


def pump(
    listeners: Sequence[Listener],
    outlets: Sequence[Outlet],
    spawned: subprocess.Popen[bytes] | None,
    announcer: Announcer,
    stop: Event,
) -> None:
    """Pass messages on until stopped, then the remaining ones; announce failures of an outlet or viewer on the bus and to all outlets."""
    stopped = False
    while not stopped:
        stopped = stop.wait(1e-9 * DRAIN_PERIOD_NS)
        entries = [entry for listener in listeners for entry in listener.drain()]
        said = notices(outlets)
        if spawned is not None and spawned.poll() is not None:
            said.append(Notice(Severity.WARNING, "viewer_ended", VIEWER_ENDED))
            spawned = None
        for notice in said:
            announce(log, announcer, notice, listeners[0].now_ns)
            entries.append(listeners[0].own_entry(notice))
        for outlet in outlets:
            outlet.offer(entries)


def notices(outlets: Sequence[Outlet]) -> list[Notice]:
    """Return the outlets' notices, and remove them there."""
    return [outlet.notices.popleft() for outlet in outlets for _ in range(len(outlet.notices))]


def show(path: Path, screens: Screens, *, stop: Event | None = None) -> int:
    """
    Draw a recording whole, where `main` draws a robot live, and return the exit status; serve a page until stopped.

    Args:
        path: The recording, or the folder of its segments.
        screens: Where to draw.
        stop: As in `main`.

    Raises:
        ConfigError: It is no recording, an address or a file is not valid, or no viewer answers.
    """
    from rti_mpc_service.opened import opened  # needs the extra `record`
    from rti_mpc_service.view.show import draw_in_viewer, draw_into_file

    recording, url = opened(path), screens.url
    log.info("drawing %s", path)
    if screens.rerun_save is not None:
        draw_into_file(recording, screens.rerun_save)
        log.info("drawn into %s, which `rerun %s` shows", screens.rerun_save, screens.rerun_save)
    if not screens.shown:
        return 0
    stop = stop or stop_on_signals()
    server = None if screens.web_port is None else serve_page(url, screens.web_port, screens.rerun_memory_limit)
    viewer = spawn_viewer(url, screens.rerun_memory_limit) if server is None and screens.rerun_connect is None else None
    waited = Event()
    remind(log.warning, lambda: f"no viewer answers yet at {url}", waited)
    try:
        reached(url, stop, viewer)
        waited.set()
        draw_in_viewer(recording, path.stem, url)
        if screens.web_port is not None:
            log.info("open %s", page(url, screens.web_port))
            stop.wait()
    finally:
        waited.set()
        if server is not None:
            end_page(server)
    return 0
