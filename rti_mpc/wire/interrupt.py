# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM as an event that loops look at: nothing is cut off halfway."""

from __future__ import annotations

import signal
from threading import Event
from types import FrameType


def stop_on_signals() -> Event:
    """Return an event that is set by SIGINT and SIGTERM; call it in the main thread."""
    stop = Event()

    def handle(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handle)
    return stop
