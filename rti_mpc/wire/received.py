# SPDX-License-Identifier: Apache-2.0
"""Payload as a session hands it over."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Received:
    """
    A payload as it came, not yet looked at.

    Attributes:
        payload: Its bytes; none where they are more than its key takes.
        encoding: What the sender says they are.
        key: Where it was published.
        withheld: How many bytes were sent, where there are none in `payload` for it.
    """

    payload: bytes
    encoding: str
    key: str
    withheld: int = 0

    @property
    def size(self) -> int:
        """How many bytes were sent."""
        return self.withheld or len(self.payload)
