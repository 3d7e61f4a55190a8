# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from rti_mpc_service.faults.proxy import Proxy

SOON_S, QUIET_S = 5.0, 0.1


@pytest.fixture
def ends() -> Iterator[tuple[Proxy, socket.socket, socket.socket]]:
    """A proxy, and a connection through it: the end that connected, and the end that was connected to."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        proxy = Proxy(f"tcp/127.0.0.1:{server.getsockname()[1]}")
        near = socket.create_connection(("127.0.0.1", int(proxy.endpoint.rpartition(":")[2])), timeout=SOON_S)
        server.settimeout(SOON_S)
        far, _ = server.accept()
        far.settimeout(SOON_S)
        with near, far:
            yield proxy, near, far
        proxy.close()


def test_bytes_pass_both_ways(ends: tuple[Proxy, socket.socket, socket.socket]) -> None:
    _, near, far = ends
    near.sendall(b"state")
    assert far.recv(64) == b"state"
    far.sendall(b"command")
    assert near.recv(64) == b"command"


def test_nothing_passes_a_link_that_is_cut_and_what_has_waited_comes_when_it_is_restored(ends: tuple[Proxy, socket.socket, socket.socket]) -> None:
    proxy, near, far = ends
    proxy.cut()
    near.sendall(b"old")
    far.settimeout(QUIET_S)
    with pytest.raises(TimeoutError):
        far.recv(64)
    far.settimeout(SOON_S)
    proxy.restore()
    assert far.recv(64) == b"old"


def test_end_of_a_connection_is_passed_on(ends: tuple[Proxy, socket.socket, socket.socket]) -> None:
    _, near, far = ends
    near.close()
    assert far.recv(64) == b""


def test_whoever_connects_where_nobody_listens_is_sent_away() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    proxy = Proxy(f"tcp/127.0.0.1:{port}")
    with socket.create_connection(("127.0.0.1", int(proxy.endpoint.rpartition(":")[2])), timeout=SOON_S) as near:
        assert near.recv(64) == b""
    proxy.close()
