# SPDX-License-Identifier: Apache-2.0
r"""
Polishing of a rough solution of a QP: Newton's method on its optimality conditions, from that solution on.

With the values :math:`v = A z` of the rows and their multipliers y, the bounds clip :math:`v + y`; a row that is clipped is at its bound, any other
one is free. This is the primal-dual active-set method [Hintermueller2003]_. Each step is the least change for which the rows at bounds have these
values and the gradient vanishes. So these rows may depend on each other, as bounds on the states of several stages do under one held input: of all
their multipliers those next to the given ones are found, which have the right signs. OSQP's own polishing finds the least ones; where a sign is
wrong among them, it refuses what it has found.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from rti_mpc.array import Array
from rti_mpc.rti.qp.qp import QpData

STEPS = 10  # four are enough from solutions to 1e-3
REGULARIZATION = 1e-6  # of the factorized matrix, as in OSQP, so that it is regular; the refinements take its effect away
REFINEMENTS = 5
ROUNDING = 1e-10  # a residual below it is none, as in OSQP


def polished(qp: QpData, x: Array, y: Array) -> tuple[Array, Array]:
    """
    Return the polished solution and its multipliers, or those given where they fulfil the conditions better.

    Args:
        qp: The problem, its variables and rows scaled.
        x: Solution, shape ``(n,)``.
        y: Multipliers, shape ``(m,)``; negative at lower bounds.
    """
    n, A = len(x), sp.csr_array(qp.A)
    P = sp.csr_array(qp.P + sp.triu(qp.P, k=1).T)
    best, least = (x, y), residuals(qp, P, A, x, y)
    at = np.zeros(len(y), dtype=bool)
    for _ in range(STEPS):
        clipped, before = np.clip(A @ x + y, qp.l, qp.u), at
        at = (A @ x + y != clipped) | (qp.l == qp.u)
        if np.array_equal(at, before):
            break
        rows = A[at]
        K = sp.block_array([[P, rows.T], [rows, sp.csr_array((rows.shape[0],) * 2)]], format="csc")
        factor = splu(K + REGULARIZATION * sp.diags_array(np.repeat([1.0, -1.0], [n, rows.shape[0]]), format="csc"))
        w, goal = np.concatenate([x, y[at]]), np.concatenate([-qp.q, clipped[at]])
        for _ in range(1 + REFINEMENTS):
            w = w + factor.solve(goal - K @ w)
        x, y = w[:n], np.zeros_like(y)
        y[at] = w[n:]
        found = residuals(qp, P, A, x, y)
        if all(here <= max(there, ROUNDING) for here, there in zip(found, least, strict=True)):
            best, least = (x, y), found
    return best


def residuals(qp: QpData, P: sp.csr_array, A: sp.csr_array, x: Array, y: Array) -> tuple[float, float]:
    """Return the primal and the dual residual of a solution, its multipliers clipped to their signs, infinity norms."""
    v = A @ x
    clipped = np.clip(v + y, qp.l, qp.u)
    return float(np.abs(v - clipped).max()), float(np.abs(P @ x + qp.q + A.T @ (v + y - clipped)).max())
