# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM as an event that loops look at: nothing is cut off halfway."""

from __future__ import annotations

import signal
from threading import Event, Thread
from types import FrameType


def stop_on_signals() -> Event:
    """Return an event that is set by SIGINT and SIGTERM; call it in the main thread."""
    stop = Event()

    def handle(_number: int, _frame: FrameType | None) -> None:
        Thread(target=stop.set, daemon=True).start()  # not here: the main thread may hold the event's lock, inside `stop.wait`

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handle)
    return stop
