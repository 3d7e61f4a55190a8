# SPDX-License-Identifier: Apache-2.0
r"""
One QP, :math:`\min \tfrac12 z^T P z + q^T z` subject to :math:`l \le A z \le u`, in arrays that never move.

Compiled code fills the arrays, and the solver reads them; nothing is copied in between.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse as sp

from rti_mpc.array import Array
from rti_mpc.codegen import bind
from rti_mpc.rti.qp.transcription import INFINITY, Transcription

if TYPE_CHECKING:
    import qpsolvers


class Step(NamedTuple):
    """
    The plan that a full step leads to.

    Attributes:
        x: States, shape ``(N + 1, nx)``.
        u: Inputs, shape ``(N_u, nu)``.
        violation: Largest violation of a softened bound, in its unit and relative to its scale, shape ``(2,)``.
        change: Size of the step, see `rti_mpc.rti.linearization.change`, shape ``(1,)``.
    """

    x: Array
    u: Array
    violation: Array
    change: Array

    def outputs(self) -> dict[str, Array]:
        """Return these by their names in the compiled functions."""
        return {"x_plan": self.x, "u_plan": self.u, "violation": self.violation, "change": self.change}


@dataclass(frozen=True, eq=False)
class Guess:
    """
    Arrays that all QPs of an OCP share: the guess at which they are linearized, and the plan.

    Attributes:
        sample: Arrays x, u, u_prev, y_ref and p, by these names.
        weights: Weights and bounds, by the names in `rti_mpc.rti.ocp.ARGUMENTS`, and the scale.
        x0: State embedded at node 0, shape ``(nx,)``.
        plan: The plan that the full step from the guess leads to.
    """

    sample: dict[str, Array]
    weights: dict[str, Array]
    x0: Array
    plan: Step

    @property
    def arguments(self) -> dict[str, Array]:
        """Arguments of all data of a sample, by name."""
        return self.sample | self.weights

    @property
    def start(self) -> dict[str, Array]:
        """Arguments that a step starts from: x, u and u_prev."""
        return {name: self.sample[name] for name in ("x", "u", "u_prev")}


class QpData:
    """
    The data of a QP of fixed pattern.

    Attributes:
        P: Upper triangle of the Hessian, shape ``(n, n)``.
        q: Gradient, shape ``(n,)``.
        A: Constraint matrix, shape ``(m, n)``.
        l: Lower bounds, shape ``(m,)``; minus `INFINITY` where there is none.
        u: Upper bounds, shape ``(m,)``; `INFINITY` where there is none.
    """

    P: sp.csc_matrix[Any]
    q: Array
    A: sp.csc_matrix[Any]
    l: Array  # noqa: E741 - OSQP's own name
    u: Array

    def sides(self) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """Return three masks of rows, each of shape ``(m,)``: equations, other rows with an upper bound, other rows with a lower bound."""
        equal = self.l == self.u
        return equal, ~equal & (self.u < INFINITY), ~equal & (self.l > -INFINITY)

    def to_problem(self) -> qpsolvers.Problem:
        """
        Return a copy as a problem of qpsolvers, to solve it independently or to save it.

        Rows with equal bounds become equalities, the others one inequality for each finite bound.
        """
        import qpsolvers  # never on the hot path, so imported only when it is needed

        equal, above, below = self.sides()
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


class Qp(QpData):
    """
    The QP of a sample, in the units of the model, filled by compiled code.

    Attributes:
        z: Solution, written by the solver, shape ``(n,)``.
        cost: The cost (4) at the guess, shape ``(1,)``.
        checksum: Sum of all data, finite if and only if all of it is, shape ``(1,)``.
        watched: For each softened row the rows that show whether it acts, see `Transcription`; shape ``(rows, 4)``.
        equations: Number of first rows, those of the dynamics, which determine as many first variables, the states; 0 if these are eliminated.
        varies_P: Whether the Hessian changes from sample to sample.
        varies_A: Whether the constraint matrix changes from sample to sample.
        fill: Call that writes all but `z` from the guess; slow and not compiled, for a change of weights.
        linearize: Call that writes the data that changes from sample to sample.
        embed: Call that writes the initial state into the data.
        step: Call that makes the plan from `z`.
    """

    fill: Callable[[], None]
    linearize: Callable[[], None]
    embed: Callable[[], None]
    step: Callable[[], None]

    def __init__(self, transcription: Transcription, guess: Guess, make: Callable[[ca.Function], ca.Function]) -> None:
        m, n = transcription.A.shape
        self.P = sp.csc_matrix(transcription.P, copy=True)
        self.q = np.zeros(n)
        self.A = sp.csc_matrix(transcription.A, copy=True)
        self.l = np.zeros(m)
        self.u = np.zeros(m)
        self.z: Array = np.zeros(n)
        self.cost: Array = np.zeros(1)
        self.checksum: Array = np.zeros(1)
        memory: Array = np.zeros(transcription.everything.numel_out("memory"))
        self.equations = transcription.eliminable

        self._scale, self._columns, self._rows = guess.weights["scale"], transcription.columns, transcription.rows
        self.watched = transcription.watched
        self.varies_P, self.varies_A = "P_data" in transcription.varying, "A_data" in transcription.varying

        vectors = {"q": self.q, "lower": self.l, "upper": self.u}
        outputs = {**vectors, "P_data": self.P.data, "A_data": self.A.data, "memory": memory, "cost": self.cost, "checksum": self.checksum}
        self.fill = bind(transcription.everything, guess.arguments, outputs)
        self.linearize = bind(make(transcription.data), guess.arguments, {name: outputs[name] for name in transcription.varying})
        embedded = {f"{name}_embedded": vectors[name][place] for name, place in transcription.embedded}
        self.embed = bind(make(transcription.embed), {"x0": guess.x0, "x": guess.sample["x"], "memory": memory}, embedded)
        step = {**guess.start, "solution": self.z, "x0": guess.x0, "memory": memory, **guess.weights}
        self.step = bind(make(transcription.step), step, guess.plan.outputs())
        self._again = transcription, make

    def on(self, guess: Guess) -> Qp:
        """Return the same QP in other arrays, of another guess."""
        transcription, make = self._again
        return Qp(transcription, guess, make)

    @property
    def sound(self) -> bool:
        """Whether all data is finite, and small enough to be factorized: OSQP would print an error in the middle of a sample."""
        return bool(abs(self.checksum[0]) < 1e6 * INFINITY)  # the sum holds one INFINITY for each bound that is absent

    def scales(self) -> tuple[Array, Array]:
        """Return the scales of variables and rows, shapes ``(n,)`` and ``(m,)``; a slack has the scale of what it softens."""
        return self._scale[self._columns], self._scale[self._rows]

    def reduced_hessian(self) -> Array:
        """Return the scaled Hessian in the inputs only, with the states eliminated by the dynamics; for a QP without slacks."""
        k = self.equations
        P = (self.P + sp.triu(self.P, k=1).T).toarray()
        A = self.A.toarray()
        response = -np.linalg.solve(A[:k, :k], A[:k, k:])
        beside = response.T @ P[:k, k:]
        reduced = response.T @ P[:k, :k] @ response + beside + beside.T + P[k:, k:]
        scale = self._scale[self._columns[k:]]
        return np.asarray(scale[:, None] * reduced * scale)


def step_size(qp: Qp) -> float:
    r"""
    Return the step size at which ADMM converges fastest on a QP, :math:`\sqrt{\lambda_{min} \lambda_{max}}` of its reduced Hessian.

    This is the optimum for a problem with inequalities only [Ghadimi2015]_; `docs/engine.md` shows that it also fits the others.
    """
    eigenvalues = np.linalg.eigvalsh(qp.reduced_hessian())
    curved = eigenvalues[eigenvalues > 1e-9 * eigenvalues[-1]]
    return float(np.sqrt(curved[0] * curved[-1])) if len(curved) else 1.0
