# SPDX-License-Identifier: Apache-2.0
"""Rerun viewers that this process starts or finds: a window, or a page that this machine serves to browsers, on loopback alone."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
from pathlib import Path
from threading import Event
from urllib.parse import quote, urlsplit

from rti_mpc.errors import ConfigError, Stopped

RERUN_ADDRESS = "127.0.0.1:9876"
CONNECT_TIMEOUT_S = 30.0  # for a viewer that is starting
VIEWER_ENDED = "the Rerun viewer has ended; where there is no screen, --rerun-save records to a file"
MEMORY_LIMIT = re.compile(r"[0-9]+(\.[0-9]+)?\s?(%|[kKMGT]?i?B)")  # Rerun takes any text, and has no limit then
END_TIMEOUT_S = 3.0


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
    options = ["--bind", "127.0.0.1", "--port", _port(url), "--memory-limit", memory_limit, "--expect-data-soon"]
    return subprocess.Popen([sys.executable, "-m", "rerun_cli", *options], start_new_session=True, stdin=subprocess.DEVNULL)


def serve_page(url: str, web_port: int, memory_limit: str) -> subprocess.Popen[bytes]:
    """
    Start a server of Rerun's page for browsers, which comes from this machine, on loopback; end it by `end_page`.

    Raises:
        ConfigError: The URL is not one of this machine.
    """
    import rerun_cli

    binary = Path(rerun_cli.__file__).with_name("rerun")  # the module is a wrapper whose child would be left over
    options = ["--serve-web", "--bind", "127.0.0.1", "--port", _port(url), "--web-viewer-port", str(web_port), "--server-memory-limit", memory_limit]
    return subprocess.Popen([binary, *options], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def end_page(server: subprocess.Popen[bytes]) -> None:
    """End a server of pages."""
    server.terminate()
    try:
        server.wait(END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        server.kill()
        server.wait()


def page(url: str, web_port: int) -> str:
    """Return the address at which a browser shows what is sent to a URL."""
    return f"http://127.0.0.1:{web_port}/?url={quote(url, safe='')}"


def check_memory_limit(limit: str) -> None:
    """
    Refuse what is no size of a memory.

    Raises:
        ConfigError: As said.
    """
    if MEMORY_LIMIT.fullmatch(limit) is None:
        raise ConfigError(f"rerun-memory-limit must be a share such as 25% or a size such as 2GB, got {limit!r}")


def reached(url: str, stop: Event, viewer: subprocess.Popen[bytes] | None = None) -> None:
    """
    Wait until a viewer listens.

    Args:
        url: Where.
        stop: Ends the wait.
        viewer: The process that is to listen there, if this one has started it.

    Raises:
        ConfigError: It does not in time, or has ended.
        Stopped: Before it did.
    """
    address, deadline_s = urlsplit(url), time.monotonic() + CONNECT_TIMEOUT_S
    while not stop.wait(0.05):
        try:
            socket.create_connection((address.hostname or "127.0.0.1", address.port or 9876), 1.0).close()
            return
        except OSError:
            if viewer is not None and viewer.poll() is not None:
                raise ConfigError(VIEWER_ENDED) from None
            if time.monotonic() > deadline_s:
                raise ConfigError(f"a Rerun viewer must listen at {url} within {CONNECT_TIMEOUT_S:g} s, none does") from None
    raise Stopped(f"stopped before a viewer listened at {url}")


def _port(url: str) -> str:
    """Return the port of a URL of this machine."""
    address = urlsplit(url)
    if address.hostname not in ("127.0.0.1", "localhost"):
        raise ConfigError(f"rerun-spawn must be on 127.0.0.1, got {url!r}")
    return str(address.port)
