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
        functions: Outputs at a node, ``(x, p) -> y``, and `largest_steps`.
        x: State guess, shape ``(N + 1, nx)``.
        x0: Initial state, shape ``(nx,)``.
        y_ref: Reference rows, shape ``(N, ny)``.
        p: Stage parameters, shape ``(N + 1, np)``.
        bounds: Lower and upper bounds on states that act, each of shape ``(nx,)``; infinite or huge where there are none.
    """

    def __init__(
        self, ocp: Ocp, functions: tuple[ca.Function, ca.Function], x: Array, x0: Array, y_ref: Array, p: Array, bounds: tuple[Array, Array]
    ) -> None:
        model = ocp.model
        y: Array = np.zeros(model.ny)
        self._x, self._y_ref = x, y_ref
        self.written = (x, x0, y, y_ref)
        self._lbx, self._ubx = bounds
        views: list[Any] = [array.data for array in (x0, x[0], y, y_ref[0])]  # read faster than arrays
        self._x0, self._guess, self._y, self._y_first = views
        output, steps = functions
        self._output = bind(output, {"x": x0, "p": p[0]}, {"y": y})
        self._rotations = model.rotations("states")
        outputs, states = model.rotations("outputs"), self._rotations
        self._outputs = dict(zip(outputs.angles, outputs.turns, strict=True))  # a whole turn of each output that is an angle
        self._bounded = {j: turn for j, turn in zip(states.angles, states.turns, strict=True) if bounds[1][j] - bounds[0][j] <= turn}
        largest: Array = np.zeros(len(self._outputs))
        self._largest = largest.data
        self._measure = bind(steps, {"y_ref": y_ref}, {"largest": largest})
        self._added = [0.0] * model.ny  # whole turns added to the rows of the reference as they are given
        self._errors = [0.0] * model.ny

    def forget(self) -> None:
        """Start cold: the next sample takes the shorter way round."""
        self._errors = [0.0] * len(self._errors)

    def take_reference(self) -> None:
        """Unwrap the rows of the reference, and add the turns of the sample before."""
        if not self._outputs:
            return
        self._measure()
        for (j, turn), largest in zip(self._outputs.items(), self._largest, strict=True):
            if largest >= turn / 2:
                self._y_ref[:, j] = np.unwrap(self._y_ref[:, j], period=turn)
            if self._added[j]:
                self._y_ref[:, j] += self._added[j]

    def rehearse(self) -> None:
        """Do what `settle` does; the caller puts `written` back."""
        kept = self._errors.copy(), self._added.copy()
        self.settle()
        self._errors, self._added = kept

    def settle(self) -> bool:
        """Bring a new initial state, the guess and the reference into the same turn; return whether guess or reference have changed."""
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
                changed = True
            self._errors[j] = error - turns
        return changed


def largest_steps(ocp: Ocp) -> ca.Function:
    """Build ``y_ref -> largest``: for each output that is an angle, the largest distance from one row of the reference to the next."""
    y_ref = ca.SX.sym("y_ref", ocp.model.ny, ocp.N)
    change = ca.fabs(y_ref[:, 1:] - y_ref[:, :-1])
    largest = [reduce(ca.fmax, ca.horzsplit(change[j, :]), ca.SX(0)) for j in ocp.model.rotations("outputs").angles]
    return function("largest_steps", {"y_ref": y_ref}, {"largest": ca.densify(ca.vertcat(*largest))})
