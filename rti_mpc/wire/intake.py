# SPDX-License-Identifier: Apache-2.0
"""Intake of a receiver: every payload of a peer becomes a message or a count, never an exception."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from struct import error as StructError
from typing import Generic

from rti_mpc.contract.epoch import EPOCH_LEAD, highest_believed
from rti_mpc.contract.message import Notice, Reference, Severity, State
from rti_mpc.wire.cdr import MESSAGE_VERSION, M, Message, Refused, decode, encode, encoding
from rti_mpc.wire.layout import MAX_PAYLOAD_BYTES
from rti_mpc.wire.received import Received
from rti_mpc.wire.source import Source, Verdict

OPTIONAL_ARRAYS = {(Reference, "p"), (State, "u")}  # arrays that may be left out: nominal parameters, inputs that are not reported
MAX_QUOTED_CHARS = 120  # of an encoding that a notice quotes


def taken(message: Message) -> bytes:
    """
    Return the bytes of a message that receivers take.

    Raises:
        Refused: They would refuse it, where its sender does not hear of it.
    """
    try:
        payload = encode(message)
    except StructError as error:
        raise Refused("value", f"integers must fit into their fields, got: {error}") from None
    decode(type(message), payload)
    return payload


class Intake(Generic[M]):
    """
    Receiver of the messages of one class from one source.

    Attributes:
        source: The source that the receiver is locked to, with its counts of lost and dropped messages.
        refused: Count of refused payloads by reason: one of `rti_mpc.wire.cdr.REFUSAL_REASONS`, or of `unfit`.
    """

    def __init__(
        self,
        cls: type[M],
        stale_s: float,
        widths: Mapping[str, int] | None = None,
        quiet_s: float = 1.0,
        unix_s: Callable[[], int] = lambda: 0,
        choosing: bool = False,
        unfit: Callable[[M], str] = lambda _: "",
    ) -> None:
        """
        Begin without a source.

        Args:
            cls: Class of the messages.
            stale_s: Time without an accepted message after which another source may take over.
            widths: Numbers that a row must have, by the name of the array, such as ``{"x": 5}``; those of `OPTIONAL_ARRAYS` may be left out.
            quiet_s: Shortest time between two notices of one code.
            unix_s: Returns the Unix time in s, which limits epochs, see `rti_mpc.contract.epoch.highest_believed`.
            choosing: Whether an epoch is to be chosen above those heard.
            unfit: Returns why a message is not for this receiver, as a code such as ``foreign_epoch``; empty if it is. The source of a
                message that is unfit is not judged.
        """
        self.source = Source(round(1e9 * stale_s))
        self.refused: Counter[str] = Counter()
        self._cls = cls
        self._name = cls.__name__.lower()
        self._unix_s = unix_s
        self._choosing = choosing
        self._unfit = unfit
        self._encoding = encoding(cls)
        self._widths = tuple((widths or {}).items())
        self._quiet_ns = round(1e9 * quiet_s)
        self._last = b""  # the last payload that was a message
        self._pending: dict[str, Notice] = {}
        self._said_ns: dict[str, int] = {}

    def read(self, received: Received, known: int = 0) -> M | None:
        """
        Return the message in a payload of any sender; None if it is malformed, or its epoch is not believed.

        Args:
            received: Payload and encoding as they came.
            known: Highest epoch that the caller follows, besides the one of `source`.
        """
        try:
            if received.encoding != self._encoding:
                raise self._encoding_error(received.encoding)
            if received.size > MAX_PAYLOAD_BYTES[self._cls]:
                raise Refused("oversized", f"message must have at most {MAX_PAYLOAD_BYTES[self._cls]} bytes, got {received.size}")
            message = decode(self._cls, received.payload)
            for name, width in self._widths:
                self._check_width(message, name, width)
            if message.epoch > EPOCH_LEAD:  # higher than any epoch of a correct clock: the clock is only read in this case
                self._check_epoch(message.epoch, max(known, self.source.epoch or 0))
        except Refused as error:
            self.refused[error.reason] += 1
            self._note(Severity.WARNING, "message_refused", f"{error}; {self.refused.total()} refused so far")
            return None
        self._last = received.payload
        return message

    def rehearse(self) -> None:
        """Decode the last message once more, and change nothing: the next one then finds warm caches."""
        if self._last:
            decode(self._cls, self._last)

    def accept(self, received: Received, now_ns: int) -> M | None:
        """
        Return the message in a payload; None if it is malformed, repeated or not from the source.

        Args:
            received: Payload and encoding as they came.
            now_ns: Receiver's monotonic clock.
        """
        message = self.read(received)
        if message is None:
            return None
        if reason := self._unfit(message):
            self.refused[reason] += 1
            text = f"epoch {message.epoch}, seq {message.seq} was refused: {reason.replace('_', ' ')}"
            self._note(Severity.WARNING, f"{self._name}_{reason}", text)
            return None
        before = self.source.epoch
        verdict = self.source.accept(message.epoch, message.seq, now_ns)
        if verdict is Verdict.NEXT:
            return message
        if verdict is Verdict.NEW:
            if before is not None:
                self._note(Severity.INFO, "source_changed", f"epoch {message.epoch} took over from {before}")
            return message
        if verdict is not Verdict.REPEATED:
            text = f"epoch {message.epoch}, seq {message.seq} is {verdict.value}: ours is epoch {self.source.epoch}, seq {self.source.seq}"
            self._note(Severity.WARNING, "source_refused", f"{text}; {self.source.dropped} dropped so far")
        return None

    def newest(self, waiting: Iterable[Received], now_ns: int) -> M | None:
        """Return the last message that is accepted among several payloads, oldest first; None if none is."""
        message = None
        for received in waiting:
            message = self.accept(received, now_ns) or message
        return message

    def newest_of_each(self, waiting: Iterable[Received], counts: Callable[[M], bool] = lambda _: True) -> list[M]:
        """
        Return the last message of each epoch among several payloads, for a receiver that judges all sources itself.

        Args:
            waiting: Payloads, oldest first.
            counts: Whether a message continues those received before: one that does not, such as a replayed one, replaces no other.
        """
        newest: dict[int, M] = {}
        for received in waiting:
            if (message := self.read(received)) is None:
                continue
            before = newest.get(message.epoch)
            if before is None or (counts(message) and not (counts(before) and before.seq > message.seq)):
                newest[message.epoch] = message
        return list(newest.values())

    def highest_epoch(self, waiting: Iterable[Received]) -> int:
        """Return the highest epoch among several payloads of any sender; 0 if none is a message."""
        epoch = 0
        for received in waiting:
            if (message := self.read(received, epoch)) is not None:
                epoch = max(epoch, message.epoch)
        return epoch

    def notices(self, now_ns: int) -> list[Notice]:
        """Take the notices to publish now: the latest per code, and none of a code again before `quiet_s` has passed."""
        if not self._pending:
            return []
        pending = list(self._pending)  # copied at once, since other threads change it
        due = [code for code in pending if now_ns - self._said_ns.get(code, now_ns - self._quiet_ns) >= self._quiet_ns]
        self._said_ns.update(dict.fromkeys(due, now_ns))
        return [notice for code in due if (notice := self._pending.pop(code, None)) is not None]

    def _note(self, severity: Severity, code: str, text: str) -> None:
        self._pending[code] = Notice(severity, code, f"{self._name}: {text}")

    def _check_width(self, message: M, name: str, width: int) -> None:
        got = getattr(message, name).shape[-1]
        if got != width and not (got == 0 and (self._cls, name) in OPTIONAL_ARRAYS):
            raise Refused("length", f"{name} must hold {width} numbers per row, got {got}")

    def _check_epoch(self, epoch: int, known: int) -> None:
        limit = highest_believed(self._unix_s(), known, choosing=self._choosing)
        if epoch > limit:
            raise Refused("epoch", f"epoch must be at most {limit}, got {epoch}")

    def _encoding_error(self, got: str) -> Refused:
        kind, _, schema = got.partition(";")
        expected_kind, _, expected_schema = self._encoding.partition(";")
        name, _, version = schema.partition("@")
        reason = "encoding"
        if kind == expected_kind:
            reason = "version" if name == expected_schema.partition("@")[0] and version != str(MESSAGE_VERSION) else "schema"
        return Refused(reason, f"encoding must be {self._encoding}, got {got[:MAX_QUOTED_CHARS]!r}")
