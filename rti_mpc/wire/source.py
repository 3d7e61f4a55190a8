# SPDX-License-Identifier: Apache-2.0
"""
Source of a stream: the one publisher per key that a receiver accepts.

Several processes may publish on one key: a robot that was started twice, a planner
forgotten in another terminal. A receiver locks to one epoch and accepts no other, unless
the epoch is higher (a restart) or no message of its own epoch was accepted for the stale
time. So a single message with any number blocks a receiver for no longer than that. If
the same epoch goes on under other numbers, these must have increased for the stale time
as well, which a recording that is sent again does not do.
"""

from __future__ import annotations

from enum import Enum

from rti_mpc.contract.epoch import MAX_SEQ_GAP


class Verdict(Enum):
    """Verdict on a message."""

    NEW = "new"  # accepted: the first message of a source, or of a new numbering; what was remembered of the last source does not hold any more
    NEXT = "next"  # accepted
    REPEATED = "repeated"  # refused: the last accepted message again, as caches send it
    OLD = "old"  # refused: a later sequence number was accepted before
    AHEAD = "ahead"  # refused: the gap in sequence numbers is too large for lost messages
    FOREIGN = "foreign"  # refused: from another source, while the present one is alive

    @property
    def accepted(self) -> bool:
        """Whether the message may be used."""
        return self in (Verdict.NEW, Verdict.NEXT)


class Source:
    """
    The source that a receiver is locked to.

    Attributes:
        stale_ns: Time without an accepted message after which another epoch may take over, even a lower one.
        epoch: Epoch of the source, None before the first message.
        seq: Sequence number of its last accepted message.
        lost: Messages missing between accepted ones.
        dropped: Messages refused.
    """

    def __init__(self, stale_ns: int) -> None:
        self.stale_ns = stale_ns
        self.epoch: int | None = None
        self.seq = 0
        self.lost = 0
        self.dropped = 0
        self._accepted_ns = 0
        self._other_count = (2**64, 0)  # last refused number of the source's epoch, and time since which such numbers increase

    def accept(self, epoch: int, seq: int, now_ns: int) -> Verdict:
        """
        Judge a message by its first two fields.

        Args:
            epoch: Epoch of the message.
            seq: Its sequence number.
            now_ns: Receiver's monotonic clock.
        """
        verdict = self._judge(epoch, seq, now_ns)
        if not verdict.accepted:
            self.dropped += 1
            return verdict
        if verdict is Verdict.NEXT:
            self.lost += seq - self.seq - 1
        self.epoch, self.seq, self._accepted_ns = epoch, seq, now_ns
        return verdict

    def _judge(self, epoch: int, seq: int, now_ns: int) -> Verdict:
        if epoch == self.epoch and seq == self.seq:
            return Verdict.REPEATED
        if epoch == self.epoch and self.seq < seq <= self.seq + MAX_SEQ_GAP:
            return Verdict.NEXT
        since_ns = self._accepted_ns
        if epoch == self.epoch:
            last, begun_ns = self._other_count
            begun_ns = begun_ns if last < seq <= last + MAX_SEQ_GAP else now_ns
            self._other_count, since_ns = (seq, begun_ns), max(since_ns, begun_ns)
        if self.epoch is None or epoch > self.epoch or now_ns - since_ns > self.stale_ns:
            return Verdict.NEW
        return Verdict.FOREIGN if epoch < self.epoch else Verdict.OLD if seq < self.seq else Verdict.AHEAD
