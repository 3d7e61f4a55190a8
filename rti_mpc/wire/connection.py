# SPDX-License-Identifier: Apache-2.0
"""
Watch of a process over its connection: whether all links to others are lost, as when its router has died, and when they are back.

Zenoh makes links again by itself and says nothing. Without this, an operator reads only of messages that do not come.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event, Thread

from rti_mpc.contract.message import Notice, Severity

LOOK_INTERVAL_S = 0.5  # between two looks, each of which takes about 1 us


def watch(links: Callable[[], int | None], why: Callable[[], str], tell: Callable[[Notice], object], over: Event) -> None:
    """
    Report, in a thread of its own, that all links are lost, and that there are links again.

    Args:
        links: Returns the number of links; None once the session is closed, which ends the watch.
        why: Returns why there is none, in words; empty where others are to connect, whose absence is no fault.
        tell: Receiver of notices.
        over: Ends the watch when set.
    """

    def follow() -> None:
        linked, lost_s = began > 0, 0.0
        while not over.wait(LOOK_INTERVAL_S) and (count := links()) is not None:
            if count and lost_s:
                tell(Notice(Severity.INFO, "linked", f"linked to others again after {time.monotonic() - lost_s:.1f} s"))
                lost_s = 0.0
            elif linked and not count and not lost_s:
                since_s, text = time.monotonic(), why()  # which may take seconds
                if text and not over.is_set():
                    lost_s = since_s
                    tell(Notice(Severity.ERROR, "unlinked", f"all links to other processes are lost: {text}", change=True))
            linked = count > 0 or linked

    began = links() or 0
    Thread(target=follow, name="connection", daemon=True).start()
