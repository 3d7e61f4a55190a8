# SPDX-License-Identifier: Apache-2.0
"""Reminder of a message that a process still waits for: soon after the start, and again from time to time until it arrives."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event, Thread

FIRST_REMINDER_S = 2.0  # enough to meet the other processes; with the time of a start the operator is told within 5 s
REMINDER_INTERVAL_S = 60.0  # between later reminders


def remind(say: Callable[[str], object], wanted: Callable[[], str], over: Event) -> None:
    """
    Report what a process waits for, in a thread of its own.

    Args:
        say: Receiver of a line.
        wanted: Returns what is missing and what may be wrong; empty once it has arrived, which ends the reminder.
        over: Ends the reminder when set.
    """

    def watch() -> None:
        pause_s = FIRST_REMINDER_S
        while not over.wait(pause_s) and (text := wanted()):
            say(text)
            pause_s = REMINDER_INTERVAL_S

    Thread(target=watch, name="reach", daemon=True).start()
