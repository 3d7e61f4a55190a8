# SPDX-License-Identifier: Apache-2.0
"""
Active-set solver on the Riccati recursion. Solves nearly every sample without a QP solver.

The places are remembered from sample to sample and shifted with the plan, so
that one roll-out mostly does. When they do not settle, the penalty that holds
what is at its bound is softened and stiffened again in steps. A plan is certified
from the problem's own data, and refined where the penalty has given way.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind
from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.places import Places
from rti_mpc.rti.qp.qp import Guess

ROLL_OUTS = 6  # at most from where the last sample left off; more places change than that only when much happens at once
# Weights of the penalty then: soft ones are settled whatever the start, and each leads to the next. A stiffer last one gives
# way less, and costs digits.
PATH = (*(10.0**k for k in range(1, 10)), 3e9)
ROLL_OUTS_EACH = 100  # at most on each step of that path
REFINEMENTS = 2  # at most of a plan that is not certified
FEASIBLE = 1e-9  # violation of dynamics, bounds and increments, relative to their scales, up to which a plan is certified
OPTIMAL = 1e-6  # share of 1 plus its cost, normalised, by which a certified plan may cost more than the optimum
NEARLY_FEASIBLE, NEARLY_OPTIMAL = 1e-6, 1e-2  # the same of a plan that may be commanded, as inaccurate
SOLVED, INACCURATE, FAILED = QpStatus.SOLVED, QpStatus.INACCURATE, QpStatus.FAILED  # an enumeration looks its members up slowly
PATIENCE = 3  # roll-outs in which the changes may become no fewer, before places change one at a time


class ActiveSet:
    """
    The QP of a sample, solved to rounding without a QP solver.

    Attributes:
        advance: Moves the last plan on by one stage to be the guess, and linearizes there.
        linearize: Does so at the guess as it is.
        gain: Computes the gains; after either of these, that is all of the preparation.
        roll_out: Makes the plan, and finds the places; `certify` judges that plan, `refine` improves it.
        iterations: Roll-outs of the last solve.
        res_prim: Largest violation of dynamics, bounds and increments by the last plan that was certified, relative to their scales.
        res_dual: Largest amount by which the cost of that plan can be above the optimum, relative to 1 plus its cost, normalised.
    """

    def __init__(self, functions: Places, certificate: ca.Function, guess: Guess, make: Callable[[ca.Function], ca.Function]) -> None:
        stages: Array = np.zeros(functions.linearize.numel_out("stages"))
        gains: Array = np.zeros(functions.gains.numel_out("gains"))
        # Like the guess and the plan made at it: these are found at those, and the next ones are those moved on by a stage.
        self._places: Array = np.zeros(functions.roll_out.numel_out("places_found"))
        self._found = np.zeros_like(self._places)
        changes: Array = np.zeros(1)
        self._changes = changes.data
        self._stiff = np.full(1, PATH[-1])
        multipliers: Array = np.zeros(functions.roll_out.numel_out("multipliers"))
        slopes = np.zeros_like(guess.plan.u)
        verdict: dict[str, Array] = {name: np.zeros(1) for name in ("primal", "gap", "cost")}
        self._verdict = tuple(array.data for array in verdict.values())

        x, u = guess.sample["x"], guess.sample["u"]
        moved = guess.arguments | {"x": guess.plan.x, "u": guess.plan.u, "places": self._found}
        acting = {"places": self._places, "stiff": self._stiff}
        fixed = {"stages": stages, "gains": gains, **guess.weights, **acting}
        plan = {"x_plan": guess.plan.x, "u_plan": guess.plan.u, "multipliers": multipliers}
        found = {**guess.plan.outputs(), "changes": changes, "places_found": self._found, "multipliers": multipliers}
        self.advance = bind(make(functions.advance), moved, {"x_next": x, "u_next": u, "places_next": self._places, "stages": stages})
        self.linearize = bind(make(functions.linearize), guess.arguments, {"stages": stages})
        self.gain = bind(make(functions.gains), {"stages": stages, "u": u, **guess.weights, **acting}, {"gains": gains})
        self.roll_out = bind(make(functions.roll_out), {**guess.start, "x0": guess.x0, **fixed}, found)
        judged = {**guess.start, "x0": guess.x0, "stages": stages, **plan, **guess.weights}
        self.certify = bind(make(certificate), judged, {"r": slopes, **verdict})
        refined = {f"{name.removesuffix('_plan')}_refined": array for name, array in plan.items()}
        self.refine = bind(make(functions.refine), {**guess.start, **fixed, "r": slopes, **plan}, refined)
        self._refined = tuple(plan.values())
        self.iterations = 0
        self.res_prim = self.res_dual = 0.0

    def forget(self) -> None:
        """Start cold: no bound acts."""
        self._places[:] = self._found[:] = 0.0

    def keep(self) -> None:
        """Let the places be those of a guess that is the plan."""
        self._found[:] = self._places

    def certified(self) -> QpStatus:
        """Return what the last plan is for its QP, from the problem's own data; it is refined where it is not yet the solution."""
        status = self._judged()
        for _ in range(REFINEMENTS):
            if status is SOLVED:
                break
            gap, before = self.res_dual, [array.copy() for array in self._refined]
            self.refine()
            status = self._judged()
            if not self.res_dual < gap:  # where places are degenerate, a step may lead away
                for array, kept in zip(self._refined, before, strict=True):
                    array[:] = kept
                return self._judged()
        return status

    def _judged(self) -> QpStatus:
        """Judge the plan as it is."""
        self.certify()
        primal, gap, cost = (part[0] for part in self._verdict)
        self.res_prim, self.res_dual = primal, gap / (1.0 + cost)
        if primal <= FEASIBLE and self.res_dual <= OPTIMAL:
            return SOLVED
        return INACCURATE if primal <= NEARLY_FEASIBLE and self.res_dual <= NEARLY_OPTIMAL else FAILED

    def solve(self) -> bool:
        """Find the places, and make the plan; tell whether they settled, and numbers are finite."""
        self.roll_out()
        self.iterations = 1
        if self._changes[0] == 0.0 or self._settle(ROLL_OUTS):
            return True
        for self._stiff[0] in PATH:
            self.gain()
            self.roll_out()
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
            self.roll_out()
            self.iterations += 1
        return self._changes[0] == 0.0
