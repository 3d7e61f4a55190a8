# SPDX-License-Identifier: Apache-2.0
"""
Active-set solver on the Riccati recursion. Solves nearly every sample without a QP solver.

The places, which say what is at a bound, are kept from sample to sample and shifted
with the plan, so that one roll-out is usually enough. When they do not settle, the
penalty that holds values at their bounds is softened, and stiffened again in a few
steps; after that an interior point of bounded length finds the places. A plan is
certified from the problem's own data, and refined where the penalty has yielded.
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

MAX_ROLL_OUTS = 6  # from the places of the last sample; more are needed only when many places change at once
PENALTY = 3e9  # weight that holds values at their bounds; with a larger one digits are lost
# Weights when that was not enough. With a soft penalty the places settle from most starts, and those found are the start for the next, stiffer one.
PENALTY_PATH = (*(10.0**k for k in range(1, 10)), PENALTY)
MAX_PATH_ROLL_OUTS = 30  # of the path for each QP: where it is longer, the interior point is faster
MAX_STEPS = 30  # of the interior point, for each QP that a sample may have; all of its QPs share the sum
STEP_TARGET = 1e-8  # mean product of distances and multipliers at which the interior point has converged, in normalised cost
STEP_ROUNDING = 1e-4  # mean product below which one that grows shows that rounding has the upper hand
# Limits of the product at the start, otherwise the duality gap per bounded value: with less, steps to large multipliers are short.
START_RANGE = 1.0, 1e10
MAX_REFINEMENTS = 2  # of a plan that is not certified yet
MAX_VIOLATION = 1e-9  # of dynamics, bounds and increments by a certified plan, relative to their scales
MAX_GAP = 1e-6  # by which a certified plan may cost more than the optimum, relative to its normalised cost and COST_FLOOR
COST_FLOOR = 1e-2  # normalised cost, in half ranges squared, below which a plan is as good as its reference
MAX_VIOLATION_INACCURATE, MAX_GAP_INACCURATE = 1e-6, 1e-2  # the same limits of a plan that may be commanded as inaccurate
SOLVED, INACCURATE, FAILED = QpStatus.SOLVED, QpStatus.INACCURATE, QpStatus.FAILED  # read faster than a member of the enumeration
MAX_STALLED_ROLL_OUTS = 3  # roll-outs without fewer changes before places change one at a time


class ActiveSet:
    """
    The QP of a sample, solved to rounding without a QP solver.

    Attributes:
        advance: Call that shifts the last plan by one stage into the guess, and linearizes there.
        linearize: Call that linearizes at the guess as it is.
        gain: Call that computes the gains; with it, after one of the former two, preparation is complete.
        roll_out: Call that makes the plan, and finds the places; `certify` judges that plan, `refine` improves it.
        enter: Call that starts the interior point at the plan; `step`, one step of it.
        steps_left: Steps of the interior point that the sample may still take.
        iterations: Roll-outs and steps of the interior point of the last solve.
        res_prim: Largest violation of dynamics, bounds and increments by the plan that was judged last, relative to their scales.
        res_dual: Bound on the cost of that plan above the optimum, relative to `COST_FLOOR` plus its normalised cost.
    """

    def __init__(self, functions: Places, certificate: ca.Function, guess: Guess, make: Callable[[ca.Function], ca.Function]) -> None:
        stages: Array = np.zeros(functions.linearize.numel_out("stages"))
        gains: Array = np.zeros(functions.gains.numel_out("gains"))
        # As with guess and plan: a roll-out reads the places and writes those found, and `advance` shifts the found ones by a stage.
        self._places: Array = np.zeros(functions.roll_out.numel_out("places_found"))
        self._found = np.zeros_like(self._places)
        changes: Array = np.zeros(1)
        self._changes = changes.data
        self._stiff = np.full(1, PENALTY)
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

        start: Array = np.zeros(1)
        self._start = start
        interior: Array = np.zeros(functions.enter.numel_out("interior"))
        after, mean = np.zeros_like(interior), np.zeros(1)
        interior_plan = {name: np.zeros_like(array) for name, array in found.items() if name != "changes"}
        self._moved, self._product = (interior.data, after.data), mean.data
        self._interior_places = interior_plan["places_found"]
        self._interior_pairs = tuple((found[name], array) for name, array in interior_plan.items())
        entered = {**guess.start, "stages": stages, **guess.weights}
        self.enter = bind(make(functions.enter), {**entered, "x_plan": guess.plan.x, "u_plan": guess.plan.u, "start": start}, {"interior": interior})
        stepped = {"interior_after": after, "product": mean, **interior_plan}
        self.step = bind(make(functions.step), {**entered, "x0": guess.x0, "interior": interior}, stepped)
        self.steps_left = 0
        self.iterations = 0
        self.res_prim = self.res_dual = 0.0

    def forget(self) -> None:
        """Start cold, with no bound acting."""
        self._places[:] = self._found[:] = 0.0

    def keep_guess(self) -> None:
        """Take the places of the guess as those found, because the guess is the plan."""
        self._found[:] = self._places

    def certified(self) -> QpStatus:
        """Refine the last plan until it is certified, and return its status; the certificate uses the problem's own data only."""
        status = self._judged()
        for _ in range(MAX_REFINEMENTS):
            if status is SOLVED:
                break
            gap, before = self.res_dual, [array.copy() for array in self._refined]
            self.refine()
            status = self._judged()
            if not self.res_dual < gap:  # with degenerate places a refinement may make the plan worse
                for array, kept in zip(self._refined, before, strict=True):
                    array[:] = kept
                return self._judged()
        return status

    def _judged(self) -> QpStatus:
        """Certify the plan as it is."""
        self.certify()
        primal, gap, cost = (part[0] for part in self._verdict)
        self.res_prim, self.res_dual = primal, gap / (COST_FLOOR + cost)
        if primal <= MAX_VIOLATION and self.res_dual <= MAX_GAP:
            return SOLVED
        return INACCURATE if primal <= MAX_VIOLATION_INACCURATE and self.res_dual <= MAX_GAP_INACCURATE else FAILED

    def solve(self) -> bool:
        """Find the places, and make the plan; return whether there is one."""
        self.roll_out()
        self.iterations = 1
        if self._changes[0] == 0.0 or self._settle(MAX_ROLL_OUTS):
            return True
        return self._stiffen() or self._step_inside()

    def _stiffen(self) -> bool:
        """Soften the penalty and stiffen it again, and return whether the places have settled after `MAX_PATH_ROLL_OUTS` at most."""
        end = self.iterations + MAX_PATH_ROLL_OUTS
        for self._stiff[0] in PENALTY_PATH:
            self.gain()
            self.roll_out()
            self.iterations += 1
            if not self._settle(end - self.iterations):
                self._stiff[0] = PENALTY
                return False
        return True

    def _step_inside(self) -> bool:
        """Find the places by the interior point, and make the plan; its own if its places do not settle either and it is good enough."""
        self._places[:] = self._found
        if self._changes[0] < 0.0:  # no plan to start at
            self.forget()
            self.gain()
            self.roll_out()
        if self._changes[0] < 0.0 or self.steps_left == 0:
            self.forget()
            return False
        self._judged()
        self._start[0] = min(max(START_RANGE[0], self._verdict[1][0] / self._places.size), START_RANGE[1])
        self.enter()
        self._take_steps()
        self._places[:] = self._interior_places
        self.gain()
        self.roll_out()
        self.iterations += 1
        if self._changes[0] == 0.0 or self._settle(MAX_ROLL_OUTS):
            return True
        for array, inside in self._interior_pairs:
            array[:] = inside
        self._places[:] = self._found
        self.gain()
        if self._judged().usable:
            return True
        self.forget()
        return False

    def _take_steps(self) -> None:
        """Take steps of the interior point until it has converged, rounding has the upper hand, or no step is left."""
        interior, after = self._moved
        last = np.inf
        while self.steps_left > 0:
            self.step()
            self.steps_left -= 1
            self.iterations += 1
            interior[:] = after
            product = self._product[0]
            if not product > STEP_TARGET or last < product < STEP_ROUNDING:  # or not a number
                break
            last = product

    def _settle(self, most: int) -> bool:
        """
        Roll out until no place changes, `most` times at most, and return whether that gave a plan.

        All places change at once as long as fewer and fewer of them do. After that
        only the first one changes, which cannot cycle [Judice1994]_.
        """
        fewest, patience = np.inf, MAX_STALLED_ROLL_OUTS
        for _ in range(most - 1):
            changes = self._changes[0]
            if changes <= 0.0:
                break
            patience = MAX_STALLED_ROLL_OUTS if changes < fewest else patience - 1
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
