# SPDX-License-Identifier: Apache-2.0
r"""
The QP of one real-time iteration, as CasADi expressions with a fixed sparsity pattern.

At a guess :math:`(x, u)`, in the deviations
:math:`\Delta x_k = x_k^+ - x_k`, :math:`\Delta u_k = u_k^+ - u_k`, the
dynamics and outputs of `rti_mpc.ocp` become

.. math::

    \Delta x_0 &= \bar x_0 - x_0 \\
    \Delta x_{k+1} &= A_k \Delta x_k + B_k \Delta u_k + b_k, \qquad b_k = \phi(x_k, u_k, p_k) - x_{k+1} \\
    y_i &\approx h(x_i, p_i) + C_i \Delta x_i

and the cost its Gauss-Newton approximation. The simultaneous formulation keeps
states and inputs as variables, :math:`z = (\Delta x_0, \dots, \Delta x_N, \Delta
u_0, \dots, \Delta u_{N_u - 1}, s_1, \dots, s_N)`, with rows for

1. the initial state, the only ones the feedback phase touches,
2. the dynamics,
3. the bounds on inputs, and on increments,
4. the softened bounds on states from above and from below, and :math:`s \ge 0`.

The cost is halved, to read :math:`\tfrac12 z^T P z + q^T z` as OSQP wants it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp

from rti_mpc.ocp import Ocp

INFINITY = 1e30  # OSQP's: a bound this far away is absent

# What may change from sample to sample without a new structure: attributes of the Ocp, read by the compiled functions in this order.
WEIGHTS = ("Q", "R", "delta", "lambda_", "lbu", "ubu", "lbdu", "ubdu", "lbx", "ubx", "z", "Z")


@dataclass(frozen=True, eq=False)
class Transcription:
    """
    The QP of an OCP: patterns, places, and the functions that fill it.

    Attributes:
        P: Pattern of the upper triangle of the Hessian, shape ``(n, n)``.
        A: Pattern of the constraint matrix, shape ``(m, n)``.
        data: ``(x, u, u_prev, y_ref, p, *WEIGHTS) -> (q, A_data, l, u, cost, checksum)``: all that changes from sample to sample; the cost (4)
            at the guess, and a number that is finite if and only if all the others are.
        hessian: ``(x, p, *WEIGHTS) -> P_data``.
        hessian_varies: Whether `hessian` depends on more than the weights.
        step: ``(x, u, u_prev, z, *WEIGHTS) -> (x+, u+)``, the full step.
        initial: Rows of the initial state.
        s: Entries of the slacks in z.
    """

    P: sp.csc_array[Any]
    A: sp.csc_array[Any]
    data: ca.Function
    hessian: ca.Function
    hessian_varies: bool
    step: ca.Function
    initial: slice
    s: slice


def linearize(ocp: Ocp) -> tuple[ca.Function, ca.Sparsity, ca.Sparsity]:
    """
    Linearize the dynamics over one stage.

    Returns:
        ``stage(x, u, p) -> [phi; nonzeros of A; nonzeros of B]``, with the patterns of A, shape ``(nx, nx)``, and of B, shape ``(nx, nu)``.
    """
    model = ocp.model
    x_next = ocp.phi()(model.x, model.u, model.p)
    A = ca.jacobian(x_next, model.x)
    B = ca.jacobian(x_next, model.u)
    out = ca.cse(ca.densify(ca.vertcat(x_next, A.nz[:], B.nz[:])))
    return ca.Function("stage", [model.x, model.u, model.p], [out]), A.sparsity(), B.sparsity()


def gauss_newton(ocp: Ocp) -> tuple[ca.Function, ca.Function, bool]:
    r"""
    Build the terms of :math:`\tfrac12 \delta \|h(x, p) - y_{ref}\|_Q^2` at one node.

    Returns:
        ``gradient(x, p, y_ref, delta, Q) -> [delta C' Q (h - y_ref); cost]``, ``hessian(x, p, delta, Q) -> triu(delta C' Q C)``, and whether C
        varies.
    """
    model = ocp.model
    y_ref = ca.SX.sym("y_ref", model.ny)
    delta = ca.SX.sym("delta")
    Q = ca.SX.sym("Q", model.ny, model.ny)
    W = delta * Q * pattern(ocp.Q)
    C = ca.jacobian(model.y_expr, model.x)
    e = model.y_expr - y_ref
    gradient = ca.densify(ca.vertcat(C.T @ (W @ e), e.T @ (W @ e)))
    varies = ca.depends_on(ca.densify(C), ca.vertcat(model.x, model.p))
    return (
        ca.Function("gradient", [model.x, model.p, y_ref, delta, Q], [ca.cse(gradient)]),
        ca.Function("hessian", [model.x, model.p, delta, Q], [ca.triu(C.T @ W @ C)]),
        varies,
    )


def pattern(weight: np.ndarray[Any, Any]) -> ca.DM:
    """Return ones where a weight matrix may become nonzero: its diagonal, and what is nonzero now."""
    return ca.DM(sp.csc_matrix(((weight != 0) | np.eye(len(weight), dtype=bool)).astype(float)))


class Blocks:
    """
    A sparse matrix under assembly, its nonzeros gathered from a pool of values: 1, -1, then whatever is appended.

    CasADi and OSQP both count nonzeros column by column, so that one index vector, computed here once, makes ``A.data`` in compiled code.
    """

    def __init__(self) -> None:
        self._pool = [ca.MX(ca.DM([1.0, -1.0]))]
        self._pooled = 2
        self._entries: list[tuple[Any, Any, Any]] = []

    def place(self, row: int, col: int, block: Any) -> None:
        """Place a constant block of entries 1 and -1 with its corner at ``(row, col)``."""
        coo = sp.coo_array(block)
        coo.eliminate_zeros()  # kron stores those of dense blocks
        self._entries.append((coo.row + row, coo.col + col, np.where(coo.data > 0, 0, 1)))

    def place_values(self, values: ca.MX, corners: list[tuple[int, int, ca.Sparsity]]) -> None:
        """Place values that vary: the nonzeros of one pattern after the other, each with its corner ``(row, col)``."""
        for row, col, sparsity in corners:
            rows, cols = (np.array(places, dtype=int) for places in sparsity.get_triplet())
            self._entries.append((rows + row, cols + col, self._pooled + np.arange(len(rows))))
            self._pooled += len(rows)
        self._pool.append(values)

    def finish(self, m: int, n: int) -> tuple[sp.csc_array[Any], ca.MX]:
        """Return the pattern, shape ``(m, n)``, and its nonzeros as an expression."""
        rows, cols, sources = (np.concatenate(parts) for parts in zip(*self._entries, strict=True))
        numbers = sp.csc_array((sources + 1, (rows, cols)), shape=(m, n))  # counted from 1, or the first would vanish
        numbers.sort_indices()
        ones = sp.csc_array((np.ones(numbers.nnz), numbers.indices, numbers.indptr), shape=(m, n))
        return ones, ca.vertcat(*self._pool)[(numbers.data - 1).tolist()]


def simultaneous(ocp: Ocp) -> Transcription:
    """Transcribe an OCP with states and inputs as variables: the sparse QP."""
    model, N, N_u = ocp.model, ocp.N, ocp.N_u
    nx, nu, soft = model.nx, model.nu, list(ocp.soft)
    x = ca.MX.sym("x", nx, N + 1)
    u = ca.MX.sym("u", nu, N_u)
    u_prev = ca.MX.sym("u_prev", nu)
    y_ref = ca.MX.sym("y_ref", model.ny, N)
    p = ca.MX.sym("p", model.np_, N + 1)
    w = {name: ca.MX.sym(name, *np.shape(getattr(ocp, name))) for name in WEIGHTS}
    nodes = x[:, 1:]  # the cost and the state bounds begin at node 1

    # Where the three kinds of variables begin in z.
    to_dx, to_du, to_s = 0, (N + 1) * nx, (N + 1) * nx + N_u * nu
    n = to_s + N * len(soft)

    A = Blocks()
    lower: list[ca.MX] = []
    upper: list[ca.MX] = []

    def rows(lb: ca.MX | None, value: ca.MX, ub: ca.MX | None) -> int:
        """Append the bounds of rows whose left-hand side is `value` at the guess; return the first of these rows."""
        first = sum(part.numel() for part in lower)
        absent = ca.MX(ca.DM.ones(value.numel()) * INFINITY)
        lower.append(-absent if lb is None else ca.vec(lb - value))
        upper.append(absent if ub is None else ca.vec(ub - value))
        return first

    zero = ca.MX.zeros(nx)
    A.place(rows(zero, zero, zero), to_dx, sp.eye_array(nx))

    # Dynamics: A_k dx_k + B_k du_k - dx_{k+1} = -b_k.
    stage, A_k, B_k = linearize(ocp)
    held = ca.horzcat(u, ca.repmat(u[:, -1], 1, N - N_u))
    stages = stage.map(N)(x[:, :-1], held, p[:, :-1])
    phi, sensitivities = stages[:nx, :], ca.vec(stages[nx:, :])
    row = rows(nodes, phi, nodes)
    corners = []
    for k in range(N):
        corners += [(row + k * nx, to_dx + k * nx, A_k), (row + k * nx, to_du + min(k, N_u - 1) * nu, B_k)]
    A.place_values(sensitivities, corners)
    A.place(row, to_dx + nx, -sp.eye_array(N * nx))

    # Bounds on inputs and on increments.
    increments = u - ca.horzcat(u_prev, u[:, :-1])
    difference = sp.eye_array(N_u) - sp.eye_array(N_u, k=-1)
    for lb, value, ub, over in (("lbu", u, "ubu", sp.eye_array(N_u)), ("lbdu", increments, "ubdu", difference)):
        at = finite(getattr(ocp, lb), getattr(ocp, ub))
        if at:
            A.place(rows(each(w[lb][at], N_u), value[at, :], each(w[ub][at], N_u)), to_du, sp.kron(over, np.eye(nu)[at]))

    # Softened bounds on states: x - s <= ubx, x + s >= lbx, s >= 0.
    for bound, sign in (("ubx", -1), ("lbx", 1)):
        at = finite(getattr(ocp, bound))
        if at:
            limit = each(w[bound][at], N)
            row = rows(None if sign < 0 else limit, nodes[at, :], limit if sign < 0 else None)
            A.place(row, to_dx + nx, sp.kron(sp.eye_array(N), np.eye(nx)[at]))
            A.place(row, to_s, sign * sp.kron(sp.eye_array(N), np.eye(nx)[np.ix_(at, soft)]))
    if soft:
        slack = ca.MX.zeros(len(soft), N)
        A.place(rows(slack, slack, None), to_s, sp.eye_array(N * len(soft)))
    m = sum(part.numel() for part in lower)

    # Cost: outputs, increments, slacks.
    gradient, hessian, hessian_varies = gauss_newton(ocp)
    outputs = gradient.map(N)(nodes, p[:, 1:], y_ref, w["delta"].T, ca.repmat(w["Q"], 1, N))
    R = w["R"] * pattern(ocp.R)
    force = (R @ increments) * ca.repmat(w["lambda_"].T, nu, 1)
    q = ca.vertcat(
        zero,
        ca.vec(outputs[:nx, :]),
        ca.vec(force - ca.horzcat(force[:, 1:], ca.MX.zeros(nu))),
        ca.repmat(w["z"][soft] / 2, N),
    )
    cost = ca.sum2(outputs[nx, :]) + ca.dot(increments, force)

    P = Blocks()
    H = hessian.map(N)(nodes, p[:, 1:], w["delta"].T, ca.repmat(w["Q"], 1, N))
    P.place_values(H.nz[:], [(nx + i * nx, nx + i * nx, hessian.sparsity_out(0)) for i in range(N)])
    for k in range(N_u):
        at_k = to_du + k * nu
        following = w["lambda_"][k + 1] if k < N_u - 1 else 0
        diagonal = ca.triu(R * (w["lambda_"][k] + following))
        P.place_values(diagonal.nz[:], [(at_k, at_k, diagonal.sparsity())])
        if k < N_u - 1:
            P.place_values((-R * following).nz[:], [(at_k, at_k + nu, R.sparsity())])
    P.place_values(ca.repmat(w["Z"][soft] / 2, N), [(to_s, to_s, ca.Sparsity.diag(N * len(soft)))])

    A_pattern, A_data = A.finish(m, n)
    P_pattern, P_data = P.finish(n, n)
    checksum = ca.sum1(q) + ca.sum1(ca.vec(phi)) + ca.sum1(sensitivities) + cost
    return Transcription(
        P=P_pattern,
        A=A_pattern,
        data=ca.Function(
            "data",
            [x, u, u_prev, y_ref, p, *w.values()],
            [ca.densify(e) for e in (q, A_data, ca.vertcat(*lower), ca.vertcat(*upper), cost, checksum)],
        ),
        hessian=ca.Function("hessian", [x, p, *w.values()], [ca.densify(P_data)]),
        hessian_varies=hessian_varies,
        step=full_step(ocp, n, to_dx, to_du),
        initial=slice(0, nx),
        s=slice(to_s, n),
    )


def full_step(ocp: Ocp, n: int, to_dx: int, to_du: int) -> ca.Function:
    """
    Build ``(x, u, u_prev, z, *WEIGHTS) -> (x + dx, u + du)``.

    A solver's iterate meets the bounds to its tolerance; a robot wants them
    exactly. So the inputs are clipped on the way, increments first: from an
    input inside its bounds, that leaves both satisfied.
    """
    x = ca.SX.sym("x", ocp.model.nx, ocp.N + 1)
    u = ca.SX.sym("u", ocp.model.nu, ocp.N_u)
    u_prev = ca.SX.sym("u_prev", ocp.model.nu)
    z = ca.SX.sym("z", n)
    w = {name: ca.SX.sym(name, *np.shape(getattr(ocp, name))) for name in WEIGHTS}
    dx = ca.reshape(z[to_dx : to_dx + x.numel()], x.shape)
    du = ca.reshape(z[to_du : to_du + u.numel()], u.shape)
    rows = []
    last = u_prev
    for k in range(ocp.N_u):
        last = ca.fmax(ca.fmin(u[:, k] + du[:, k], last + w["ubdu"]), last + w["lbdu"])
        last = ca.fmax(ca.fmin(last, w["ubu"]), w["lbu"])
        rows.append(last)
    return ca.Function("step", [x, u, u_prev, z, *w.values()], [x + dx, ca.horzcat(*rows)])


def finite(*bounds: np.ndarray[Any, Any]) -> list[int]:
    """Return where any of these bounds is present."""
    return [int(j) for j in np.flatnonzero(np.any(np.isfinite(bounds), axis=0))]


def each(column: ca.MX, times: int) -> ca.MX:
    """Repeat a column for every stage."""
    return ca.repmat(column, 1, times)
