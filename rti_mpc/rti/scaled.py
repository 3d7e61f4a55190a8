# SPDX-License-Identifier: Apache-2.0
"""
The QP in scaled variables and rows, as solvers see it, so that tolerances mean the same in any unit.

A `Qp` keeps the units of the model; solvers read this scaled copy of its data.
"""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.rti.qp.qp import Qp, QpData
from rti_mpc.rti.qp.transcription import INFINITY


class Scaled(QpData):
    """
    A scaled copy of one `Qp`, in arrays of its own that never move.

    Attributes:
        qp: The QP in the units of the model.
    """

    def __init__(self, qp: Qp) -> None:
        self.qp = qp
        columns, rows = qp.scales()
        self.P, self.A = qp.P.copy(), qp.A.copy()
        self.q, self.l, self.u = (np.zeros_like(array) for array in (qp.q, qp.l, qp.u))
        self._columns = columns
        hessian, constraints = qp.P.tocoo(), qp.A.tocoo()
        self._P, self._A = columns[hessian.row] * columns[hessian.col], columns[constraints.col] / rows[constraints.row]
        self._lower, self._upper = (np.where(np.abs(bounds) < INFINITY, 1.0 / rows, 1.0) for bounds in (qp.l, qp.u))
        self.matrices()
        self.vectors()

    def matrices(self) -> None:
        """Scale the matrices P and A."""
        np.multiply(self.qp.P.data, self._P, out=self.P.data)
        np.multiply(self.qp.A.data, self._A, out=self.A.data)

    def vectors(self) -> None:
        """Scale the gradient and the bounds."""
        np.multiply(self.qp.q, self._columns, out=self.q)
        np.multiply(self.qp.l, self._lower, out=self.l)
        np.multiply(self.qp.u, self._upper, out=self.u)

    def plan(self, z: Array) -> None:
        """Make the plan from a scaled solution, shape ``(n,)``."""
        np.multiply(z, self._columns, out=self.qp.z)
        self.qp.step()
