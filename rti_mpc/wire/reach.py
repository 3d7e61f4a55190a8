# SPDX-License-Identifier: Apache-2.0
"""Reminder of what a process still waits for: said soon after the start, and now and then again until it has come."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event, Thread

FIRST_REMINDER_S = 2.0  # enough to meet the other processes; with the time of a start the operator is told within 5 s
REMINDER_INTERVAL_S = 60.0  # between later reminders


def remind(say: Callable[[str], object], wanted: Callable[[], str], over: Event) -> None:
    """
    Say what is wanted, in a thread of its own.

    Args:
        say: Takes a line.
        wanted: What is, and what may be wrong; empty once it has come, which ends the reminder.
        over: Ends it when set.
    """

    def watch() -> None:
        pause_s = FIRST_REMINDER_S
        while not over.wait(pause_s) and (text := wanted()):
            say(text)
            pause_s = REMINDER_INTERVAL_S

    Thread(target=watch, name="reach", daemon=True).start()
