# SPDX-License-Identifier: Apache-2.0
"""
Any other QP solver, by its name in qpsolvers: set up anew for every sample, without a warm start.

It receives the QP as qpsolvers defines one, in matrices that are allocated once and
updated in place; dense ones for a solver that takes no others. If it raises, the solve
has failed, and nothing of that remains for the next sample.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from importlib.metadata import metadata
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import OcpError
from rti_mpc.rti.qp.qp import Qp, QpData
from rti_mpc.rti.scaled import Scaled

if TYPE_CHECKING:
    import qpsolvers

# Tolerances by each solver's own option names, where its defaults are too loose; the last digits cost one or two iterations.
SOLVER_TOLERANCES: dict[str, dict[str, Any]] = {
    "clarabel": {"tol_gap_abs": 1e-13, "tol_gap_rel": 1e-13, "tol_feas": 1e-11},
    "daqp": {"primal_tol": 1e-10, "dual_tol": 1e-12},
    "piqp": {"eps_abs": 1e-12, "eps_rel": 1e-13, "eps_duality_gap_abs": 1e-12, "eps_duality_gap_rel": 1e-13},
    "proxqp": {"eps_abs": 1e-10, "eps_rel": 0.0},
}

OSQP_TIGHT: dict[str, Any] = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 100_000}


class ForeignSolver:
    """
    A solver of qpsolvers for one `Qp`.

    Attributes:
        qp: The problem.
        call: Call that solves the problem as it is, and returns a solution of qpsolvers.
        cold: Whether the next solve forgets the last one; here every solve does.
        iterations: Iterations of the last solve; 0 if the solver does not report them.
        res_prim: Primal residual of the last solve, infinity norm, relative to the scales.
        res_dual: Dual residual of the last solve, infinity norm, relative to the scales.

    Raises:
        OcpError: There is no such solver here, or it cannot solve.
    """

    def __init__(self, qp: Qp, name: str) -> None:
        check_name(name)
        import qpsolvers  # loads every solver that is installed, so imported only where one of them is wanted

        self.qp = qp
        self.cold = False
        self.iterations = 0
        self.res_prim = self.res_dual = 0.0
        self._sound = True
        dense = name not in qpsolvers.sparse_solvers
        self._scaled = scaled = Scaled(qp)
        self._equal, self._above, self._below = scaled.sides()
        self._problem: Any = scaled.to_problem()
        numbers = indexed_problem(scaled)
        self._updates: list[Callable[[], None]] = []
        for matrix, data in (("P", scaled.P.data), ("G", scaled.A.data), ("A", scaled.A.data)):
            made, update = updated_matrix(getattr(numbers, matrix), data, dense)
            setattr(self._problem, matrix, made)
            self._updates.append(update)
        self.call = partial(qpsolvers.solve_problem, self._problem, name, **SOLVER_TOLERANCES.get(name, {}))
        try:
            self._call()
        except Exception as error:  # for example a missing licence: better reported now than as a failure of every sample
            raise OcpError(f"solver {name} must be able to solve, it raised {type(error).__name__}: {str(error).partition(chr(10))[0]}") from error

    def load(self) -> None:
        """Linearize at the guess, and load the new matrices; off the path from state to command."""
        self.qp.linearize()
        self._sound = self.qp.sound
        if self._sound:
            self._scaled.matrices()
            for update in self._updates:
                update()

    def refill(self) -> None:
        """After a change of weights: let the next `load` also update the data that no sample changes."""
        self.qp.fill()

    def solve(self) -> QpStatus:
        """Embed the initial state, solve, and make the plan."""
        if not self._sound:
            return QpStatus.FAILED
        qp, problem = self._scaled, self._problem
        self.qp.embed()
        qp.vectors()
        problem.q[:] = qp.q
        np.concatenate((qp.u[self._above], -qp.l[self._below]), out=problem.h)
        problem.b[:] = qp.u[self._equal]
        try:
            solution = self._call()
        except Exception:  # a foreign solver may raise anything; the controller has its fallbacks
            return QpStatus.FAILED
        status = outcome(solution)
        self.iterations = iterations(solution)
        if status.usable:
            self.res_prim, self.res_dual = residuals(problem, solution)
            qp.plan(np.asarray(solution.x))
        return status

    def _call(self) -> qpsolvers.Solution:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings of a failed solve: the status says the same
            return self.call()


def check_name(name: str) -> None:
    """
    Refuse a solver that is not installed.

    Raises:
        OcpError: It is not; the message says which are, and how to install others.
    """
    import qpsolvers

    here = sorted(set(qpsolvers.available_solvers) - {"osqp"})
    if name not in here:
        others = sorted(set(metadata("qpsolvers").get_all("Provides-Extra") or ()) - {*here, "osqp", "open-source-solvers", "wheels-only"})
        raise OcpError(
            f"solver must be riccati, osqp, or one that is installed, {', '.join(here)}, got {name!r}"
            f"{given.nearest(name, ('riccati', 'osqp', *here))}; "
            f"pip install 'qpsolvers[NAME]' brings {', '.join(others)}"
        )


def solve_once(qp: QpData, name: str) -> tuple[QpStatus, int, Array, float]:
    """
    Let a solver solve a QP as it is, off the hot path, OSQP of qpsolvers to a tolerance of 1e-9 included.

    Returns:
        Status; iterations, 0 if it does not report them; solution, shape ``(n,)``, empty without one; and dual residual, NaN without multipliers.

    Raises:
        OcpError: The solver raised.
    """
    import qpsolvers

    problem: Any = qp.to_problem()
    if name not in qpsolvers.sparse_solvers:
        problem.P, problem.G, problem.A = (matrix.toarray() for matrix in (problem.P, problem.G, problem.A))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of a failed solve: the status says the same
        try:
            found = qpsolvers.solve_problem(problem, name, **(OSQP_TIGHT if name == "osqp" else SOLVER_TOLERANCES.get(name, {})))
        except Exception as error:  # a foreign solver may raise anything
            raise OcpError(f"solver {name} must be able to solve, it raised {type(error).__name__}: {str(error).partition(chr(10))[0]}") from error
    status = outcome(found)
    if not status.usable:
        return status, iterations(found), np.zeros(0), float("nan")
    return status, iterations(found), np.asarray(found.x), residuals(problem, found)[1]


def outcome(solution: qpsolvers.Solution) -> QpStatus:
    """Map a solver's result to a status: an iterate that is not a solution must not be commanded."""
    if solution.found and solution.x is not None and isfinite(solution.x.sum()):
        return QpStatus.SOLVED
    info = solution.extras.get("info")
    said = str(solution.extras.get("status", getattr(info, "status", "")))
    return QpStatus.INFEASIBLE if "infeasible" in said.lower() else QpStatus.FAILED


