# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C, SIGTERM and a terminal that hangs up as an event that loops look at: nothing is cut off halfway."""

from __future__ import annotations

import os
import signal
from threading import Event, Thread


def stop_on_signals() -> Event:
    """
    Return an event that is set by SIGINT, SIGTERM and SIGHUP, by the last not where it is ignored, as under nohup.

    Call it in the main thread. The event is set by a thread of its own: the kernel
    may hand a signal to any thread, of Zenoh's too, and a main thread that waits
    for the event would then not wake up to handle it; nor may it set the event
    itself, whose lock it may hold.
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
