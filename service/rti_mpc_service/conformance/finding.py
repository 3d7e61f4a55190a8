# SPDX-License-Identifier: Apache-2.0
"""Findings of a conformance test: the cases of a contract, what was seen in each, and the verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rti_mpc_service.host.hold_up import Host

ATTEMPTS = 3  # for a case that the host has disturbed
SEEN_SHARE = 0.8  # share of a delay that the witness sees at least, where the host is the reason

T = TypeVar("T")


class Unseen(Exception):
    """
    A case cannot be judged; the text says why.

    Attributes:
        late_ms: Delay of the host that would explain it; 0: none would.
    """

    def __init__(self, reason: str, late_ms: float = 0.0) -> None:
        super().__init__(reason)
        self.late_ms = late_ms


@dataclass(frozen=True)
class Finding:
    """
    What was seen in one case.

    Attributes:
        kept: Whether the promise is kept; None if it is not visible.
        seen: What was seen, in words.
        late_ms: Delay of the host that would explain that it is not; 0: none would.
    """

    kept: bool | None
    seen: str
    late_ms: float = 0.0


@dataclass(frozen=True)
class Case(Generic[T]):
    """
    One promise of a contract.

    Attributes:
        name: Its name.
        promise: What is right, in words.
        mend: What to do if it is broken.
        judge: Sets it up with whatever is judged, and tells what was seen; raises `Unseen` if nothing can be told.
    """

    name: str
    promise: str
    mend: str
    judge: Callable[[T], Finding]


@dataclass(frozen=True)
class Judgement:
    """
    Verdict on one case.

    Attributes:
        case: The case.
        finding: What was seen.
        excused: Whether delays of the host alone explain that it is broken or not visible.
    """

    case: Case[Any]
    finding: Finding
    excused: bool = False

    @property
    def broken(self) -> bool:
        """Whether the promise is broken, and the host does not explain it."""
        return self.finding.kept is False and not self.excused

    @property
    def verdict(self) -> str:
        """The verdict, in a word or two."""
        if self.excused:
            return "host"
        return {True: "yes", False: "NO", None: "not visible"}[self.finding.kept]

    def to_json(self) -> dict[str, Any]:
        """Return everything, in JSON."""
        told = {"name": self.case.name, "promise": self.case.promise, "verdict": self.verdict, "seen": self.finding.seen}
        return told | ({"mend": self.case.mend} if self.broken else {})


def judgements(cases: Sequence[Case[T]], judged: T, host: Host | None) -> Iterator[Judgement]:
    """Yield the judgement of each case; one that delays of the host explain is tried again, `ATTEMPTS` times in all. Without a host none does."""
    for case in cases:
        for _ in range(ATTEMPTS):
            since_ns = time.monotonic_ns()
            try:
                finding = case.judge(judged)
            except Unseen as reason:
                finding = Finding(None, str(reason), reason.late_ms)
            held_up_ms = 0.0
            if not finding.kept and finding.late_ms > 0.0 and host is not None:
                held_up_ms = host.held_up_ms(since_ns, time.monotonic_ns())
            judgement = Judgement(case, finding, held_up_ms > 0.0 and held_up_ms >= SEEN_SHARE * finding.late_ms)
            if not judgement.excused:
                break
        yield judgement
