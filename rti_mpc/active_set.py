# SPDX-License-Identifier: Apache-2.0
"""
What solves nearly every sample: the recursion of `rti_mpc.riccati`, repeated until no place changes.

The places are remembered from sample to sample and shifted with the plan, so
that one roll-out mostly does. When they do not settle, the penalty that holds
what is at its bound is softened and stiffened again in steps.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind
from rti_mpc.qp import Guess
from rti_mpc.riccati import Recursion

ROLL_OUTS = 6  # at most from where the last sample left off; more places change than that only when much happens at once
PATH = tuple(10.0**k for k in range(1, 10))  # of the penalty then: soft ones are settled whatever the start, and each leads to the next
ROLL_OUTS_EACH = 100  # at most on each step of that path
PATIENCE = 3  # roll-outs in which the changes may become no fewer, before places change one at a time


class ActiveSet:
    """
    The QP of a sample, solved to rounding without a QP solver.

    Attributes:
        advance: Moves the last plan on by one stage to be the guess, and linearizes there.
        linearize: Does so at the guess as it is.
        gain: Computes the gains; after either of these, that is all of the preparation.
        iterations: Roll-outs of the last solve.
        res_prim: Primal residual of the last solve: rounding.
        res_dual: Dual residual of the last solve: rounding.
    """

    res_prim = 0.0
    res_dual = 0.0

    def __init__(self, recursion: Recursion, guess: Guess, make: Callable[[ca.Function], ca.Function]) -> None:
        x, u, u_prev, *_ = guess.sample
        weights = guess.sample[5:]
        stages: Array = np.zeros(recursion.linearize.numel_out(0))
        gains: Array = np.zeros(recursion.gains.numel_out(0))
        # Like the guess and the plan made at it: these are found at those, and the next ones are those moved on by a stage.
        self._places: Array = np.zeros(recursion.roll_out.numel_out(5))
        self._found = np.zeros_like(self._places)
        changes: Array = np.zeros(1)
        self._changes = changes.data
        self._stiff = np.full(1, PATH[-1])
        self.advance = bind(make(recursion.advance), (*guess.plan[:2], *guess.sample[2:], self._found), (x, u, self._places, stages))
        self.linearize = bind(make(recursion.linearize), guess.sample, (stages,))
        self.gain = bind(make(recursion.gains), (stages, u, *weights, self._places, self._stiff), (gains,))
        rolled = (x, u, u_prev, guess.x0, stages, gains, *weights, self._places, self._stiff)
        self._roll_out = bind(make(recursion.roll_out), rolled, (*guess.plan, changes, self._found))
        self.iterations = 0

    def forget(self) -> None:
        """Start cold: no bound acts."""
        self._places[:] = self._found[:] = 0.0

    def keep(self) -> None:
        """Let the places be those of a guess that is the plan."""
        self._found[:] = self._places

    def solve(self) -> bool:
        """Find the places, and make the plan; tell whether they settled, and numbers are finite."""
        self._roll_out()
        self.iterations = 1
        if self._changes[0] == 0.0 or self._settle(ROLL_OUTS):
            return True
        for self._stiff[0] in PATH:
            self.gain()
            self._roll_out()
            self.iterations += 1
            if not self._settle(ROLL_OUTS_EACH):
                self._stiff[0] = PATH[-1]
                self.forget()
                return False
        return True

    def _settle(self, most: int) -> bool:
        """
        Change places until a roll-out changes none, after so many at most, and tell whether that gave a plan.

        All places change at once as long as there are fewer and fewer that
        do; then the first alone, which cannot go round in circles [Judice1994]_.
        """
        fewest, patience = np.inf, PATIENCE
        for _ in range(most - 1):
            changes = self._changes[0]
            if changes <= 0.0:
                break
            patience = PATIENCE if changes < fewest else patience - 1
            fewest = min(fewest, changes)
            if patience >= 0:
                self._places[:] = self._found
            else:
                first = int(np.argmax(self._places != self._found))
                self._places[first] = self._found[first]
            self.gain()
            self._roll_out()
            self.iterations += 1
        return self._changes[0] == 0.0
