# SPDX-License-Identifier: Apache-2.0
r"""
Whole turns of angles: the choice of k in :math:`\psi + 2 \pi k`.

Measurements and references wrap, plans do not. After one wrong heading plan and
reference may differ by a whole turn, and the robot would turn once round itself to
follow its reference. So each angle of the state is taken next to the plan's, and its
error next to the error of the sample before, until the error exceeds half a turn by
`HYSTERESIS_RAD`: then the shorter way round is taken. Noise near half a turn therefore
changes the direction at most once.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Any

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind, function
from rti_mpc.rotation import whole_turns
from rti_mpc.rti.composition import compose
from rti_mpc.rti.ocp import Ocp

HYSTERESIS_RAD = 0.3  # an error must exceed half a turn by this much before the other way round is taken
MAX_ERROR_TURNS = 0.5 + HYSTERESIS_RAD / math.tau


class Turns:
    """
    The angles of one problem, kept in the same turn: of the state, of the plan, and of the reference.

    A state with bounds no more than a turn apart stays in the turn of its bounds.

    Attributes:
        written: The arrays that `settle` writes.

    Args:
        ocp: The problem; it repeats with each turn of a state that is an angle.
        functions: Outputs at a node, ``(x, p) -> y``, `largest_steps`, and `unsettled`.
        x: State guess, shape ``(N + 1, nx)``.
        x0: Initial state, shape ``(nx,)``.
        y_ref: Reference rows, shape ``(N, ny)``.
        p: Stage parameters, shape ``(N + 1, np)``.
        bounds: Lower and upper bounds on states that act, each of shape ``(nx,)``; infinite or huge where there are none.
    """

    def __init__(
        self,
        ocp: Ocp,
        functions: tuple[ca.Function, ca.Function, ca.Function],
        x: Array,
        x0: Array,
        y_ref: Array,
        p: Array,
        bounds: tuple[Array, Array],
    ) -> None:
        model = ocp.model
        y: Array = np.zeros(model.ny)
        self._x, self._y_ref = x, y_ref
        self.written = (x, x0, y, y_ref)
        self._lbx, self._ubx = bounds
        views: list[Any] = [array.data for array in (x0, x[0], y, y_ref[0])]  # read faster than arrays
        self._x0, self._guess, self._y, self._y_first = views
        output, steps, differ = functions
        self._output = bind(output, {"x": x0, "p": p[0]}, {"y": y})
        self._rotations = model.rotations("states")
        outputs = model.rotations("outputs")
        self._outputs = dict(zip(outputs.angles, outputs.turns, strict=True))  # a whole turn of each output that is an angle
        self._bounded = bounded(ocp)
        largest: Array = np.zeros(len(self._outputs))
        self._largest = largest.data
        wraps: Array = np.zeros(1)
        self._wraps, self._turned = wraps.data, False  # angles of which rows are half a turn apart and more; whether turns are added to any
        self._measure = bind(steps, {"y_ref": y_ref}, {"largest": largest, "wraps": wraps})
        self._added = [0.0] * model.ny  # whole turns added to the rows of the reference as they are given
        self._errors: Array = np.zeros(model.ny)
        unsettled: Array = np.zeros(1)
        self._unsettled = unsettled.data
        acting = {"lbx": bounds[0], "ubx": bounds[1]}
        at = {"x0": x0, "x": x[0], "p": p[0], "y_ref": y_ref[0], **acting, "errors_known": self._errors}
        self._look = bind(differ, at, {"errors": self._errors, "unsettled": unsettled})

    def forget(self) -> None:
        """Start cold: the next sample takes the shorter way round."""
        self._errors[:] = 0.0

    def take_reference(self) -> None:
        """Unwrap the rows of the reference, and add the turns of the sample before."""
        if not self._outputs:
            return
        self._measure()
        if not self._turned and self._wraps[0] == 0.0:
            return
        for (j, turn), largest in zip(self._outputs.items(), self._largest, strict=True):
            if largest >= turn / 2:
                self._y_ref[:, j] = np.unwrap(self._y_ref[:, j], period=turn)
            if self._added[j]:
                self._y_ref[:, j] += self._added[j]

    def rehearse(self) -> None:
        """Do what `settle` does; the caller puts `written` back."""
        kept = self._errors.copy(), self._added.copy(), self._turned
        self.settle()
        self._errors[:], self._added, self._turned = kept

    def settle(self) -> bool:
        """Bring a new initial state, the guess and the reference into the same turn; return whether guess or reference have changed."""
        self._look()
        return self._unsettled[0] != 0.0 and self._turn()

    def _turn(self) -> bool:
        """Do so where something may have to be turned."""
        changed = False
        self._rotations.bring_near(self._x0, self._guess)
        for j, turn in self._bounded.items():
            beyond = self._x0[j] - 0.5 * float(self._lbx[j] + self._ubx[j])
            if abs(beyond) > MAX_ERROR_TURNS * turn:
                turns = whole_turns(beyond, turn)
                self._x0[j] -= turns
                self._x[:, j] -= turns
                changed = True
        if self._outputs:
            self._output()
        for j, turn in self._outputs.items():
            error = self._y[j] - self._y_first[j]
            turns = whole_turns(error - self._errors[j], turn)
            if abs(error - turns) > MAX_ERROR_TURNS * turn:
                turns = whole_turns(error, turn)
            if turns:
                self._y_ref[:, j] += turns
                self._added[j] += turns
                self._turned = any(self._added)
                changed = True
            self._errors[j] = error - turns
        return changed


def bounded(ocp: Ocp) -> dict[int, float]:
    """Return the turn of each state that has bounds no more than a turn apart, by its number."""
    states, (lower, upper) = ocp.model.rotations("states"), (np.atleast_2d(bound)[0] for bound in (ocp.lbx, ocp.ubx))
    return {j: turn for j, turn in zip(states.angles, states.turns, strict=True) if upper[j] - lower[j] <= turn}


def unsettled(ocp: Ocp, output: ca.Function) -> ca.Function:
    """
    Build ``(x0, x, p, y_ref, lbx, ubx, errors_known) -> (errors, unsettled)``: whether `Turns.settle` may have to turn something, which is rare.

    Args:
        ocp: The problem.
        output: Outputs at a node, ``(x, p) -> y``.

    ``x`` and ``y_ref`` are those of the first node. Errors are those of the outputs; where something may have to be turned, the known ones.
    """
    nx, ny = ocp.model.nx, ocp.model.ny
    x0, x, lbx, ubx = (ca.SX.sym(name, nx) for name in ("x0", "x", "lbx", "ubx"))
    y, y_ref, known = (ca.SX.sym(name, ny) for name in ("y", "y_ref", "errors_known"))
    states, outputs = ocp.model.rotations("states"), ocp.model.rotations("outputs")
    error = y - y_ref
    near = [ca.fabs(x0[j] - x[j]) <= turn / 2 for j, turn in zip(states.angles, states.turns, strict=True)]
    near += [ca.dot(x0[list(four)], x[list(four)]) >= 0 for four in states.quaternions]
    near += [ca.fabs(x0[j] - 0.5 * (lbx[j] + ubx[j])) <= MAX_ERROR_TURNS * turn for j, turn in bounded(ocp).items()]
    for j, turn in zip(outputs.angles, outputs.turns, strict=True):
        near += [ca.fabs(error[j] - known[j]) <= turn / 2, ca.fabs(error[j]) <= MAX_ERROR_TURNS * turn]
    far = 1 - reduce(ca.logic_and, near, ca.SX(1))
    inputs = {"x0": x0, "x": x, "y": y, "y_ref": y_ref, "lbx": lbx, "ubx": ubx, "errors_known": known}
    differ = function("differ", inputs, {"errors": ca.if_else(far, known, error), "unsettled": far})
    return compose("unsettled", [(output, {"x": "x0"}), (differ, {})], ["errors", "unsettled"])


def largest_steps(ocp: Ocp) -> ca.Function:
    """
    Build ``y_ref -> (largest, wraps)``.

    That is the largest distance from one row of the reference to the next, for each output that is an angle, and for how many it is half a turn
    and more.
    """
    y_ref = ca.SX.sym("y_ref", ocp.model.ny, ocp.N)
    change = ca.fabs(y_ref[:, 1:] - y_ref[:, :-1])
    outputs = ocp.model.rotations("outputs")
    largest = [reduce(ca.fmax, ca.horzsplit(change[j, :]), ca.SX(0)) for j in outputs.angles]
    wraps = sum((step >= turn / 2 for step, turn in zip(largest, outputs.turns, strict=True)), ca.SX(0))
    return function("largest_steps", {"y_ref": y_ref}, {"largest": ca.densify(ca.vertcat(*largest)), "wraps": ca.densify(wraps)})
