# SPDX-License-Identifier: Apache-2.0
r"""The data of one QP, :math:`\min \tfrac12 z^T P z + q^T z` subject to :math:`l \le A z \le u`, in arrays that never move."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from rti_mpc.array import Array
from rti_mpc.transcription import INFINITY, Transcription

if TYPE_CHECKING:
    import qpsolvers


class Qp:
    """
    A QP of fixed pattern. Compiled code writes into these arrays, the solver reads them.

    Attributes:
        P: Upper triangle of the Hessian, shape ``(n, n)``.
        q: Gradient, shape ``(n,)``.
        A: Constraint matrix, shape ``(m, n)``.
        l: Lower bounds, shape ``(m,)``; minus `INFINITY` where there is none.
        u: Upper bounds, shape ``(m,)``; `INFINITY` where there is none.
    """

    def __init__(self, transcription: Transcription) -> None:
        m, n = transcription.A.shape
        self.P: sp.csc_matrix[Any] = sp.csc_matrix(transcription.P, copy=True)
        self.q: Array = np.zeros(n)
        self.A: sp.csc_matrix[Any] = sp.csc_matrix(transcription.A, copy=True)
        self.l: Array = np.zeros(m)
        self.u: Array = np.zeros(m)

    def to_problem(self) -> qpsolvers.Problem:
        """
        Return a copy in the form of qpsolvers, for a second opinion or a dump.

        Rows with equal bounds become equalities, the others one inequality for each bound that is there.
        """
        import qpsolvers  # the second opinion is never on the hot path, nor in memory until asked for

        equal = self.l == self.u
        above = ~equal & (self.u < INFINITY)
        below = ~equal & (self.l > -INFINITY)
        A = sp.csr_matrix(self.A)
        P = self.P + sp.triu(self.P, k=1).T
        return qpsolvers.Problem(
            sp.csc_matrix(P),
            self.q.copy(),
            sp.csc_matrix(sp.vstack([A[above], -A[below]])),
            np.concatenate([self.u[above], -self.l[below]]),
            sp.csc_matrix(A[equal]),
            self.u[equal],
        )
