# SPDX-License-Identifier: Apache-2.0
"""
Latch of an operator's stop, which every controller and guard of a robot keeps and publishes.

A change takes one more than the highest counter known. Of two latches the one with the
higher counter wins, of equal counters the one that stops: this is the order of `Latch`.
So all processes that hear of each other agree in the end, whatever the order of their
messages, and a restarted process learns from the others what it has forgotten.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rti_mpc.errors import MessageError

MAX_COUNTER = 2**62  # a latch with a higher counter is refused
MAX_COUNTER_LEAP = 2**20  # steps above the highest counter known: nobody misses so many changes, and forged latches take years to reach `MAX_COUNTER`
MAX_REASON_CHARS = 200
UTC_TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", re.ASCII)


@dataclass(frozen=True, order=True, slots=True)
class Latch:
    """
    An operator's last word: stopped or released. Of two latches the greater one holds.

    Attributes:
        counter: Number of changes so far, 0 before the first.
        stopped: Whether the robot must stand.
        when: UTC time of the change, such as ``2026-11-28T09:30:00Z``; empty before the first.
        reason: Who asked for the change, or why.
    """

    counter: int = 0
    stopped: bool = False
    when: str = ""
    reason: str = ""

    def change(self, *, stopped: bool, reason: str, when: str) -> Latch:
        """Return the latch after an operator's word: this one if it is in that state already."""
        return self if self.stopped == stopped else Latch(self.counter + 1, stopped, when, reason)

    def __str__(self) -> str:
        since = f" since {self.when}" if self.when else ""
        return f"{'stopped' if self.stopped else 'released'}{since}: {self.reason or 'never stopped'}"


def merge(known: Latch, heard: Latch) -> Latch:
    """Return which of two latches holds; one whose counter is too far ahead is not believed."""
    return max(known, heard) if heard.counter - known.counter <= MAX_COUNTER_LEAP else known


def read_latch(content: object) -> Latch:
    """
    Return the latch in a JSON object of a file or a message.

    Raises:
        MessageError: A field is missing or out of range.
    """
    if not isinstance(content, Mapping):
        raise MessageError("latch must be an object")
    fields: dict[str, Any] = {name: content.get(name) for name in Latch.__slots__}
    counter, stopped, when, reason = fields.values()
    if type(counter) is not int or not 0 <= counter <= MAX_COUNTER:
        raise MessageError(f"latch.counter must be a whole number from 0 to 2^62, got {shown(counter)}")
    if type(stopped) is not bool:
        raise MessageError(f"latch.stopped must be true or false, got {shown(stopped)}")
    if not isinstance(when, str) or (when and not UTC_TIME.fullmatch(when)):
        raise MessageError(f"latch.when must be a UTC time such as 2026-11-28T09:30:00Z, got {shown(when)}")
    if not isinstance(reason, str) or len(reason) > MAX_REASON_CHARS or not reason.isprintable():
        raise MessageError(f"latch.reason must be printable, of at most {MAX_REASON_CHARS} characters, got {shown(reason)}")
    return Latch(**fields)


def shown(value: object) -> str:
    """Return a value as text, cut to what fits on a line."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
