# SPDX-License-Identifier: Apache-2.0
"""
The real-time iteration: one Newton-type step of the OCP a sample, in two phases.

Preparation needs no state: it shifts the guess, linearizes there and loads the
QP, factorization included. Feedback embeds the initial state, solves and takes
the full step. Only feedback is on the path from sensor to actuator
[Diehl2005]_ [Gros2020]_.
"""

from __future__ import annotations

from math import isfinite

import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled
from rti_mpc.errors import OcpError, ShapeError
from rti_mpc.ocp import Ocp
from rti_mpc.qp import Qp
from rti_mpc.solver import Solver, SolverSettings
from rti_mpc.status import QpStatus
from rti_mpc.transcription import INFINITY, WEIGHTS, simultaneous


class Rti:
    """
    Real-time iteration on a fixed OCP.

    Between samples it remembers the guess, the previous input, and OSQP's last
    solution; nothing else.

    Attributes:
        ocp: The problem.
        qp: The QP of the current sample.
        x: State guess, and the plan after feedback, shape ``(N + 1, nx)``.
        u: Input guess, and the plan after feedback, shape ``(N_u, nu)``. Row 0 is the command.
        u_prev: Input before the plan, shape ``(nu,)``: what increments are counted from.
        y_ref: Reference rows of the current sample, shape ``(N, ny)``.
        p: Stage parameters of the current sample, shape ``(N + 1, np)``.
        status: Outcome of the last feedback.
    """

    def __init__(self, ocp: Ocp, settings: SolverSettings | None = None, *, compile: bool = True) -> None:
        model, N, N_u = ocp.model, ocp.N, ocp.N_u
        transcription = simultaneous(ocp)
        self.ocp = ocp
        self.x: Array = np.zeros((N + 1, model.nx))
        self.u: Array = np.zeros((N_u, model.nu))
        self.u_prev: Array = np.array(model.u_rest)
        self.y_ref: Array = np.zeros((N, model.ny))
        self.p: Array = np.tile(np.array(model.p_nominal), (N + 1, 1))
        self.status = QpStatus.NONE
        self._weights = tuple(np.clip(getattr(ocp, name), -INFINITY, INFINITY) for name in WEIGHTS)  # OSQP has its own infinity
        self._cost_at_guess: Array = np.zeros(1)
        self._checksum: Array = np.zeros(1)
        self._tail = (np.zeros(model.nx), np.zeros(model.nu), np.zeros(model.np_), np.zeros(model.nx))  # x, u, p of the last stage, and phi there
        self._z: Array = np.zeros(transcription.A.shape[1])
        self._plan = (np.zeros_like(self.x), np.zeros_like(self.u))

        self._hessian_varies = transcription.hessian_varies
        self._initial = transcription.initial
        self._slacks = transcription.s
        make = compiled if compile else lambda function: function
        self.qp = qp = Qp(transcription)
        self._linearize = bind(
            make(transcription.data),
            (self.x, self.u, self.u_prev, self.y_ref, self.p, *self._weights),
            (qp.q, qp.A.data, qp.l, qp.u, self._cost_at_guess, self._checksum),
        )
        hessian = make(transcription.hessian) if transcription.hessian_varies else transcription.hessian
        self._write_hessian = bind(hessian, (self.x, self.p, *self._weights), (qp.P.data,))
        self._take_step = bind(make(transcription.step), (self.x, self.u, self.u_prev, self._z, *self._weights), self._plan)
        self._integrate_tail = bind(make(ocp.phi()), self._tail[:3], self._tail[3:])
        self._write_hessian()
        self._linearize()
        if not isfinite(self._checksum[0]):
            raise OcpError(f"model {model.name} must be finite and differentiable at the zero state and rest input")
        self.solver = Solver(qp, settings or SolverSettings())

    def reset(self, x0: Array, u_prev: Array) -> None:
        """Start cold: the guess stays at one state and one input, and no earlier solution seeds the next."""
        self.u_prev[:] = u_prev
        self.u[:] = np.clip(u_prev, self.ocp.lbu, self.ocp.ubu)
        self.x[:] = x0
        self.solver.rebuild()

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
        self._linearize()
        if isfinite(self._checksum[0]):  # or OSQP would not recover from it
            if self._hessian_varies:
                self._write_hessian()
                self.solver.load_hessian()
            self.solver.load()

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
        deviation = x0 - self.x[0]
        if not isfinite(deviation.sum() + self._checksum[0]):
            self.status = QpStatus.FAILED
            return self.status
        self.qp.l[self._initial] = deviation
        self.qp.u[self._initial] = deviation
        self.status = self.solver.solve()
        if self.status.usable:
            self._z[:] = self.solver.z
            self._take_step()
            self.x[:], self.u[:] = self._plan
        else:
            self.solver.rebuild()
        return self.status

    @property
    def cost(self) -> float:
        """The cost of the plan, as the QP sees it: quadratic around the last guess."""
        return float(self._cost_at_guess[0]) + 2.0 * self.solver.objective

    @property
    def violation(self) -> float:
        """Largest slack of the plan, in the unit of its state."""
        return float(self._z[self._slacks].max(initial=0.0))
