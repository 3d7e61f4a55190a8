# SPDX-License-Identifier: Apache-2.0
r"""
One QP, :math:`\min \tfrac12 z^T P z + q^T z` subject to :math:`l \le A z \le u`, in arrays that never move.

Compiled code fills them, the solver reads them, and nothing else is in between.
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
    What a full step leads to.

    Attributes:
        x: States, shape ``(N + 1, nx)``.
        u: Inputs, shape ``(N_u, nu)``.
        violation: By how much softened bounds are exceeded at most, as it is and relative to their scale, shape ``(2,)``.
        change: Size of the step, see `rti_mpc.rti.linearization.change`, shape ``(1,)``.
    """

    x: Array
    u: Array
    violation: Array
    change: Array

    def outputs(self) -> dict[str, Array]:
        """Return these by the names of the functions that make them."""
        return {"x_plan": self.x, "u_plan": self.u, "violation": self.violation, "change": self.change}


@dataclass(frozen=True, eq=False)
class Guess:
    """
    Where the QPs of an OCP are made, and what comes out: arrays that all of them share.

    Attributes:
        sample: x, u, u_prev, y_ref and p, by these names.
        weights: Weights and bounds, by the names in `rti_mpc.rti.linearization.WEIGHTS`, and the scale.
        x0: State embedded at node 0, shape ``(nx,)``.
        plan: What the full step from there leads to.
    """

    sample: dict[str, Array]
    weights: dict[str, Array]
    x0: Array
    plan: Step

    @property
    def arguments(self) -> dict[str, Array]:
        """What the data of a sample depends on, by name."""
        return self.sample | self.weights

    @property
    def start(self) -> dict[str, Array]:
        """What a step begins with: x, u and u_prev."""
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
        """Return which rows are equations, and which of the others have an upper and a lower bound, each of shape ``(m,)``."""
        equal = self.l == self.u
        return equal, ~equal & (self.u < INFINITY), ~equal & (self.l > -INFINITY)

    def to_problem(self) -> qpsolvers.Problem:
        """
        Return a copy in the form of qpsolvers, for a second opinion or a dump.

        Rows with equal bounds become equalities, the others one inequality for each bound that is there.
        """
        import qpsolvers  # the second opinion is never on the hot path, nor in memory until asked for

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
        z: Where the solver puts its solution, shape ``(n,)``.
        cost: The cost (4) at the guess, shape ``(1,)``.
        checksum: Sum of all of this, finite if and only if it is, shape ``(1,)``.
        watched: For each softened row, the last ones, those by which it is known to act, see `Transcription`; shape ``(rows, 4)``.
        varies_P: Whether the Hessian changes from sample to sample.
        varies_A: Whether the constraint matrix does.
        fill: Writes all but `z` from the guess: slow, uncompiled, after a change of weights.
        linearize: Writes of that what changes from sample to sample.
        embed: Writes the initial state into it.
        step: Makes the plan of `z`.
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
        self._eliminable = transcription.eliminable

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

    @property
    def sound(self) -> bool:
        """Whether all of it is finite, and of a size that a factorization survives: OSQP prints, in the middle of a sample, what it refuses."""
        return bool(abs(self.checksum[0]) < 1e6 * INFINITY)  # of which it holds one for each bound that is absent

    def scales(self) -> tuple[Array, Array]:
        """Return what variables and rows are measured by, shapes ``(n,)`` and ``(m,)``; a slack's unit is a part of what it softens already."""
        return self._scale[self._columns], self._scale[self._rows]

    def reduced_hessian(self) -> Array:
        """Return the Hessian in the inputs alone, measured by their scales, the states eliminated by the dynamics; of a QP without slacks."""
        k = self._eliminable
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

    That is the optimum for a problem of inequalities alone [Ghadimi2015]_; for others `docs/engine.md` shows that it holds as well.
    """
    eigenvalues = np.linalg.eigvalsh(qp.reduced_hessian())
    curved = eigenvalues[eigenvalues > 1e-9 * eigenvalues[-1]]
    return float(np.sqrt(curved[0] * curved[-1])) if len(curved) else 1.0
