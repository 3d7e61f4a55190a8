# SPDX-License-Identifier: Apache-2.0
r"""
Blockage: obstacles or other softened bounds hold the robot, and its plans find no way round.

A plan is blocked if it touches a softened bound and makes no progress over the whole
horizon, compared with the distance to the reference that remains at its end,

.. math::

    \|y_N - y_0\|_Q < \epsilon \, \|y_{ref,N} - y_N\|_Q .

The weight of the cost makes this a ratio without a unit. One such plan is a robot
that hesitates. The robot is blocked after N such plans in a row, N being the horizon
in stages, and free again after N plans in a row that are not blocked.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind, function
from rti_mpc.rti.rti import Rti

MIN_PROGRESS_RATIO = 0.05  # epsilon, without a unit: a plan that passes an obstacle stays above 1, a blocked one is near 0.001


class Blockage:
    """
    Judge of one plan after the other.

    Attributes:
        blocked: Whether the robot is blocked.
    """

    def __init__(self, rti: Rti) -> None:
        self.blocked = False
        self._rti = rti
        self._contrary = 0
        self._squares: Array = np.zeros(2)
        self._measure = bind(progress(rti), {"x": rti.x, "y_ref": rti.y_ref, "p": rti.p}, {"squares": self._squares})

    def look(self) -> bool:
        """Judge the plan of a new sample, and return whether `blocked` has changed."""
        self._measure()
        moved, left = self._squares
        standing = self._rti.touches and bool(moved < MIN_PROGRESS_RATIO**2 * left)
        self._contrary = self._contrary + 1 if standing is not self.blocked else 0
        if self._contrary < self._rti.ocp.N:
            return False
        self.blocked = standing
        self._contrary = 0
        return True

    def clear(self) -> None:
        """Forget everything, for another life of the robot."""
        self.blocked = False
        self._contrary = 0


def progress(rti: Rti) -> ca.Function:
    """Build ``(x, y_ref, p) -> [|y_N - y_0|^2, |y_ref,N - y_N|^2]``, both weighted by Q."""
    model, N, Q = rti.ocp.model, rti.ocp.N, ca.DM(rti.ocp.Q)
    x, y_ref, p = ca.MX.sym("x", model.nx, N + 1), ca.MX.sym("y_ref", model.ny, N), ca.MX.sym("p", model.np_, N + 1)
    output = model.h()
    start, end = output(x[:, 0], p[:, -1]), output(x[:, -1], p[:, -1])  # both outputs with the parameters of one time: a moving beacon is no progress
    moved, left = end - start, y_ref[:, -1] - end
    squares = ca.vertcat(ca.bilin(Q, moved, moved), ca.bilin(Q, left, left))
    return function("progress", {"x": x, "y_ref": y_ref, "p": p}, {"squares": squares})
