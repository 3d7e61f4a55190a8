# SPDX-License-Identifier: Apache-2.0
"""
The real-time iteration: one Newton-type step of the OCP a sample, in two phases.

Preparation needs no state: it shifts the guess, linearizes there and loads the
QP, factorization included. Feedback embeds the initial state, solves and takes
the full step. Only feedback is on the path from sensor to actuator
[Diehl2005]_ [Gros2020]_.

Bounds on states rarely act. So the QP without them is solved first; a plan that
keeps them all the same is the solution of the whole QP too. If it does not, the
whole QP is solved, and is the one prepared until its plan has left the bounds.
"""

from __future__ import annotations

from math import isfinite

import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled
from rti_mpc.errors import OcpError, ShapeError
from rti_mpc.linearization import WEIGHTS, plan_cost
from rti_mpc.ocp import Ocp
from rti_mpc.qp import Guess, Qp, step_size
from rti_mpc.sequential import sequential
from rti_mpc.simultaneous import simultaneous
from rti_mpc.solver import Solver, SolverSettings
from rti_mpc.status import QpStatus
from rti_mpc.transcription import INFINITY

FORMULATIONS = {"simultaneous": simultaneous, "sequential": sequential}
SEQUENTIAL_UP_TO = 10  # control horizon up to which the sequential formulation is the faster one, see docs/engine.md
TOUCHING = 1e-3  # distance from its bound, in units of the state, at which a plan counts as having left it


