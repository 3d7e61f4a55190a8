# SPDX-License-Identifier: Apache-2.0
"""
Agreement of two plans of one QP: by their inputs, or, where the minimum is flat, by their costs.

Late inputs of a long horizon may cost next to nothing: plans that are both optimal to
the last digits of their cost then differ in them. A wrong plan costs more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from rti_mpc.array import Array
from rti_mpc.rti.active_set import COST_FLOOR, MAX_GAP
from rti_mpc.rti.rti import Rti
from rti_mpc_service.case import solution

AGREEMENT_TOLERANCE = 1e-5  # largest difference between two tight solutions of one QP, relative to half the range of each input
COST_TOLERANCE = MAX_GAP  # by which the costs of two that differ by more may differ: what a certified plan may cost above the optimum


@dataclass(frozen=True)
class Agreement:
    """
    Agreement of two solutions of one QP.

    Attributes:
        difference: Largest difference between their inputs, relative to half the range of each input.
        costs: Difference of their costs relative to these, not below `COST_FLOOR`; 0 where the inputs agree.
    """

    difference: float
    costs: float

    @property
    def flat(self) -> bool:
        """Whether inputs differ that cost nothing."""
        return self.difference > AGREEMENT_TOLERANCE and self.costs <= COST_TOLERANCE


def agreement(one: Array, other: Array, scale: Array, condensed: Rti) -> Agreement:
    """
    Compare two solutions of the QP of a sample.

    Args:
        one: Inputs, shape ``(N_u, nu)``.
        other: Inputs of the other solution, likewise.
        scale: Half the range of each input, shape ``(nu,)``.
        condensed: A controller in the sequential formulation that has just solved this QP.
    """
    difference = float(np.max(np.abs(one - other) / scale))
    if difference <= AGREEMENT_TOLERANCE:
        return Agreement(difference, 0.0)
    normalised = 0.5 * condensed.cost_scale * condensed.cost
    return Agreement(difference, abs(cost(condensed, one) - cost(condensed, other)) / (COST_FLOOR + normalised))


def cost(condensed: Rti, u: Array) -> float:
    """Return half the normalised cost of inputs in the QP, but for a constant, each slack as small as its rows allow; shape of `u` ``(N_u, nu)``."""
    qp = condensed.solvers[-1].qp
    qp.fill()
    qp.embed()
    z = solution(qp, np.zeros(0), u - condensed.guess.sample["u"])  # its states are eliminated
    return float(z @ (qp.P + sp.triu(qp.P, k=1).T) @ z / 2 + qp.q @ z)
