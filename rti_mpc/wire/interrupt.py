# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C, SIGTERM and a terminal that hangs up as an event that loops look at: nothing is cut off halfway."""

from __future__ import annotations

import signal
from threading import Event, Thread
from types import FrameType


def stop_on_signals() -> Event:
    """Return an event that is set by SIGINT, SIGTERM and SIGHUP, by the last not where it is ignored, as under nohup; call it in the main thread."""
    stop = Event()

    def handle(_number: int, _frame: FrameType | None) -> None:
        Thread(target=stop.set, daemon=True).start()  # not here: the main thread may hold the event's lock, inside `stop.wait`

    hangup = getattr(signal, "SIGHUP", None)  # not on every system
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:
        signal.signal(hangup, handle)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handle)
    return stop
