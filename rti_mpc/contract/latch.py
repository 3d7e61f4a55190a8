# SPDX-License-Identifier: Apache-2.0
"""
Latch of an operator's stop: what every controller and guard of a robot keeps, and tells the others.

Whoever changes it takes one more than the highest counter known. Of two latches
the higher counter wins, of equal ones that which stops: the order of `Latch`. So
all who hear of each other agree in the end, whatever the order of messages, and
what a restarted process has forgotten the others tell it.
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
    An operator's last word: stopped or released. The greater one holds.

    Attributes:
        counter: How many changes there were, 0 before the first.
        stopped: Whether the robot is to stand.
        when: UTC time of the change, such as ``2026-11-28T09:30:00Z``; empty before the first.
        reason: Who asked for it, or why it stands.
    """

    counter: int = 0
    stopped: bool = False
    when: str = ""
    reason: str = ""

    def change(self, *, stopped: bool, reason: str, when: str) -> Latch:
        """Return the latch after an operator's word: this one if it says so already."""
        return self if self.stopped == stopped else Latch(self.counter + 1, stopped, when, reason)

    def __str__(self) -> str:
        since = f" since {self.when}" if self.when else ""
        return f"{'stopped' if self.stopped else 'released'}{since}: {self.reason or 'never stopped'}"


def merge(known: Latch, heard: Latch) -> Latch:
    """Return which of two latches holds; one whose counter leaps is not believed."""
    return max(known, heard) if heard.counter - known.counter <= MAX_COUNTER_LEAP else known


def read_latch(content: object) -> Latch:
    """
    Return the latch in a JSON object of a file or a message.

    Raises:
        MessageError: What must hold, and what was got.
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
    """Return a peer's own words, cut to what fits a line."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
