# SPDX-License-Identifier: Apache-2.0
"""
Active-set solver on the Riccati recursion. Solves nearly every sample without a QP solver.

The places, which say what is at a bound, are kept from sample to sample and shifted
with the plan, so that one roll-out is usually enough. Where places change, they first do
so all at once, then one by one along a homotopy. A plan is certified from the problem's
own data, and refined where the penalty that holds values at their bounds has yielded.
When places do not settle, or the plan is not certified, an interior point of bounded
length makes the plan, and the places of the next sample.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from rti_mpc.array import Array, copy, memories
from rti_mpc.codegen import bind
from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.places import Places
from rti_mpc.rti.qp.qp import Guess

MAX_ROLL_OUTS = 6  # after the first, as long as fewer places change than in that one, and no more than in the one before or than `FEW` of the first
FEW = 0.5  # of the first changes: where so few change, there may be more than in the roll-out before, since they settle soon
MAX_CHANGES = 45  # of places in the first roll-out with which a homotopy is followed: with more, it takes too many roll-outs
MAX_MOVES = 40  # roll-outs along the homotopy; a step of the interior point takes as long as two
MAX_STEPS = 50  # of the interior point, for each QP that a sample may have; all of its QPs share the sum
ROLL_OUTS_TO_GO_ON = 14  # roll-outs with new gains per QP, a step counted as two: a sample that has taken more begins no further QP
MAX_ROLL_OUTS_HANDED_BACK = 2  # from places that the interior point has found
START_RANGE = 1.0, 1e16  # limits of the product of distance and multiplier at its start, otherwise the duality gap: with less, first steps are short
START_FAR = 1e6  # the same for a second attempt, after one whose numbers were not finite
GAP_SHARES = 1.0, 1e-3  # of MAX_GAP, at which it hands its places back
LEAST_SHARE = 0.1  # sum of products that steps aim at, relative to the largest gap of a certified plan; with less, digits are lost to stiffness
JUDGED_BELOW = 100.0  # times the least product: the plan of a step with a larger one is not judged, because it would fail
MAX_REFINEMENTS = 2  # of a plan that is not certified yet
MAX_VIOLATION = 1e-9  # of dynamics, bounds and increments by a certified plan, relative to their scales
MAX_GAP = 1e-6  # by which a certified plan may cost more than the optimum, relative to its normalised cost and COST_FLOOR
COST_FLOOR = 1e-2  # normalised cost, in half ranges squared, below which a plan is as good as its reference
MAX_VIOLATION_INACCURATE, MAX_GAP_INACCURATE = 1e-6, 1e-2  # the same limits for a plan that may be commanded with the status INACCURATE
SOLVED, INACCURATE, FAILED = QpStatus.SOLVED, QpStatus.INACCURATE, QpStatus.FAILED  # read faster than a member of the enumeration


class ActiveSet:
    """
    The QP of a sample, solved to rounding without a QP solver.

    Attributes:
        advance: Call that shifts the last plan by one stage into the guess, and linearizes there.
        linearize: Call that linearizes at the guess as it is.
        gain: Call that computes the gains; with it, after one of the former two, preparation is complete.
        roll_out: Call that makes the plan, and finds the places; `roll_out_again`, with the gains of these places.
        begin_homotopy: Call that starts the homotopy at the first roll-out; `move_on`, the way to its next change of a place, and the plan there.
        certify: Call that judges the plan; `refine` improves it.
        enter: Call that starts the interior point at the plan; `step`, one step of it.
        written: The arrays that `roll_out` and `certify` write.
        steps: Steps of the interior point that the sample has taken; `roll_outs`, roll-outs with gains that differ from the prepared ones.
        iterations: Roll-outs and steps of the interior point of the last solve.
        res_prim: Largest violation of dynamics, bounds and increments by the plan that was judged last, relative to their scales.
        res_dual: Bound on the cost of that plan above the optimum, relative to `COST_FLOOR` plus its normalised cost.
    """

    def __init__(self, functions: Places, certificate: ca.Function, guess: Guess, make: Callable[[ca.Function], ca.Function]) -> None:
        verdict: Array = np.zeros(3)
        parts = {name: verdict[i : i + 1] for i, name in enumerate(("primal", "gap", "cost"))}
        arrays = guess.arguments | guess.plan.outputs() | parts | {"x0": guess.x0, "start": np.zeros(1), "least": np.zeros(1)}
        for function in (*vars(functions).values(), certificate):
            arrays |= {name: np.zeros(function.numel_out(name)) for name in function.name_out() if name not in arrays}
        found = {name: arrays[name] for name in ("x_plan", "u_plan", "violation", "change", "places_found", "multipliers")}
        inside = {f"{name}_inside": np.zeros_like(array) for name, array in found.items()}  # the same of the interior point
        first = {f"{name}_first": np.zeros_like(arrays[name]) for name in ("places", "places_found", "targets")}  # of the QP's first roll-out
        arrays |= inside | first | {"way": np.zeros_like(arrays["places"]), "nowhere": np.full_like(arrays["places"], np.nan)}
        arrays["gradient"] = np.zeros(functions.gains.numel_out("p"))  # of the cost-to-go; p alone is that of the stages

        def call(function: ca.Function, **elsewhere: str) -> Callable[[], None]:
            """Bind a function to the arrays of its names, or to others; what it takes as known is what it has written last."""
            inputs, outputs = (
                {name: arrays[elsewhere.get(name, name.removesuffix("_known"))] for name in names}
                for names in (function.name_in(), function.name_out())
            )
            return bind(make(function), inputs, outputs)

        # As with guess and plan: a roll-out reads the places and writes those found, and `advance` shifts the found ones by a stage.
        shifted = {"x_next": "x", "u_next": "u", "places_next": "places"}
        self.advance = call(functions.advance, x="x_plan", u="u_plan", places="places_found", **shifted)
        self.linearize = call(functions.linearize)
        of_gains = {"places_of_known": "places", "places_of": "places", "p_known": "gradient", "p": "gradient"}
        self.gain = call(functions.gains, **of_gains | {"places_of_known": "nowhere"})
        self.roll_out = call(functions.roll_out)
        self.roll_out_again = call(functions.roll_out_again, places="places_found", **of_gains)
        self.begin_homotopy = call(functions.begin, places="way")
        self.move_on = call(functions.move_on, places_known="way", places="way", **of_gains)
        self.certify = call(certificate)
        self.refine = call(functions.refine, **{f"{name.removesuffix('_plan')}_refined": name for name in ("x_plan", "u_plan", "multipliers")})
        self.enter = call(functions.enter)
        self.step = call(functions.step, **{name: f"{name}_inside" for name in found})

        self._places, self._found, self._point = arrays["places"], arrays["places_found"], arrays["point"]
        self._start, self._least = arrays["start"], arrays["least"]
        self._changes, self._stiff = arrays["changes"].data, arrays["stiff"].data  # read faster than arrays
        self._product, self._verdict = arrays["product"].data, verdict.data
        self._moved = arrays["interior"].data, arrays["interior_after"].data
        self._keep_first = memories((array, arrays[name.removesuffix("_first")]) for name, array in first.items())
        self._take_first = memories(zip((arrays["way"], self._found, arrays["targets"]), first.values(), strict=True))
        self._interior_pairs = memories(zip(found.values(), inside.values(), strict=True))
        self._best = memories((np.zeros_like(array), array) for array in found.values())
        self.written = (*found.values(), arrays["changes"], arrays["stiff"], arrays["targets"], arrays["r"], verdict)
        self._lowest = np.inf  # gap of the best plan, relative as `res_dual`
        self._stepped = False  # whether the interior point has been used for this QP
        self._qps = self.steps = self.roll_outs = 0
        self.iterations = 0
        self.res_prim = self.res_dual = 0.0

    def begin(self, qps: int) -> None:
        """Begin a sample that may have so many QPs."""
        self._qps, self.steps, self.roll_outs = qps, 0, 0

    @property
    def goes_on(self) -> bool:
        """Whether the sample may begin another QP."""
        return self.roll_outs + 2 * self.steps <= ROLL_OUTS_TO_GO_ON * self._qps

    def forget(self) -> None:
        """Start cold, with no bound acting."""
        self._places[:] = self._found[:] = 0.0

    def keep_guess(self) -> None:
        """Take the places of the guess as those found, because the guess is the plan."""
        self._found[:] = self._places

    def certified(self) -> QpStatus:
        """Improve the last plan until it is certified, and return its status; the certificate uses the problem's own data only."""
        status = self._judged() if self._stepped else self._sharpened()
        self._lowest = np.inf
        if status is SOLVED or not self._keep_better():
            return status
        for _ in range(MAX_REFINEMENTS):
            self.refine()
            if self._judged() is SOLVED:
                return SOLVED
            if not self._keep_better():  # with degenerate places a refinement may make the plan worse
                break
        return self._restore_best() if self._stepped else self._step_inside()

    def sharpen(self) -> None:
        """Make the last plan exact to rounding where bounds are held, because the next QP is linearized there."""
        if self._stiff[0] > 0.0 and not self._stepped:
            self._sharpened()

    def _sharpened(self) -> QpStatus:
        """
        Judge the plan rolled out last, refine it where bounds are held, and return its status; with degenerate places, it may be better as it was.

        Increments and softened bounds are held by a penalty that cancels in the cost-to-go, and takes as many digits with it as it is large. A small
        gap is no small distance where the cost is flat: without this, the units of the model decide 1e-7 of an input's range, or more.
        """
        status, gap = self._judged(), self.res_dual
        if self._stiff[0] <= 0.0:
            return status
        self.refine()
        status = self._judged()
        if self.res_prim <= MAX_VIOLATION and self.res_dual < gap:
            return status
        self.roll_out()
        return self._judged()

    def rehearse(self) -> None:
        """Make the plan once and judge it; the caller puts `written` back."""
        kept = self.res_prim, self.res_dual
        self.roll_out()
        if self._changes[0] <= 0.0:
            self._judged()
        self.res_prim, self.res_dual = kept

    def _judged(self) -> QpStatus:
        """Certify the plan as it is."""
        self.certify()
        primal, gap, cost = self._verdict
        self.res_prim, self.res_dual = primal, gap / (COST_FLOOR + cost)
        if primal <= MAX_VIOLATION and self.res_dual <= MAX_GAP:
            return SOLVED
        return INACCURATE if primal <= MAX_VIOLATION_INACCURATE and self.res_dual <= MAX_GAP_INACCURATE else FAILED

    def _keep_better(self) -> bool:
        """Keep the plan that was judged last if it can be used and its gap is the smallest one so far, and return whether that is so."""
        better = self.res_prim <= MAX_VIOLATION_INACCURATE and self.res_dual < self._lowest
        if better:
            self._lowest = self.res_dual
            copy(self._best)
        return better

    def _restore_best(self) -> QpStatus:
        """Take the best plan back, and judge it again."""
        for best, array in self._best:
            array[:] = best
        return self._judged()

    def solve(self) -> bool:
        """Find the places, and make the plan; return whether there is one."""
        self.roll_out()
        self.iterations, self._stepped = 1, False
        if self._changes[0] == 0.0 or (self._changes[0] > 0.0 and self._settle()):
            return True
        self._lowest = np.inf
        self._judged()
        self._keep_better()
        self._found[:] = 0.0  # a plan without active bounds is often nearer to the optimum than one with wrong ones
        self.roll_out_again()
        self._count()
        self._judged()
        self._keep_better()
        if self._lowest < np.inf and self._step_inside().usable:
            self._places[:] = self._found  # of this QP; their gains are not needed any more
            return True
        self.forget()
        return False

    def _settle(self) -> bool:
        """
        Find the places by roll-outs, and return whether they settle.

        All places change at once first. If their number grows, or they cycle, they change one at a time instead, along the homotopy from the guess.
        """
        copy(self._keep_first)
        first = before = self._changes[0]
        for _ in range(MAX_ROLL_OUTS):
            self.roll_out_again()
            self._count()
            changes = self._changes[0]
            if not 0.0 < changes < first or (changes > before and changes > FEW * first):
                break
            before = changes
        if self._changes[0] > 0.0 and first <= MAX_CHANGES:
            self._follow()
        return self._changes[0] == 0.0

    def _follow(self) -> None:
        """Follow the homotopy from the guess, with the places of the first roll-out, to this QP: see `rti_mpc.rti.homotopy`."""
        copy(self._take_first)
        self.begin_homotopy()
        for _ in range(MAX_MOVES):
            self.move_on()
            self._count()
            if self._changes[0] <= 0.0:
                break

    def _count(self) -> None:
        """Count a roll-out with other gains."""
        self.iterations += 1
        self.roll_outs += 1

    def _step_inside(self) -> QpStatus:
        """Improve the best plan by the interior point until it is certified or no step is left, and return its status."""
        self._stepped = True
        self._restore_best()
        for start in (min(max(START_RANGE[0], self._verdict[1]), START_RANGE[1]), START_FAR):
            self._start[0] = start
            self.enter()
            if self._hands_back():
                return SOLVED
            if self._product[0] < np.inf:
                break  # otherwise it has started so near to the bounds that rounding errors dominated
            self._restore_best()
        return self._restore_best()

    def _hands_back(self) -> bool:
        """Take steps from the iterate, and return whether the places found settle."""
        return any(self._take_steps(share * MAX_GAP) and self._hand_back() for share in GAP_SHARES)

    def _take_steps(self, gap: float) -> bool:
        """Take steps of the interior point until the gap of its plan is below one, and return whether it is; the best plan is kept."""
        interior, after = self._moved
        while self.steps < MAX_STEPS * self._qps:
            # Aim at products that are small beside the cost, but no smaller: the stiffer the sides, the more digits are lost.
            unit = (COST_FLOOR + self._verdict[2]) / self._places.size
            self._least[0] = LEAST_SHARE * gap * unit
            self.step()
            self.steps += 1
            self.iterations += 1
            interior[:] = after
            if not self._product[0] < np.inf:
                break
            if self._product[0] > JUDGED_BELOW * self._least[0]:
                continue
            copy(self._interior_pairs)
            status, better = self._judged(), self._keep_better()
            if status is SOLVED and (self.res_dual <= gap or not better):
                return self.res_dual <= gap
        return False

    def _hand_back(self) -> bool:
        """Roll out from the places of a certified plan, and return whether that gives the plan: it is exact, if they settle."""
        for _ in range(MAX_ROLL_OUTS_HANDED_BACK):
            self.roll_out_again()
            self._count()
            if self._changes[0] <= 0.0:
                break
        return self._changes[0] == 0.0 and self._sharpened() is SOLVED
