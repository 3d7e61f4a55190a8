# SPDX-License-Identifier: Apache-2.0
"""
Second opinion: the last QP of a sample that another solver has solved, solved by OSQP as well, in pieces.

The QP is that of the problem's formulation, filled from copies of the sample's data by
other code than the other solver's. OSQP starts from its last solution, in one workspace.
Whenever it has roughly converged, it refines its solution on the bounds that hold
there ("polishing" [Stellato2020]_): an opinion is as exact as the plan that it is
compared with, or there is none.
"""

from __future__ import annotations

import math

import numpy as np

from rti_mpc.array import copy, memories
from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.qp.osqp import Solver, SolverSettings
from rti_mpc.rti.qp.qp import Guess, Step
from rti_mpc.rti.rti import Rti

PIECE_ITERATIONS = 10
# Found by measurement, see docs/engine.md: with these all of 1920 last iterates are within 1e-3.
SETTINGS = SolverSettings(max_iter=PIECE_ITERATIONS, check_termination=PIECE_ITERATIONS, polish=50, alpha=1.8, acting_scale=25.0, dynamics_scale=1.0)
MAX_RESIDUAL = 1e-6  # of an opinion, relative to the scales: inputs that the cost hardly depends on are then found to 1e-3 of half their range
MAX_ITERATIONS = 1000


class SecondOpinion:
    """
    OSQP's plan for the last QP of a sample, compared with the plan that was commanded.

    Attributes:
        done: Whether nothing is left to be done.
        status: SOLVED if OSQP has come to an opinion, MAX_ITER, INFEASIBLE or FAILED if it has not; NONE while it is not done.
        iterations: Iterations so far.
        difference: Largest difference of an input in OSQP's last iterate from the plan, relative to its scale, half its range; NaN while not done,
            and where there is no iterate.
    """

    def __init__(self, rti: Rti) -> None:
        """
        Begin with nothing to do.

        Args:
            rti: Real-time iteration whose plans are judged; its backup, if that is OSQP, will start from the last opinion.
        """
        theirs = rti.guess.arguments | {"x0": rti.guess.x0, "plan": rti.u}
        ours = {name: array.copy() for name, array in theirs.items()}
        sample, weights = ({name: ours[name] for name in names} for names in (rti.guess.sample, rti.guess.weights))
        self._plan = Step(*map(np.zeros_like, rti.guess.plan))
        qp = rti.solvers[-1].qp.on(Guess(sample, weights, ours["x0"], self._plan))
        qp.fill()
        self._solver = Solver(qp, SETTINGS)
        self._rti, self._retuned = rti, rti.retuned
        self._u, self._scale = ours["plan"], rti.scale_u
        self._weights = memories((ours.pop(name), theirs[name]) for name in weights)
        self._sample = memories((array, theirs[name]) for name, array in ours.items())
        self._loaded = False
        self.done = True
        self.status = QpStatus.NONE
        self.iterations, self.difference = 0, math.nan

    def keep(self) -> None:
        """Copy the data of the last QP, and its plan: the next `step` begins an opinion about it. Before the `prepare` of the next sample."""
        copy(self._sample)
        if self._retuned != self._rti.retuned:
            self._retuned = self._rti.retuned
            copy(self._weights)
            self._solver.refill()
        self.status = QpStatus.NONE
        self.iterations, self.difference = 0, math.nan
        self._loaded = self.done = False

    def step(self) -> None:
        """Do a piece of the work, the QP's data or a few iterations; nothing if all is done."""
        if self.done:
            return
        if not self._loaded:
            self._loaded = self._load()
            return
        solver = self._solver
        status = solver.proceed()
        self.iterations = solver.iterations
        if not status.usable:
            self._finish(status)
        elif max(solver.res_prim, solver.res_dual) < MAX_RESIDUAL:
            self._finish(QpStatus.SOLVED)
        elif self.iterations >= MAX_ITERATIONS:
            self._finish(QpStatus.MAX_ITER)

    def rewarm(self) -> None:
        """Let OSQP's workspace depend on nothing but arrays, see `Solver.rewarm`."""
        self._solver.rewarm()

    def _load(self) -> bool:
        """Load the QP, and return whether there is one."""
        self._solver.load()
        if not self._solver.embed():
            self._finish(QpStatus.FAILED)
        return not self.done

    def _finish(self, status: QpStatus) -> None:
        """End; the backup will start from an opinion, if there is one."""
        self.status, self.done = status, True
        if status.usable:
            self._solver.plan()
            self.difference = float((np.abs(self._plan.u - self._u) / self._scale).max())
        if status is QpStatus.SOLVED:
            for backup in self._rti.solvers:
                if isinstance(backup, Solver):
                    backup.start_from(*self._solver.solution)


def osqp_solved(rti: Rti) -> bool:
    """Return whether OSQP solved the last sample, or is prepared for the next one."""
    return isinstance(rti.solver, Solver)