class Rti:
    """
    Real-time iteration on a fixed OCP.

    Between samples it remembers the guess, the previous input, and OSQP's last
    solution; nothing else.

    Attributes:
        ocp: The problem.
        formulation: ``"simultaneous"`` or ``"sequential"``.
        x: State guess, and the plan after feedback, shape ``(N + 1, nx)``.
        u: Input guess, and the plan after feedback, shape ``(N_u, nu)``. Row 0 is the command.
        u_prev: Input before the plan, shape ``(nu,)``: what increments are counted from.
        y_ref: Reference rows of the current sample, shape ``(N, ny)``.
        p: Stage parameters of the current sample, shape ``(N + 1, np)``.
        solvers: The workspaces, each with its QP: without the bounds on states and, if there are any, with them.
        solver: The one of the current sample.
        status: Outcome of the last feedback.

    Raises:
        OcpError: The formulation is unknown, or the model not finite where the robot rests.
    """

    def __init__(self, ocp: Ocp, settings: SolverSettings | None = None, *, formulation: str = "auto", compile: bool = True) -> None:
        model, N, N_u = ocp.model, ocp.N, ocp.N_u
        if formulation == "auto":
            formulation = "sequential" if N_u <= SEQUENTIAL_UP_TO else "simultaneous"
        if formulation not in FORMULATIONS:
            raise OcpError(f"formulation must be auto, {' or '.join(FORMULATIONS)}, got {formulation!r}")
        self.ocp = ocp
        self.formulation = formulation
        self.x: Array = np.zeros((N + 1, model.nx))
        self.u: Array = np.zeros((N_u, model.nu))
        self.u_prev: Array = np.array(model.u_rest)
        self.y_ref: Array = np.zeros((N, model.ny))
        self.p: Array = np.tile(np.array(model.p_nominal), (N + 1, 1))
        self.status = QpStatus.NONE
        self._x0: Array = np.zeros(model.nx)
        self._plan = (np.zeros_like(self.x), np.zeros_like(self.u), np.zeros(1))
        self._tail = (np.zeros(model.nx), np.zeros(model.nu), np.zeros(model.np_), np.zeros(model.nx))  # x, u, p of the last stage, and phi there
        # OSQP has its own infinity, and reads no other.
        weights = {name: np.clip(getattr(ocp, name), -INFINITY, INFINITY) for name in WEIGHTS}
        guess = Guess((self.x, self.u, self.u_prev, self.y_ref, self.p, *weights.values()), self._x0, self._plan)

        transcribe = FORMULATIONS[formulation]
        transcriptions = [transcribe(ocp, softened=softened) for softened in (False, True)[: 2 if len(ocp.lg) else 1]]
        functions = [ocp.phi(), plan_cost(ocp), *(f for t in transcriptions for f in (t.data, t.embed, t.step))]
        made = dict(zip((f.name() for f in functions), compiled(*functions) if compile else functions, strict=True))
        self._integrate_tail = bind(made["phi"], self._tail[:3], self._tail[3:])
        self._cost: Array = np.zeros(1)
        self._evaluate = bind(made["cost"], (*self._plan[:2], *guess.sample[2:]), (self._cost,))
        qps = [Qp(t, guess, lambda function: made[function.name()]) for t in transcriptions]
        self._roll_out()
        qps[0].fill()
        if not isfinite(qps[0].checksum[0]):
            raise OcpError(f"model {model.name} must be finite and differentiable around the zero state")
        # The cost normalised, so that one step size of ADMM, and one tolerance, fit every problem.
        self._cost_scale = 1.0 / step_size(qps[0])
        for name in ("delta", "lambda_", "z", "Z", "Q_e", "zh", "Zh"):
            weights[name] *= self._cost_scale
        for qp in qps:
            qp.fill()
        self.solvers = [Solver(qp, settings or SolverSettings()) for qp in qps]
        self.reset(np.zeros(model.nx), np.array(model.u_rest))

    @property
    def qp(self) -> Qp:
        """The QP of the current sample."""
        return self.solver.qp

    def reset(self, x0: Array, u_prev: Array) -> None:
        """Start cold: the guess stays at one state and one input, and no earlier solution seeds the next."""
        self.u_prev[:] = u_prev
        self.u[:] = np.clip(u_prev, self.ocp.lbu, self.ocp.ubu)
        self.x[:] = x0
        self._touching = False
        self.solver = self.solvers[0]
        for solver in self.solvers:
            solver.cold = True

    def prepare(self, y_ref: Array, p: Array | None = None, *, shift: bool = True, u_prev: Array | None = None) -> None:
        """
        Shift the guess by one stage, linearize there and load the QP.

        Args:
            y_ref: Reference at nodes 1 to N, shape ``(N, ny)``.
            p: Stage parameters at nodes 0 to N, shape ``(N + 1, np)``; those of the last sample if none are given.
            shift: Whether time goes on. Without, the same sample is iterated on.
            u_prev: Input that acts before the plan, shape ``(nu,)``, where it is not the first input of the last plan.

        Raises:
            ShapeError: A shape does not fit.
        """
        if y_ref.shape != self.y_ref.shape:
            raise ShapeError("y_ref", self.y_ref.shape, y_ref)
        if p is not None:
            if p.shape != self.p.shape:
                raise ShapeError("p", self.p.shape, p)
            self.p[:] = p
        self.y_ref[:] = y_ref
        if shift:
            self.shift()
        if u_prev is not None:
            self.u_prev[:] = u_prev
        self.solver = self.solvers[self._touching]
        self.solver.load()

    def _roll_out(self) -> None:
        """Make a guess in motion, half way to the upper bounds of the inputs, where the problem shows its scale."""
        ubu = self.ocp.ubu
        self.u[:] = np.where(np.isfinite(ubu), 0.5 * (np.clip(ubu, -INFINITY, INFINITY) + self.u_prev), self.u_prev)
        self.x[:] = 0.0
        for _ in range(self.ocp.N):
            self.shift()
        self.u_prev[:] = self.u[0]

    def shift(self) -> None:
        """Move the guess on by one stage: its first input becomes the previous one, its last is repeated, with the state the model predicts."""
        x, u = self.x, self.u
        x_tail, u_tail, p_tail, x_next = self._tail
        self.u_prev[:] = u[0]
        x[:-1] = x[1:]
        u[:-1] = u[1:]
        x_tail[:], u_tail[:], p_tail[:] = x[-1], u[-1], self.p[-1]
        self._integrate_tail()
        x[-1] = x_next

    def feedback(self, x0: Array) -> QpStatus:
        """
        Embed the initial state, solve the QP and take the full step.

        A status that is not `usable` leaves the guess as it was, and the next
        solve starts cold: a failure never seeds what follows.

        Args:
            x0: State at node 0, shape ``(nx,)``; angles continue those of the last sample.
        """
        self._x0[:] = x0
        if not isfinite(self._x0.sum()):
            self.status = QpStatus.FAILED
            return self.status
        x_plan, u_plan, violation = self._plan
        self.status = self.solver.solve()
        if self.status.usable and self.solver is self.solvers[0] and violation[0] > 0.0:
            self.solver = self.solvers[1]
            self.solver.load()
            self.status = self.solver.solve()
        if self.status.usable:
            self._evaluate()
            if not isfinite(self._cost[0]):  # numbers of such a size that they overflowed inside the solver
                self.solver.cold = True
                self.status = QpStatus.FAILED
                return self.status
            self.x[:] = x_plan
            self.u[:] = u_plan
            self._touching = self.solver is not self.solvers[0] and bool(violation[0] > -TOUCHING)
        return self.status

    @property
    def cost(self) -> float:
        """The cost (4) of the last plan, with the penalties for what it exceeds."""
        return float(self._cost[0]) / self._cost_scale

    @property
    def violation(self) -> float:
        """By how much the plan's states exceed their bounds at most, in the unit of the state; 0 if they do not."""
        return max(0.0, float(self._plan[2][0]))
