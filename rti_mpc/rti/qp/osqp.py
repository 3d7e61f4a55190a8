# SPDX-License-Identifier: Apache-2.0
"""
One OSQP workspace, held for the life of the controller and updated in place.

OSQP does not check its arguments [Stellato2020]_: a NaN spoils every later solve, a
short array is read past its end, and an infeasible problem fills the solution with a
finite number. So it receives only arrays that a `Qp` owns, with finite numbers, and a
solution is judged by its status only. Its inner object is called directly: the public
one copies and builds namespaces at every call, which costs more than the solve.
"""

from __future__ import annotations

import ctypes
import math
import signal
from dataclasses import dataclass

import numpy as np
import osqp

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import OcpError
from rti_mpc.rti.qp.polish import polished
from rti_mpc.rti.qp.qp import Qp
from rti_mpc.rti.scaled import Scaled

# Codes of OSQP 1.1, https://osqp.org/docs/interfaces/status_values.html.
STATUS_BY_OSQP_CODE = {
    1: QpStatus.SOLVED,
    2: QpStatus.INACCURATE,
    3: QpStatus.INFEASIBLE,
    4: QpStatus.INFEASIBLE,
    5: QpStatus.INFEASIBLE,
    6: QpStatus.INFEASIBLE,
    7: QpStatus.MAX_ITER,
    8: QpStatus.TIME_LIMIT,
}
SOLVED, INTERRUPTED = 1, 10
POLISH_REFUSED = -1  # what it came to was no better than the solution
# During a solve OSQP's own handler takes Ctrl-C. It ends with the status above only before an iteration, so that one that
# comes later, in the last iteration or while polishing, is in no status. This tells of both until the next solve.
interrupted = ctypes.PyDLL(osqp.ext_builtin.__file__).osqp_is_interrupted

MAX_ENTRY = 1e7  # of a scaled matrix: beyond it the factorization is rounding alone, and OSQP prints a line on standard output
ACTING_MULTIPLIER = 1e-6  # a bound with a larger multiplier acts; those of the others are zero, but for rounding
ADAPTATION_ITERATIONS = 100  # after so many the step size is the next one, and rows are weighed anew; twice as many in each further round
ACTING_RESIDUALS = 10.0  # steps of a multiplier by the primal residual: one that is larger does not vanish in a single iteration
STEP_SIZES = 1.0, 0.1, 10.0  # in turn, relative to that of the settings: where OSQP is slow with one, it mostly converges with another


@dataclass(frozen=True)
class SolverSettings:
    """
    Settings of OSQP, as its documentation names them, for a problem whose cost is normalised.

    Attributes:
        eps: Absolute and relative tolerance on the residuals; with a tighter one the paper's trajectories cost no less.
        max_iter: Largest number of iterations; the last iterate is then used as it is.
        rho: Step size of ADMM, relative to that of `rti_mpc.rti.qp.qp.step_size`.
        check_termination: Iterations between two checks of the residuals.
        scaling: Sweeps of Ruiz scaling; none by default, since they break the symmetry of the problem and cost more time than they save.
        alpha: Over-relaxation, between 0 and 2.
        polish: Refinements of a solution on the bounds that it holds, once it has converged, see `rti_mpc.rti.qp.polish` for where OSQP refuses its
            own; 0: it is left as it is.
        acting_scale: Factor on the row of a softened bound that acts, whose step size is larger by its square: more than 10 finds the multipliers of
            obstacles sooner, and those of many bounds on states later.
        dynamics_scale: The same on the rows of the dynamics. The step size of other rows takes it that these hold exactly; what they are off by adds
            up along the horizon.

    Raises:
        OcpError: One is no number, or out of range.
    """

    eps: float = 1e-3
    max_iter: int = 400
    rho: float = 5.0
    check_termination: int = 5
    scaling: int = 0
    alpha: float = 1.6
    polish: int = 0
    acting_scale: float = 10.0
    dynamics_scale: float = 5.0

    def __post_init__(self) -> None:
        """Check the settings: OSQP itself says on standard output what it does not take."""
        for name, least in (("max_iter", 1), ("check_termination", 0), ("scaling", 0), ("polish", 0)):
            given.whole(name, getattr(self, name), least)
        for name, most in (("eps", math.inf), ("rho", math.inf), ("alpha", 2.0), ("acting_scale", math.inf), ("dynamics_scale", math.inf)):
            if not 0.0 < given.number(name, value := getattr(self, name)) < most:
                raise OcpError(f"{name} must lie between 0 and {most:g}, got {value}")


