# SPDX-License-Identifier: Apache-2.0
r"""
Way to rest of a command: the inputs that act from the end of its plan on.

Its rows follow each other like those of a plan, and the last one is held. A robot that
needs feedback to come to rest gets states along the way and a gain with it: then

.. math::

    u = u_i - K (x - x_i)

acts, from one state to the next with the deviation of the last one. Nobody who plays
it needs a model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command
from rti_mpc.rotation import Rotations


@dataclass(frozen=True, eq=False, slots=True)
class Way:
    """
    Rows of a way to rest.

    Attributes:
        stamp_ns: When row 0 acts.
        period_ns: Time between rows.
        u: Rows, shape ``(M, nu)``, M at least 1.
        x: States at the beginning of each row, shape ``(M, nx)``; no rows where no feedback is needed.
        K: Gain, shape ``(nu, nx)``; no rows where no feedback is needed.
        correction: What feedback adds to the rows, shape ``(nu,)``; zeros without a state.
    """

    stamp_ns: int
    period_ns: int
    u: Array
    x: Array
    K: Array
    correction: Array

    @classmethod
    def of(cls, command: Command, stamp_ns: int) -> Way | None:
        """Return the way to rest of a command whose plan ends at a time; None if it has none: the inputs ramp to rest then."""
        if not len(command.u_rest):
            return None
        rows, states, gain = (array.copy() for array in (command.u_rest, command.x_rest, command.K))
        return cls(stamp_ns, command.rest_period_ns, rows, states, gain, np.zeros(rows.shape[1]))

    @property
    def feeds_back(self) -> bool:
        """Whether states correct its rows."""
        return len(self.K) > 0

    def row(self, t_ns: int) -> int:
        """Return the row of a time; the last one from its beginning on."""
        return max(0, min((t_ns - self.stamp_ns) // self.period_ns, len(self.u) - 1))

    def ahead(self, t_ns: int) -> Way:
        """Return what of it is left at a time, the row of that time first, which began earlier; the last one, once over, begins again."""
        first = self.row(t_ns)
        began_ns = self.stamp_ns + first * self.period_ns
        return replace(self, stamp_ns=began_ns if t_ns < began_ns + self.period_ns else t_ns, u=self.u[first:], x=self.x[first:])

    def moved(self, stamp_ns: int) -> Way:
        """Return it with row 0 at another time."""
        return replace(self, stamp_ns=stamp_ns)

    def corrected(self, x: Array | None, t_ns: int, rotations: Rotations) -> Way:
        """
        Return it as the state of a time corrects it; itself if that says nothing: it is from before row 0, or of another size.

        Args:
            x: State, shape ``(nx,)``, its rotations written in any way; None: none is known, and the rows act as they are.
            t_ns: Its time.
            rotations: Among the states.
        """
        if x is None:
            return replace(self, correction=np.zeros_like(self.correction)) if self.correction.any() else self
        if not self.feeds_back or t_ns < self.stamp_ns or len(x) != self.K.shape[1]:
            return self
        place = (t_ns - self.stamp_ns) / self.period_ns
        row = min(int(place), len(self.x) - 1)
        after = min(row + 1, len(self.x) - 1)
        share = min(place - row, 1.0)  # of the step to the next row's state
        planned = self.x[row] + share * rotations.difference(self.x[after], self.x[row])
        return replace(self, correction=-self.K @ rotations.difference(x, planned))
