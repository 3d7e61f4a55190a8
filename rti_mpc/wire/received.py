# SPDX-License-Identifier: Apache-2.0
"""Payload that a session has received."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Received:
    """
    A payload as it came, not decoded yet.

    Attributes:
        payload: Bytes of the payload; empty if they are more than the key allows.
        encoding: Encoding that the sender declares.
        key: Key on which it was published.
        withheld: Number of bytes sent, if `payload` is empty because they were too many; else 0.
    """

    payload: bytes
    encoding: str
    key: str
    withheld: int = 0

    @property
    def size(self) -> int:
        """Number of bytes that were sent."""
        return self.withheld or len(self.payload)


WOKEN = Received(b"", "", "")  # what a waiting receiver gets that was woken without a message
