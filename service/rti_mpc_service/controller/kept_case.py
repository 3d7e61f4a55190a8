# SPDX-License-Identifier: Apache-2.0
"""
Case of a controller's last sample that failed or was late, kept in its journal.

The thread that controls copies guess and plan after the command has left, into arrays
that it owns. The thread of the journal makes the QP of them, and its bytes. There is
room for one case, and one a second is kept: what else fails is counted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rti_mpc.array import copy, memories
from rti_mpc.contract.message import Command
from rti_mpc.journal.book import Book
from rti_mpc.rti.rti import Rti
from rti_mpc_service.case import about_sample, case_of, inputs_of, qp_on, trouble_of

PERIOD_NS = 1_000_000_000  # local time from one case to the next


class KeptCase:
    """
    Room for one case.

    Attributes:
        missed: Failed or late samples since the last case that were not kept.
    """

    def __init__(self, rti: Rti, book: Book) -> None:
        """
        Begin empty.

        Args:
            rti: Real-time iteration of the controller.
            book: Its journal.
        """
        theirs = rti.guess.arguments | {"x0": rti.guess.x0, "x_plan": rti.guess.plan.x, "u_plan": rti.u}
        ours = {name: array.copy() for name, array in theirs.items()}
        self._pairs = memories((array, theirs[name]) for name, array in ours.items())
        self._plan = ours.pop("x_plan"), ours.pop("u_plan")
        self._arrays = ours
        self._qp = qp_on(rti, ours)
        self._rti, self._book = rti, book
        self._inputs = inputs_of(rti)
        self._about: dict[str, Any] = {}
        self._waits = False  # for the thread of the journal
        self._last_ns: int | None = None
        self.missed = 0

    def note(self, proposal: Command, sent: Command | None, local_ns: int) -> None:
        """
        Keep the sample of a command if it failed or was late, after a command has left and before the next sample is prepared.

        Args:
            proposal: Command of the sample.
            sent: Command in its place, the same if it was in time; None: none was sent.
            local_ns: Local monotonic time.
        """
        why = trouble_of(proposal, sent)
        if not why:
            return
        if self._waits or (self._last_ns is not None and local_ns - self._last_ns < PERIOD_NS):
            self.missed += 1
            return
        copy(self._pairs)
        self._about = {"inputs": self._inputs, **about_sample(self._rti, proposal, why), "not_kept": self.missed}
        self._waits, self._last_ns, self.missed = True, local_ns, 0
        if not self._book.keep(self):
            self._waits, self.missed = False, self._about["not_kept"] + 1

    def encode(self, pause: Callable[[], object]) -> bytes:
        """Return the case as the bytes of its file, and make room for another one; on the thread of the journal."""
        try:
            return case_of(self._qp, self._arrays, *self._plan, self._about, pause).encode(pause)
        finally:
            self._waits = False
