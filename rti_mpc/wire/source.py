# SPDX-License-Identifier: Apache-2.0
"""
One source a key.

Several processes may publish on one key: a robot that was started twice, a
planner forgotten in another terminal. A receiver locks to one epoch and takes
nothing else, unless the epoch is higher (a restart) or nothing of its own was
accepted for long: a single message of whatever number deafens nobody for longer.
Its own epoch under other numbers must have counted on for as long, too: what is
sent again by somebody who has recorded it does not.
"""

from __future__ import annotations

from enum import Enum

from rti_mpc.contract.epoch import MAX_SEQ_GAP


class Verdict(Enum):
    """What a message is to a receiver."""

    NEW = "new"  # accepted, the first of a source, or of another count of it: whatever is remembered of the last no longer holds
    NEXT = "next"  # accepted
    REPEATED = "repeated"  # refused: the last accepted message once more, as caches send it
    OLD = "old"  # refused: a later sequence number was accepted before
    AHEAD = "ahead"  # refused: so many messages are not lost between two
    FOREIGN = "foreign"  # refused: somebody else's, while our source is alive

    @property
    def accepted(self) -> bool:
        """Whether the message may be used."""
        return self in (Verdict.NEW, Verdict.NEXT)


class Source:
    """
    The source a receiver is locked to.

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
        self._other_count = (2**64, 0)  # the last number that was refused of our epoch, and since when those went up

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
