# SPDX-License-Identifier: Apache-2.0
r"""
The sequential formulation: the states are eliminated, inputs alone are variables, the QP is small and dense.

With the response of the states to the inputs, to the initial state and to the
defects,

.. math::

    \Delta x_i = G_i \Delta u + \Phi_i \Delta x_0 + c_i ,

the QP in :math:`z = (\Delta u_0, \dots, \Delta u_{N_u - 1}, s_1, \dots, s_N)`
has the Hessian :math:`\sum_i G_i^T H_i G_i` and the gradient :math:`\sum_i G_i^T
(H_i (\Phi_i \Delta x_0 + c_i) + g_i)`, plus what belongs to the increments. A
backward recursion makes both with :math:`O(N^2)` operations: "condensing",
[Andersson2013]_. Feedback adds the terms in :math:`\Delta x_0`.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import scipy.sparse as sp

from rti_mpc.linearization import Linearization
from rti_mpc.ocp import Ocp
from rti_mpc.transcription import (
    SLACK_UNIT,
    Blocks,
    Rows,
    Transcription,
    clipped,
    data_functions,
    finite,
    input_rows,
    violation,
    weight_symbols,
)


class Condensing:
    """
    Expressions of the condensed problem.

    The responses to inputs, initial state and defects are columns of one matrix, so that two loops over the stages make everything.

    Attributes:
        G: Responses at nodes 1 to N, each of shape ``(nx, nu * N_u + nx + 1)``: to the inputs, to the initial state, to the defects.
        H: Rows of the Hessian, one block of shape ``(nu, nu * N_u)`` for each input; right up to its diagonal block.
        M: Gradient in the inputs: coefficients of the initial state and, in the last column, the rest; shape ``(nu * N_u, nx + 1)``.
    """

    def __init__(self, ocp: Ocp, lin: Linearization) -> None:
        N, N_u, nx, nu = ocp.N, ocp.N_u, ocp.model.nx, ocp.model.nu
        inputs, width = nu * N_u, nu * N_u + nx + 1
        a, b, h = (ca.SX.sym(name, pattern.nnz()) for name, pattern in (("a", lin.A_k), ("b", lin.B_k), ("h", lin.H_i)))
        A, B, H = ca.SX(lin.A_k, a), ca.SX(lin.B_k, b), ca.triu2symm(ca.SX(lin.H_i, h))
        acting = ca.SX.sym("acting", N_u)  # 1 for the input that acts at the stage
        last = ca.SX.sym("last", nx)
        X, W = ca.SX.sym("X", nx, width), ca.SX.sym("W", nx, width)
        beside = ca.horzcat(ca.SX(nx, width - 1), last)

        response = ca.horzcat(ca.kron(acting.T, B), ca.SX(nx, nx), last)
        forward = ca.Function("forward", [X, a, b, acting, last], [ca.densify(A @ X + response)])
        sum_W = ca.densify(H @ X + A.T @ W + beside)
        backward = ca.Function("backward", [W, a, b, h, X, last], [sum_W, ca.densify(B.T @ sum_W)])

        start = ca.DM.zeros(nx, width)
        start[:, inputs:-1] = ca.DM.eye(nx)
        schedule = ca.DM(np.eye(N_u)[:, np.minimum(np.arange(N), N_u - 1)])
        responses = forward.mapaccum("forwards", N)(start, lin.A, lin.B, schedule, lin.b)
        self.G = ca.horzsplit(responses, width)

        # Backwards, from node N: W_i = H_i G_i + A_i' W_{i+1}, and rows B_{i-1}' W_i.
        back = list(range(N))[::-1]
        A_after = ca.horzcat(lin.A[:, 1:], ca.MX.zeros(lin.A_k.nnz()))
        columns = [width * i + j for i in back for j in range(width)]
        sums = backward.mapaccum("backwards", N)(
            ca.DM.zeros(nx, width), A_after[:, back], lin.B[:, back], lin.hessian[:, back], responses[:, columns], lin.gradient[:, back]
        )[1]
        rows = ca.horzsplit(sums, width)[::-1]
        held = rows[N_u - 1]
        for row in rows[N_u:]:
            held = held + row
        rows = [*rows[: N_u - 1], held]
        self.H = [row[:, :inputs] for row in rows]
        self.M = ca.vertcat(*(row[:, inputs:] for row in rows))


def sequential(ocp: Ocp, *, state_bounds: bool = True) -> Transcription:
    """
    Transcribe an OCP with the inputs alone as variables.

    Args:
        ocp: The problem.
        state_bounds: Whether the bounds on states, and their slacks, are there.
    """
    lin = Linearization(ocp)
    condensed = Condensing(ocp, lin)
    N, N_u, nx, nu, w = ocp.N, ocp.N_u, ocp.model.nx, ocp.model.nu, lin.w
    soft = list(ocp.soft) if state_bounds else []
    to_s = N_u * nu
    n = to_s + N * len(soft)

    A, rows = Blocks(), Rows()
    input_rows(ocp, lin, rows, A, 0)
    first_soft = rows.count

    # Softened bounds on states: G du - s <= ubx - x - c, G du + s >= lbx - x - c, s >= 0; feedback subtracts Phi dx_0.
    limits: list[tuple[str, int, int]] = []  # bound, node, state
    for bound, sign in (("ubx", -1), ("lbx", 1)):
        at = [j for j in finite(getattr(ocp, bound)) if j in soft]
        for i in range(N) if at else ():
            value = lin.x[at, i + 1] + condensed.G[i][at, -1]
            limit = w[bound][at]
            row = rows.add(None if sign < 0 else limit, value, limit if sign < 0 else None)
            G = condensed.G[i][at, : nu * min(i + 1, N_u)]
            A.place_values(ca.vec(G), [(row, 0, ca.Sparsity.dense(*G.shape))])
            A.place(row, to_s + i * len(soft), sign * SLACK_UNIT * sp.csc_array(np.eye(nx)[np.ix_(at, soft)]))
            limits += [(bound, i, j) for j in at]
    end_soft = rows.count
    if soft:
        slack = ca.MX.zeros(len(soft), N)
        A.place(rows.add(slack, slack, None), to_s, sp.eye_array(N * len(soft)))
    if not rows.count:
        A.place(rows.add(None, ca.MX.zeros(1), None), 0, sp.csc_array(np.eye(1)))  # OSQP wants a row

    P = Blocks()
    for k in range(N_u):
        column = condensed.H[k][:, : nu * (k + 1)].T
        diagonal, _ = lin.increment_hessian(k)
        beside = lin.increment_hessian(k - 1)[1] if k else None
        addition = [ca.MX.zeros(nu * max(0, k - 1), nu), *([ca.densify(beside)] if beside is not None else []), ca.densify(diagonal)]
        column = column + ca.vertcat(*addition)
        upper = np.vstack([np.ones((k * nu, nu)), np.triu(np.ones((nu, nu)))])
        P.place_values(ca.vec(column)[np.flatnonzero(upper.T.ravel()).tolist()], [(0, k * nu, ca.DM(sp.csc_matrix(upper)).sparsity())])
    if soft:
        P.place_values(ca.repmat(SLACK_UNIT**2 / 2 * w["Z"][soft], N), [(to_s, to_s, ca.Sparsity.diag(N * len(soft)))])
    q_inputs = condensed.M[:, nx] + ca.vec(lin.increment_gradient())
    q = ca.vertcat(q_inputs, ca.repmat(SLACK_UNIT / 2 * w["z"][soft], N))

    lower, upper_bounds = ca.vertcat(*rows.lower), ca.vertcat(*rows.upper)
    Phi = ca.vertcat(*(condensed.G[i][j, to_s : to_s + nx] for _, i, j in limits)) if limits else ca.MX(0, nx)
    memory = ca.veccat(lin.A, lin.B, lin.b, q_inputs, condensed.M[:, :nx], Phi, lower[first_soft:end_soft], upper_bounds[first_soft:end_soft])
    A_pattern, A_data = A.finish(rows.count, n)
    P_pattern, P_data = P.finish(n, n)
    checksum = lin.checksum + ca.sum1(memory) + ca.sum1(P_data)
    everything, varying, data = data_functions(lin, [q, P_data, A_data, lower, upper_bounds, memory, lin.cost, checksum])
    after_stages = lin.A.numel() + lin.B.numel() + lin.b.numel()
    return Transcription(
        P=P_pattern,
        A=A_pattern,
        everything=everything,
        varying=varying,
        data=data,
        embed=embed(ocp, memory.numel(), after_stages, end_soft - first_soft),
        embedded=(("q", slice(0, to_s)), *((name, slice(first_soft, end_soft)) for name in ("l", "u") if soft)),
        step=full_step(ocp, lin, n, memory.numel()),
        slacks=slice(to_s, n),
        eliminable=0,
    )


def embed(ocp: Ocp, remembered: int, start: int, soft_rows: int) -> ca.Function:
    """Add the response to the initial state: to the gradient, and to the softened bounds."""
    nx, inputs = ocp.model.nx, ocp.N_u * ocp.model.nu
    x0 = ca.MX.sym("x0", nx)
    x = ca.MX.sym("x", nx, ocp.N + 1)
    memory = ca.MX.sym("memory", remembered)
    deviation = x0 - x[:, 0]
    lengths = (inputs, inputs * nx, soft_rows * nx, soft_rows, soft_rows)
    q, M, Phi, lower, upper = ca.vertsplit(memory[start:], np.cumsum([0, *lengths]).tolist())
    outputs = [q + ca.reshape(M, inputs, nx) @ deviation]
    if soft_rows:
        response = ca.reshape(Phi, soft_rows, nx) @ deviation
        outputs += [lower - response, upper - response]
    return ca.Function("embed", [x0, x, memory], outputs)


def full_step(ocp: Ocp, lin: Linearization, n: int, remembered: int) -> ca.Function:
    """Read the inputs off the solution, and let the linearized dynamics make the states."""
    N, N_u, nx = ocp.N, ocp.N_u, ocp.model.nx
    x = ca.SX.sym("x", nx, N + 1)
    u = ca.SX.sym("u", ocp.model.nu, N_u)
    u_prev = ca.SX.sym("u_prev", ocp.model.nu)
    z = ca.SX.sym("z", n)
    x0 = ca.SX.sym("x0", nx)
    memory = ca.SX.sym("memory", remembered)
    w = weight_symbols(ocp)
    at = np.cumsum([0, lin.A.numel(), lin.B.numel(), lin.b.numel()]).tolist()
    A, B, b = (ca.reshape(memory[at[i] : at[i + 1]], -1, N) for i in range(3))
    du = ca.reshape(z[: u.numel()], u.shape)
    dx = [x0 - x[:, 0]]
    for k in range(N):
        dx.append(ca.SX(lin.A_k, A[:, k]) @ dx[k] + ca.SX(lin.B_k, B[:, k]) @ du[:, min(k, N_u - 1)] + b[:, k])
    x_plan = x + ca.horzcat(*dx)
    u_plan = clipped(ocp, u + du, u_prev, w)
    return ca.Function("step", [x, u, u_prev, z, x0, memory, *w.values()], [ca.densify(x_plan), u_plan, violation(ocp, x_plan, w)])
