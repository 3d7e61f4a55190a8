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
from rti_mpc.transcription import WEIGHTS, simultaneous


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
        self.ocp = ocp
        self.x: Array = np.zeros((N + 1, model.nx))
        self.u: Array = np.zeros((N_u, model.nu))
        self.u_prev: Array = np.array(model.u_rest)
        self.y_ref: Array = np.zeros((N, model.ny))
        self.p: Array = np.tile(np.array(model.p_nominal), (N + 1, 1))
        self.status = QpStatus.NONE
        self._weights = tuple(np.array(getattr(ocp, name)) for name in WEIGHTS)
        self._cost_at_guess: Array = np.zeros(1)
        self._checksum: Array = np.zeros(1)
        self._x_next: Array = np.zeros(model.nx)
        self._x_tail: Array = np.zeros(model.nx)
        self._u_tail: Array = np.zeros(model.nu)
        self._p_tail: Array = np.zeros(model.np_)

        transcription = simultaneous(ocp)
        self._places = transcription
        self._hessian_varies = transcription.hessian_varies
        make = compiled if compile else lambda function: function
        self.qp = qp = Qp(transcription)
        self._linearize = bind(
            make(transcription.data),
            (self.x, self.u, self.u_prev, self.y_ref, self.p, *self._weights),
            (qp.q, qp.A.data, qp.l, qp.u, self._cost_at_guess, self._checksum),
        )
        hessian = make(transcription.hessian) if transcription.hessian_varies else transcription.hessian
        self._write_hessian = bind(hessian, (self.x, self.p, *self._weights), (qp.P.data,))
        self._step = bind(make(ocp.phi()), (self._x_tail, self._u_tail, self._p_tail), (self._x_next,))
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

    def prepare(self, y_ref: Array, p: Array | None = None, *, shift: bool = True) -> None:
        """
        Shift the guess by one stage, linearize there and load the QP.

        Args:
            y_ref: Reference at nodes 1 to N, shape ``(N, ny)``.
            p: Stage parameters at nodes 0 to N, shape ``(N + 1, np)``; those of the last sample if none are given.
            shift: Whether time goes on: the plan's first input becomes the previous one. Without, the same sample is iterated on.

        Raises:
            ShapeError: A shape does not fit.
        """
        if y_ref.shape != self.y_ref.shape:
            raise ShapeError("y_ref", self.y_ref.shape, y_ref)
        self.y_ref[:] = y_ref
        if p is not None:
            if p.shape != self.p.shape:
                raise ShapeError("p", self.p.shape, p)
            self.p[:] = p
        if shift:
            self._shift()
        self._linearize()
        if isfinite(self._checksum[0]):
            if self._hessian_varies:
                self._write_hessian()
                self.solver.load_hessian()
            self.solver.load()

    def _shift(self) -> None:
        """Move the guess on by one stage; the last one is repeated, with the state the model predicts."""
        x, u = self.x, self.u
        self.u_prev[:] = u[0]
        x[:-1] = x[1:]
        u[:-1] = u[1:]
        self._x_tail[:] = x[-1]
        self._u_tail[:] = u[-1]
        self._p_tail[:] = self.p[-1]
        self._step()
        x[-1] = self._x_next

    def feedback(self, x0: Array) -> QpStatus:
        """
        Embed the initial state, solve the QP and take the full step.

        A status that is not `usable` leaves the guess as it was, and the next
        solve starts cold: a failure never seeds what follows.

        Args:
            x0: State at node 0, shape ``(nx,)``, finite; angles continue those of the last sample.
        """
        qp, at = self.qp, self._places
        deviation = x0 - self.x[0]
        if not isfinite(deviation.sum() + self._checksum[0]):
            self.status = QpStatus.FAILED
            return self.status
        qp.l[at.initial] = deviation
        qp.u[at.initial] = deviation
        self.status = self.solver.solve()
        if self.status.usable:
            z = self.solver.z
            self.x += z[at.dx].reshape(self.x.shape)
            self.u += z[at.du].reshape(self.u.shape)
            # OSQP's iterate meets the bounds to its tolerance, an actuator wants them exactly.
            np.clip(self.u, self.ocp.lbu, self.ocp.ubu, out=self.u)
        else:
            self.solver.rebuild()
        return self.status
