# SPDX-License-Identifier: Apache-2.0
"""Link that can be cut: a TCP proxy on loopback that holds all data back while it is cut, and loses none."""

from __future__ import annotations

import socket
from contextlib import suppress
from threading import Event, Thread

CHUNK_BYTES = 65536


class Proxy:
    """
    Forwards connections to an endpoint.

    While the link is cut, connections stay open and sent data wait, as in the
    buffers of a network: the data that arrive after the cut are old.

    Attributes:
        endpoint: Endpoint of the proxy.
    """

    def __init__(self, endpoint: str) -> None:
        host, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
        self._target = host, int(port)
        self._passing = Event()
        self._passing.set()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open: list[socket.socket] = []
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Let nothing pass."""
        self._passing.clear()

    def restore(self) -> None:
        """Let everything pass, what has waited first."""
        self._passing.set()

    def close(self) -> None:
        """Close all connections, and take no more."""
        self._passing.set()
        for opened in (self._listener, *self._open):
            with suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)
            opened.close()

    def _accept(self) -> None:
        """Connect whoever comes; a thread of its own."""
        with suppress(OSError):  # closed
            while True:
                near, _ = self._listener.accept()
                try:
                    far = socket.create_connection(self._target)
                except OSError:  # the target refuses, so the proxy does
                    near.close()
                    continue
                self._open += near, far
                for source, sink in ((near, far), (far, near)):
                    source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    Thread(target=self._pump, args=(source, sink), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        """Forward one direction of a connection until either end closes; a thread of its own."""
        with suppress(OSError):
            while data := source.recv(CHUNK_BYTES):
                self._passing.wait()
                sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
