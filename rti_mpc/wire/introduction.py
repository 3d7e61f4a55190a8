# SPDX-License-Identifier: Apache-2.0
"""
Introduction of peers that have lost the link between them to each other.

Peers meet by gossip: who links to a peer is told of the others, once. Zenoh makes links to
the endpoints of the configuration again and again, those of gossip never. So two peers that
lose the link between them, while both keep theirs to the rendezvous, would stay unlinked
until a further process joins: a guard that was held up for about as long as the lease would
wait for its controller for ever. A guest that joins for a moment has all told of each other anew.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from typing import Any

import zenoh

from rti_mpc.errors import ConfigError
from rti_mpc.wire.handshake import ADDRESS

PAUSE_S = 0.1  # before a peer that was lost is looked for, and between two guests
VISIT_S = 0.3  # for which a guest stays: links take 4 ms on an idle host, and Zenoh keeps those to a peer that leaves within 50 ms for good
CONNECT_TIMEOUT_S = 0.5  # for the answer of a lost peer's endpoint
GIVE_UP_S = 30.0  # after a loss; a peer that hangs for longer than the lease loses all its links, and meets the others anew when it goes on


class Introduction:
    """Links of one session to peers, each made again where it is lost and the peer has not ended."""

    def __init__(self, peers: Callable[[], set[str]], guest: Callable[[], AbstractContextManager[object]], over: threading.Event) -> None:
        """
        Begin without links.

        Args:
            peers: Returns the numbers of the peers that the session is linked to.
            guest: Joins as a further peer, until the context ends.
            over: Ends the search for lost peers when set.
        """
        self._peers, self._guest, self._over = peers, guest, over
        self._links: dict[str, dict[str, bool]] = {}  # by peer: far ends of its links, and whether each is open
        self._lost: dict[str, tuple[list[str], float]] = {}  # by peer: far ends of the links that it had, and when they were lost

    def follow(self, listener: Any) -> None:
        """Act on the link events of a session, in the thread that calls, until the session is closed."""
        with suppress(zenoh.ZError):  # it is
            while True:
                self._note(listener.recv())
                while self._lost and not self._over.wait(PAUSE_S):
                    for event in iter(listener.try_recv, None):
                        self._note(event)
                    self._look()

    def _note(self, event: zenoh.LinkEvent) -> None:
        """Follow a link that was made or lost."""
        peer, end = str(event.link.zid), event.link.dst
        links = self._links.setdefault(peer, {})
        links[end] = event.kind == zenoh.SampleKind.PUT
        if not any(links.values()):
            self._lost[peer] = list(self._links.pop(peer)), time.monotonic()

    def _look(self) -> None:
        """Join as a guest if a peer is lost that has not ended."""
        now_s, peers = time.monotonic(), self._peers()
        self._lost = {
            peer: (ends, since_s)
            for peer, (ends, since_s) in self._lost.items()
            if peer not in peers and now_s - since_s < GIVE_UP_S and any(map(listens, ends))
        }
        if self._lost:
            with suppress(zenoh.ZError, ConfigError), self._guest():  # tried again
                self._over.wait(VISIT_S)


def listens(end: str) -> bool:
    """Whether a process may listen at an endpoint of Zenoh: false if the host says that none does."""
    match = ADDRESS.match(end)
    if match is None or match["protocol"] not in ("tcp", "tls"):
        return True
    try:
        socket.create_connection((match["v6"] or match["host"], int(match["port"])), CONNECT_TIMEOUT_S).close()
    except ConnectionRefusedError:
        return False
    except OSError:
        return True
    return True
