# SPDX-License-Identifier: Apache-2.0
"""
One OSQP workspace, held for the life of the controller and updated in place.

OSQP checks nothing of what it is given [Stellato2020]_: a NaN poisons every
later solve, a short array is read past its end, and an infeasible problem
fills the solution with a finite number. So only the owned arrays of a `Qp`
reach it, `Rti` shows it finite numbers only, and a solution is judged by its
status alone. Its inner object is driven directly: the public one copies and
builds namespaces at every call, which costs more than the solve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import osqp

from rti_mpc.array import Array
from rti_mpc.qp import Qp
from rti_mpc.status import QpStatus

# OSQP's codes, https://osqp.org/docs/interfaces/status_values.html, in its version 1.1.
STATUS = {
    1: QpStatus.SOLVED,
    2: QpStatus.INACCURATE,
    3: QpStatus.INFEASIBLE,
    4: QpStatus.INFEASIBLE,
    5: QpStatus.INFEASIBLE,
    6: QpStatus.INFEASIBLE,
    7: QpStatus.MAX_ITER,
    8: QpStatus.TIME_LIMIT,
}


@dataclass(frozen=True)
class SolverSettings:
    """
    Settings of OSQP, as its documentation names them.

    Attributes:
        eps: Absolute and relative tolerance on the residuals.
        max_iter: Iterations at most.
        rho: Step size of ADMM.
        check_termination: Iterations between two looks at the residuals.
        scaling: Sweeps of Ruiz scaling; none by default: they break the symmetry of the problem, and cost a sample more than they save.
        alpha: Over-relaxation, between 0 and 2.
        sigma: Regularisation of the linear system.
    """

    eps: float = 1e-6
    max_iter: int = 4000
    rho: float = 1.0
    check_termination: int = 5
    scaling: int = 0
    alpha: float = 1.6
    sigma: float = 1e-6


class Solver:
    """
    An OSQP workspace for one `Qp`.

    Attributes:
        z: Last usable solution, shape ``(n,)``.
    """

    def __init__(self, qp: Qp, settings: SolverSettings) -> None:
        self._qp = qp
        self._settings = settings
        self._zero = (np.zeros_like(qp.q), np.zeros_like(qp.l))
        self.z: Array = np.zeros_like(qp.q)
        self.rebuild()

    def rebuild(self) -> None:
        """Set the workspace up anew from the current data, about 2 ms: the way out when it may be poisoned."""
        s = self._settings
        public = osqp.OSQP(algebra="builtin")
        public.setup(
            self._qp.P,
            self._qp.q,
            self._qp.A.copy(),  # OSQP keeps what it is given, and writes into it
            self._qp.l,
            self._qp.u,
            verbose=False,
            eps_abs=s.eps,
            eps_rel=s.eps,
            max_iter=s.max_iter,
            rho=s.rho,
            adaptive_rho=0,
            check_termination=s.check_termination,
            scaling=s.scaling,
            alpha=s.alpha,
            sigma=s.sigma,
            warm_starting=True,
            polishing=False,
        )
        self._osqp = public._solver
        self._info = self._osqp.info
        self._solution = self._osqp.solution

    def cold_start(self) -> None:
        """Forget the last solution."""
        self._osqp.warm_start(*self._zero)

    def load(self) -> None:
        """Take over a new constraint matrix, factorization included."""
        self._osqp.update_data_mat(P_x=None, P_i=None, A_x=self._qp.A.data, A_i=None)

    def load_hessian(self) -> None:
        """Take over a new Hessian, factorization included."""
        self._osqp.update_data_mat(P_x=self._qp.P.data, P_i=None, A_x=None, A_i=None)

    def solve(self) -> QpStatus:
        """Take over the new vectors and solve, starting from the last solution."""
        qp = self._qp
        self._osqp.update_data_vec(q=qp.q, l=qp.l, u=qp.u)
        self._osqp.solve()
        status = STATUS.get(self._info.status_val, QpStatus.FAILED)
        if status.usable:
            self.z = self._solution.x
        return status

    @property
    def iterations(self) -> int:
        """Iterations of the last solve."""
        return int(self._info.iter)

    @property
    def res_prim(self) -> float:
        """Primal residual of the last solve, infinity norm."""
        return float(self._info.prim_res)

    @property
    def res_dual(self) -> float:
        """Dual residual of the last solve, infinity norm."""
        return float(self._info.dual_res)

    @property
    def objective(self) -> float:
        """Objective of the last solve."""
        return float(self._info.obj_val)