def iterations(solution: qpsolvers.Solution) -> int:
    """Return the iterations that a solver reports, 0 if it reports none."""
    extras = solution.extras
    return int(next((extras[key] for key in ("iterations", "iter") if key in extras), getattr(extras.get("info"), "iter", 0)))


def residuals(problem: Any, solution: qpsolvers.Solution) -> tuple[float, float]:
    """Return the primal and the dual residual of a solution, NaN if it has no multipliers; those of qpsolvers need rows of every kind."""
    x = solution.x
    primal = max(np.max(problem.G @ x - problem.h, initial=0.0), np.max(np.abs(problem.A @ x - problem.b), initial=0.0))
    if solution.y is None or solution.z is None:
        return float(primal), float("nan")
    return float(primal), float(np.max(np.abs(problem.P @ x + problem.q + problem.G.T @ solution.z + problem.A.T @ solution.y)))


def indexed_problem(qp: QpData) -> qpsolvers.Problem:
    """Return the problem with, in its matrices, the index of the QP's nonzero that belongs there, counted from 1, negative where its sign changes."""
    kept = [(matrix, matrix.data.copy()) for matrix in (qp.P, qp.A)]
    for matrix, _ in kept:
        matrix.data[:] = np.arange(1, matrix.nnz + 1)
    problem = qp.to_problem()
    for matrix, data in kept:
        matrix.data[:] = data
    return problem


def updated_matrix(numbers: sp.csc_matrix[Any], data: Array, dense: bool) -> tuple[Any, Callable[[], None]]:
    """Return a matrix, dense or sparse, for the indices that `indexed_problem` gives, and the call that updates it in place from the data."""
    matrix: Any = numbers.toarray(order="C") if dense else numbers.copy()
    values: Array = matrix.reshape(-1) if dense else matrix.data
    places = np.flatnonzero(values)
    sources, signs = np.abs(values[places]).astype(np.intp) - 1, np.sign(values[places])

    def update() -> None:
        values[places] = signs * data[sources]

    update()
    return matrix, update