class Solver:
    """
    An OSQP workspace for one `Qp`.

    Attributes:
        qp: The problem.
        workspace: OSQP's inner object, kept for ever and updated in place.
        cold: Whether the next `load` forgets the last solution.
        iterations: Iterations since the initial state was embedded.
    """

    def __init__(self, qp: Qp, settings: SolverSettings) -> None:
        self.qp = qp
        self.cold = False
        self.iterations = 0
        self._settings = settings
        self._piece = settings.max_iter // math.ceil(settings.max_iter / ADAPTATION_ITERATIONS)
        self._changes = 0  # of the step size for this QP
        self._adapts_at = ADAPTATION_ITERATIONS  # iterations at which the next one comes
        self._sound = True
        self._start: tuple[Array, Array] | None = None  # of the next `load`, its multipliers of rows as they are; None: the last solution
        self._polishes = False  # whether the last solve did; OSQP keeps what it said of an earlier one
        self._held: tuple[Array, Array] | None = None  # what the last `rewarm` or polishing of ours left, until the next solve, as `solution`
        self._scaled = scaled = Scaled(qp)
        self._zero = (np.zeros_like(qp.q), np.zeros_like(qp.l))
        # Where no row acts, OSQP says on standard output that it does not polish, also if it is not verbose. An equation acts always, and so does a
        # slack, at zero or by its softened row. Without either polishing is off until a row acts, see `_polish`.
        self._polishes_later = settings.polish > 0 and not len(qp.watched) and not qp.sides()[0].any()
        # Rows are scaled once more, of the dynamics always, softened ones, which are the last, by whether they act; OSQP receives the scaled rows.
        self._soft = slice(len(qp.l) - len(qp.watched), None)
        self._active = np.zeros(len(qp.watched), dtype=bool)
        self._scale = np.ones_like(qp.l)
        self._scale[: qp.equations] = settings.dynamics_scale
        A = scaled.A.copy()
        self._A_x, self._l, self._u = (np.zeros_like(array) for array in (A.data, scaled.l, scaled.u))
        self._weigh_matrix()
        self._weigh_vectors()
        A.data[:] = self._A_x
        public = osqp.OSQP(algebra="builtin")
        public.setup(
            scaled.P.copy(),  # OSQP keeps its arguments, and writes into them
            scaled.q,
            A,
            self._l,
            self._u,
            verbose=False,
            eps_abs=settings.eps,
            eps_rel=settings.eps,
            max_iter=self._piece,
            rho=settings.rho,
            adaptive_rho=0,
            check_termination=settings.check_termination,
            scaling=settings.scaling,
            alpha=settings.alpha,
            warm_starting=True,
            polishing=settings.polish > 0 and not self._polishes_later,
            polish_refine_iter=settings.polish,
        )
        self.workspace = public._solver
        self._osqp_settings = public.settings
        self._info = self.workspace.info
        self._solution = self.workspace.solution
        refused = self.workspace.update_data_mat(P_x=scaled.P.data, P_i=None, A_x=self._A_x, A_i=None)
        assert not refused, "OSQP must have kept the patterns it was given"
        self._P_x = scaled.P.data if qp.varies_P else None

    def load(self) -> None:
        """Linearize at the guess, and load the new matrices, factorization included; off the path from state to command."""
        qp, scaled = self.qp, self._scaled
        changed, self._changes, self._adapts_at = self._changes, 0, ADAPTATION_ITERATIONS
        if changed:
            self._take_step_size()
        qp.linearize()
        self._sound = qp.sound
        if not self._sound:  # OSQP would never recover from such numbers
            return
        scaled.matrices()
        self._sound = all(matrix.data @ matrix.data < MAX_ENTRY**2 for matrix in (scaled.P, scaled.A))
        if not self._sound:
            return
        changed = qp.varies_A or self._P_x is not None
        start = self._zero if self.cold else self._start
        changed |= self._weigh(start)
        if changed:
            self._load_matrices()
        if start is not None:
            self.workspace.warm_start(start[0], start[1] / self._scale)
        self.cold, self._start = False, None

    def _load_matrices(self) -> None:
        """Load the matrices, factorization included."""
        self._weigh_matrix()
        self._sound = not self.workspace.update_data_mat(P_x=self._P_x, P_i=None, A_x=self._A_x, A_i=None)  # refused: no factorization

    def _weigh_matrix(self) -> None:
        """Scale the rows of the constraint matrix."""
        np.multiply(self._scaled.A.data, self._scale[self.qp.A.indices], out=self._A_x)

    def _weigh_vectors(self) -> None:
        """Scale the bounds likewise."""
        np.multiply(self._scaled.l, self._scale, out=self._l)
        np.multiply(self._scaled.u, self._scale, out=self._u)

    def refill(self) -> None:
        """After a change of weights: let the next `load` also update the data that no sample changes."""
        self.qp.fill()
        self._P_x = self._scaled.P.data

    def _weigh(self, start: tuple[Array, Array] | None) -> bool:
        """
        Give softened rows that act a larger step size, and return whether anything changed.

        One step size does not fit both: where such a bound acts, its multiplier must
        become large; where it does not, it must not slow the solution down. The last
        multipliers, one stage earlier, or those of `start` show which bounds act.
        """
        x, y = self.solution if start is None else start
        acts = np.abs(y[self._soft]) > ACTING_MULTIPLIER
        active = acts[self.qp.watched].any(axis=1)
        if np.array_equal(active, self._active):
            return False
        self._active = active
        self._scale[self._soft] = np.where(active, self._settings.acting_scale, 1.0)
        self.workspace.warm_start(x, y / self._scale)
        return True

    def start_from(self, x: Array, y: Array) -> None:
        """
        Let the next `load` start from the solution of another solver, of the same QP or of one with further slacks and rows at its end.

        Args:
            x: Scaled solution, shape ``(n,)`` or longer.
            y: Its multipliers, shape ``(m,)`` or longer.
        """
        self._start = x[: len(self.qp.q)], y[: len(self.qp.l)]
        self.cold = False

    @property
    def solution(self) -> tuple[Array, Array]:
        """Copies of the last scaled solution, shape ``(n,)``, and of its multipliers, shape ``(m,)``."""
        if self._held is not None:
            return self._held
        return self._solution.x, self._solution.y * self._scale

    def rewarm(self) -> None:
        """Let the workspace go on from the last solution as from that of another solver: from here on it depends on nothing but arrays."""
        x, y = self.solution
        usable = bool(np.isfinite(x).all() and np.isfinite(y).all())
        self.cold |= not usable
        self._held = (x, y) if usable else self._zero
        self.revive()

    def revive(self) -> None:
        """Bring the workspace, which may be a new one, into the state that `rewarm` left it in."""
        if self._held is None:  # never rewarmed
            return
        scaled = self._scaled
        self._weigh_matrix()
        self._weigh_vectors()
        self._take_step_size()
        refused = self.workspace.update_data_vec(q=scaled.q, l=self._l, u=self._u)
        if refused or not self._sound or self.workspace.update_data_mat(P_x=scaled.P.data, P_i=None, A_x=self._A_x, A_i=None):
            self.cold = True
        x, y = self._held
        self.workspace.warm_start(x, y / self._scale)

    def solve(self) -> QpStatus:
        """Embed the initial state, solve from the last solution, and make the plan."""
        status = self.iterate() if self.embed() else QpStatus.FAILED
        if status.usable:
            self.plan()
        return status

    def embed(self) -> bool:
        """Embed the initial state, and return whether there is a QP to be solved."""
        self.iterations = 0
        if not self._sound:
            self.cold = True
            return False
        self.qp.embed()
        self._scaled.vectors()
        return self._load_vectors()

    def _load_vectors(self) -> bool:
        """Load gradient and bounds, and return whether they were taken."""
        self._weigh_vectors()
        if self.workspace.update_data_vec(q=self._scaled.q, l=self._l, u=self._u):  # refused: the workspace then holds another problem
            self.cold = True
            return False
        return True

    def iterate(self) -> QpStatus:
        """Iterate from the last iterate on until it has converged, `max_iter` times at most, and polish what OSQP has failed to polish."""
        status = self.proceed()
        while self.iterations + self._piece <= self._settings.max_iter and status in (QpStatus.MAX_ITER, QpStatus.INACCURATE):
            status = self.proceed()
        if self._polishes and self._info.status_polish == POLISH_REFUSED and status is QpStatus.SOLVED:
            self._held = polished(self._scaled, *self.solution)
            self.workspace.warm_start(self._held[0], self._held[1] / self._scale)
        return status

    def proceed(self) -> QpStatus:
        """Iterate as `iterate`, but no further than to the next change of the step size."""
        if self.iterations >= self._adapts_at:
            self._changes += 1
            self._adapts_at += ADAPTATION_ITERATIONS << self._changes // len(STEP_SIZES)
            if not self._adapt():
                self.cold = True
                return QpStatus.FAILED
        self._held = None
        self._solve()
        self._polishes = not self._polishes_later or (self._info.status_val == SOLVED and self._acts())
        if self._polishes_later and self._polishes:
            self._polish()
        status = STATUS_BY_OSQP_CODE.get(self._info.status_val, QpStatus.FAILED)
        if not status.usable:
            self.cold = True  # no solve starts from a failed one
        return status

    def _solve(self) -> None:
        """Let OSQP iterate, on after a Ctrl-C as well, which is handed on."""
        status = INTERRUPTED
        while status == INTERRUPTED:
            self.workspace.solve()
            self.iterations += int(self._info.iter)
            status = self._info.status_val
            if interrupted():
                signal.raise_signal(signal.SIGINT)  # for the handler of the process, without which nobody would be told

    def _acts(self) -> bool:
        """Whether a row acts at the last iterate, and will after one more iteration; where that is exact, small multipliers are but rounding."""
        return float(np.abs(self._solution.y).max()) > max(ACTING_MULTIPLIER, ACTING_RESIDUALS * self._step_size * self.res_prim)

    def _polish(self) -> None:
        """Iterate once more, and polish: OSQP does so only after an iteration."""
        self._take_settings(polishing=1, max_iter=1, check_termination=1)
        try:
            self._solve()
        finally:
            self._take_settings(polishing=0, max_iter=self._piece, check_termination=self._settings.check_termination)

    def _take_settings(self, **changed: int) -> None:
        """Change settings of OSQP."""
        for name, value in changed.items():
            setattr(self._osqp_settings, name, value)
        self.workspace.update_settings(self._osqp_settings)

    def _adapt(self) -> bool:
        """Take the next step size, weigh the rows by the last iterate, and return whether there still is a QP to be solved."""
        self._take_step_size()
        if not self._weigh(None):
            return True
        self._load_matrices()
        return self._sound and self._load_vectors()

    def _take_step_size(self) -> None:
        """Take the step size whose turn it is."""
        self.workspace.update_rho(self._step_size)

    @property
    def _step_size(self) -> float:
        """Step size whose turn it is."""
        return self._settings.rho * STEP_SIZES[self._changes % len(STEP_SIZES)]

    def plan(self) -> None:
        """Make the plan from the last iterate."""
        self._scaled.plan(self.solution[0])

    @property
    def res_prim(self) -> float:
        """Primal residual of the last solve, infinity norm, relative to the scales; rows that `Solver` scales count by that."""
        return float(self._info.prim_res)

    @property
    def res_dual(self) -> float:
        """Dual residual of the last solve, infinity norm, relative to the scales."""
        return float(self._info.dual_res)

    @property
    def objective(self) -> float:
        """Objective of the last solve."""
        return float(self._info.obj_val)
