# SPDX-License-Identifier: Apache-2.0
"""Event that is set by Ctrl-C, SIGTERM or the end of the terminal: loops check it, so nothing is interrupted halfway."""

from __future__ import annotations

import os
import signal
from threading import Event, Thread


def stop_on_signals() -> Event:
    """
    Return an event that is set by SIGINT, SIGTERM and SIGHUP; by SIGHUP only if it is not ignored, as under nohup.

    Call it in the main thread. A separate thread sets the event: the kernel may deliver
    a signal to any thread, also to one of Zenoh's, and a main thread that waits for the
    event would then not wake up to handle it. Nor may a signal handler in the main
    thread set the event, because that thread may hold its lock.
    """
    stop = Event()
    numbers = {signal.SIGINT, signal.SIGTERM}
    hangup = getattr(signal, "SIGHUP", None)  # not on every system
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:
        numbers.add(hangup)
    reader, writer = os.pipe()
    os.set_blocking(writer, False)

    def watch() -> None:
        while received := os.read(reader, 64):
            if numbers & set(received):
                stop.set()

    Thread(target=watch, name="signals", daemon=True).start()
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in numbers:
        signal.signal(number, lambda *_: None)
    return stop
