# SPDX-License-Identifier: Apache-2.0
"""
Introduction of a process that was held up to the peers that have given it up meanwhile.

Peers meet by gossip: who links to a peer is told of the others, once. Zenoh makes links to
the endpoints of the configuration again and again, those of gossip never. So a guard that
was held up for about as long as a link is waited for might lose its link to the controller
and keep the one to the robot, and would wait for commands until a further process joins. A
guest that joins for a moment has all told of each other anew. Only who was held up invites one,
and no more than a few: many guests at once would leave links behind.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress

import zenoh

from rti_mpc.errors import ConfigError

LOOK_INTERVAL_S = 0.25
HELD_UP_S = 1.0  # between two looks, after which others may have given this process up: they do after 1.5 to 2 s without a word
WATCHED_S = 20.0  # after that, in which lost links are noticed
PAUSE_S = 0.5  # after the first guest, twice as long after each further one, since the other side may give a link up later: six at most
VISIT_S = 0.5  # for which a guest stays: links take 4 ms on an idle host, and Zenoh keeps those to a peer that leaves within 50 ms for good


class Introduction:
    """
    Links of one session to peers, made again where they were lost while the process was held up.

    Attributes:
        looked_s: When it has looked last, by the monotonic clock.

    Args:
        peers: Returns the numbers of the peers that the session is linked to.
        guest: Joins as a further peer, until the context ends.
        over: Ends it when set.
    """

    def __init__(self, peers: Callable[[], set[str]], guest: Callable[[], AbstractContextManager[object]], over: threading.Event) -> None:
        self._peers, self._guest, self._over = peers, guest, over
        self.looked_s = now_s = time.monotonic()
        self._met = set[str]()  # peers, when this process was last known to run
        self._pause_s, self._next_s, self._watched_until_s = PAUSE_S, now_s, now_s

    def follow(self) -> None:
        """Look from time to time, in the thread that calls, until the session is closed."""
        with suppress(zenoh.ZError):  # it is
            while not self._over.wait(LOOK_INTERVAL_S):
                self._look(time.monotonic())
                self.looked_s = time.monotonic()

    def _look(self, now_s: float) -> None:
        """Invite a guest if links were lost while this process was held up, and not all of them: then it meets the others as at its start."""
        if now_s - self.looked_s > HELD_UP_S:
            self._pause_s, self._next_s, self._watched_until_s = PAUSE_S, now_s, now_s + WATCHED_S
        peers = self._peers()
        if now_s > self._watched_until_s:
            self._met = peers
        elif now_s >= self._next_s and peers and not self._met <= peers:
            self._next_s, self._pause_s = now_s + self._pause_s, 2.0 * self._pause_s
            with suppress(zenoh.ZError, ConfigError), self._guest():  # tried again
                self._over.wait(VISIT_S)
