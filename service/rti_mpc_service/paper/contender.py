# SPDX-License-Identifier: Apache-2.0
"""Contenders of the study: the paper's algorithms, converged NMPC, and the real-time iteration, behind the same two calls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from rti_mpc.array import Array
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc_service.bench.yardstick import Ipopt
from rti_mpc_service.paper.slsqp import Slsqp


class Contender(Protocol):
    """A controller of one problem."""

    def reset(self, x0: Array) -> None:
        """Start cold, where the robot is."""

    def solve(self, x0: Array, u_prev: Array, y_ref: Array) -> Array:
        """Return the command, shape ``(nu,)``; `y_ref` at nodes 1 to N, shape ``(N, ny)``."""


class RealTimeIteration:
    """
    Both phases of the real-time iteration, one after the other.

    Attributes:
        rti: The real-time iteration.
        unusable: Number of QPs without a usable solution; in these samples the shifted plan acts.
    """

    def __init__(self, ocp: Ocp, *, solver: str = "riccati", formulation: str = "auto") -> None:
        self.rti = Rti(ocp, solver=solver, formulation=formulation)
        self.unusable = 0

    def reset(self, x0: Array) -> None:
        """Start cold, where the robot is."""
        self.rti.reset(x0, np.zeros(self.rti.ocp.model.nu))
        self._shift = False

    def solve(self, x0: Array, u_prev: Array, y_ref: Array) -> Array:
        """Return the command of one iteration, shape ``(nu,)``; the robot's own model says what acted before."""
        self.rti.prepare(y_ref, shift=self._shift)
        self.unusable += not self.rti.feedback(x0).usable
        self._shift = True
        return np.array(self.rti.u[0])


CONTENDERS: dict[str, Callable[[Ocp], Contender]] = {
    "slsqp_sequential": lambda ocp: Slsqp(ocp, "sequential"),
    "slsqp_simultaneous": lambda ocp: Slsqp(ocp, "simultaneous"),
    "ipopt": Ipopt,
    "osqp_sequential": lambda ocp: RealTimeIteration(ocp, solver="osqp", formulation="sequential"),
    "osqp_simultaneous": lambda ocp: RealTimeIteration(ocp, solver="osqp", formulation="simultaneous"),
    "rti_sequential": lambda ocp: RealTimeIteration(ocp, formulation="sequential"),
    "rti_simultaneous": lambda ocp: RealTimeIteration(ocp, formulation="simultaneous"),
}
