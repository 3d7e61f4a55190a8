# SPDX-License-Identifier: Apache-2.0
"""
What solves nearly every sample: the recursion of `rti_mpc.riccati`, repeated until no place changes.

The places are remembered from sample to sample and shifted with the plan, so
that one roll-out mostly does. When they do not settle, the penalty that holds
what is at its bound is softened and stiffened again in steps.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind
from rti_mpc.qp import Guess
from rti_mpc.riccati import Recursion
from rti_mpc.status import QpStatus

ROLL_OUTS = 6  # at most from where the last sample left off; more places change than that only when much happens at once
PATH = tuple(10.0**k for k in range(1, 10))  # of the penalty then: soft ones are settled whatever the start, and each leads to the next
ROLL_OUTS_EACH = 100  # at most on each step of that path
PATIENCE = 3  # roll-outs in which the changes may become no fewer, before places change one at a time


class ActiveSet:
    """
    The QP of a sample, solved to rounding without a QP solver.

    Attributes:
        cold: Whether the next `load` forgets the places.
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
        self._places: Array = np.zeros(recursion.roll_out.numel_out(4))
        self._found, verdict = np.zeros_like(self._places), np.zeros(2)
        self._verdict = verdict.data
        self._stiff = np.full(1, PATH[-1])
        ends = np.cumsum([rows * width for rows, width in recursion.shapes])
        kinds = zip(np.split(self._places, ends[:-1]), recursion.shapes, strict=True)
        self._moves = [(kind[:-width].data, kind[width:].data) for kind, (rows, width) in kinds if width and rows > 1]
        self._linearize = bind(make(recursion.linearize), guess.sample, (stages,))
        self._gain = bind(make(recursion.gains), (stages, u, *weights, self._places, self._stiff), (gains,))
        rolled = (x, u, u_prev, guess.x0, stages, gains, *weights, self._places, self._stiff)
        self._roll_out = bind(make(recursion.roll_out), rolled, (*guess.plan, verdict, self._found))
        self._any = False
        self.cold = False
        self.iterations = 0

    def shift(self) -> None:
        """Follow the guess by one stage."""
        if self._any:
            for now, later in self._moves:
                now[:] = later

    def load(self) -> None:
        """Linearize at the guess, and compute the gains."""
        if self.cold:
            self._places[:] = 0.0
            self._any = self.cold = False
        self._linearize()
        self._gain()

    def solve(self) -> QpStatus:
        """Find the places, and make the plan; fails if they do not settle, or numbers are not finite."""
        self.iterations = 0
        if self._settle(ROLL_OUTS):
            return QpStatus.SOLVED
        for self._stiff[0] in PATH:
            self._gain()
            if not self._settle(ROLL_OUTS_EACH):
                self._stiff[0] = PATH[-1]
                self.cold = True
                return QpStatus.FAILED
        return QpStatus.SOLVED

    def _settle(self, most: int) -> bool:
        """
        Roll out from the initial state until no place changes, at most so often, and tell whether that gave a plan.

        All places change at once as long as there are fewer and fewer that
        do; then the first alone, which cannot go round in circles [Judice1994]_.
        """
        fewest, patience = np.inf, PATIENCE
        for _ in range(most):
            self._roll_out()
            self.iterations += 1
            changes, finite = self._verdict
            if not isfinite(finite):
                return False
            if not changes:
                return True
            patience = PATIENCE if changes < fewest else patience - 1
            fewest = min(fewest, changes)
            if patience >= 0:
                self._places[:] = self._found
            else:
                first = int(np.argmax(self._places != self._found))
                self._places[first] = self._found[first]
            self._any = True
            self._gain()
        return False
