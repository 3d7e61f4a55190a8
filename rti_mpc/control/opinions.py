# SPDX-License-Identifier: Apache-2.0
"""Second opinions about the plans of a controller: which samples have one, and whether the two solvers go on to disagree."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from rti_mpc import given
from rti_mpc.contract.message import Notice, Severity
from rti_mpc.contract.status import DISAGREEMENT, QpStatus
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.second_opinion import SecondOpinion, osqp_solved

LASTING = 3  # opinions in a row that disagree before it is told
RELIABLE = 100  # opinions in a row that agree before that is told: where bounds decide, a wrong gradient makes no difference for a while


class Opinion(NamedTuple):
    """
    What became of a second opinion.

    Attributes:
        seq: Sequence number of the command whose plan was judged; 0: none was.
        status: As `SecondOpinion.status`; NONE: it was cut short by the next sample.
        difference: As `SecondOpinion.difference`.
        iterations: Iterations of OSQP.
    """

    seq: int = 0
    status: QpStatus = QpStatus.NONE
    difference: float = math.nan
    iterations: int = 0


class Opinions:
    """
    Second opinions of one controller.

    Attributes:
        last: What became of that about the plan before the last one.
        disagree: Whether the solvers disagree.
    """

    def __init__(self, rti: Rti, every: int, say: Callable[[Notice], object]) -> None:
        """
        Begin without an opinion.

        Args:
            rti: Real-time iteration whose plans are judged.
            every: Plans from one that is judged to the next.
            say: Receiver of notices.
        """
        self.last = Opinion()
        self.disagree = False
        self._rti = rti
        self._every = every
        self._say = say
        self._opinion = SecondOpinion(rti)
        self._contrary = 0
        self._count = 0
        self._seq = 0  # of the plan in hand, 0: none
        self._certified = False  # whether that plan was SOLVED

    def keep(self, seq: int, *, planned: bool) -> None:
        """
        Begin the opinion about a new plan, before the next sample is prepared.

        Args:
            seq: Sequence number of its command.
            planned: Whether the last sample had a plan of its own that acts.
        """
        opinion = self._opinion
        self.last = Opinion(self._seq, opinion.status, opinion.difference, opinion.iterations) if self._seq else Opinion()
        self._seq = 0
        if not planned or osqp_solved(self._rti):
            return
        self._count += 1
        if self._count % self._every == 0:
            self._seq, self._certified = seq, self._rti.status is QpStatus.SOLVED
            opinion.keep()

    def step(self) -> bool:
        """Do a piece of the opinion about the last plan, and return whether nothing is left to be done."""
        opinion = self._opinion
        if not self._seq or opinion.done:
            return True
        opinion.step()
        if opinion.status is QpStatus.SOLVED and self._certified:
            self._judge(opinion.difference)
        return opinion.done

    def rewarm(self) -> None:
        """Let OSQP's workspace depend on nothing but arrays, see `Solver.rewarm`."""
        self._opinion.rewarm()

    def _judge(self, difference: float) -> None:
        """Tell when the solvers begin to disagree, and when they agree again."""
        self._contrary = self._contrary + 1 if (difference > DISAGREEMENT) is not self.disagree else 0
        if self._contrary < (RELIABLE if self.disagree else LASTING):
            return
        self.disagree, self._contrary = not self.disagree, 0
        if self.disagree:
            text = f"OSQP's plans differ by more than {DISAGREEMENT:g} of half an input's range, by {difference:.2g} in the last of {LASTING} samples"
            self._say(Notice(Severity.WARNING, "solvers_disagree", f"{text}: one of the two solvers is wrong"))
        else:
            self._say(Notice(Severity.INFO, "solvers_agree", f"OSQP's plans have been the same again in {RELIABLE} samples"))


def second_opinions(rti: Rti, every: int, say: Callable[[Notice], object]) -> Opinions | None:
    """Return the second opinions about every so many plans; None if that is 0, or if the plans are OSQP's own."""
    given.whole("second_opinion", every, 0)
    return Opinions(rti, every, say) if every and not (rti.active_set is None and osqp_solved(rti)) else None
