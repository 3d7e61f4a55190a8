# SPDX-License-Identifier: Apache-2.0
r"""
The sequential formulation: the states are eliminated, only inputs are variables, the QP is small and dense.

With the response of the states to the inputs, to the initial state and to the
defects,

.. math::

    \Delta x_i = G_i \Delta u + \Phi_i \Delta x_0 + c_i ,

the QP in :math:`z = (\Delta u_0, \dots, \Delta u_{N_u - 1}, s_1, \dots, s_N)`
has the Hessian :math:`\sum_i G_i^T H_i G_i` and the gradient :math:`\sum_i G_i^T
(H_i (\Phi_i \Delta x_0 + c_i) + g_i)`, plus the terms of the increments. A backward
recursion computes both with :math:`O(N^2)` operations ("condensing" [Andersson2013]_).
Feedback adds the terms in :math:`\Delta x_0`.
"""

from __future__ import annotations

from itertools import pairwise
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np
import scipy.sparse as sp

from rti_mpc.codegen import function
from rti_mpc.rti.blocks import all_inputs, stacked
from rti_mpc.rti.linearization import Linearization, change, linearization
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.transcription import (
    KIND_NAMES,
    SLACK_UNIT,
    Blocks,
    BoundRows,
    Remembered,
    Transcription,
    clipped,
    data_functions,
    finite,
    head,
    input_rows,
    measured_by,
)


class Condensing:
    """
    Expressions of the condensed problem.

    Attributes:
        G: Response of the states at nodes 1 to N to the inputs that have acted by then, each of shape ``(nx, nu * (held[i - 1] + 1))``.
        Phi: Response to the initial state, each of shape ``(nx, nx)``.
        c: Response to the defects, each of shape ``(nx, 1)``.
        H: Rows of the Hessian up to the diagonal block, one of shape ``(nu, nu * (k + 1))`` for each input.
        M: Coefficients of the initial state in the gradient, shape ``(nu * N_u, nx)``.
        m: The rest of the gradient, shape ``(nu * N_u, 1)``.
    """

    def __init__(self, ocp: Ocp, lin: Linearization) -> None:
        N, N_u, nx, nu, held = ocp.N, ocp.N_u, ocp.model.nx, ocp.model.nu, ocp.held.tolist()
        self.G: list[ca.MX] = []
        self.Phi: list[ca.MX] = []
        self.c: list[ca.MX] = []
        apply_A, apply_H_A, apply_B, dense_B = kernels(lin, nu)
        on_state = kernels(lin, nx)
        on_defect = kernels(lin, 1)

        G, Phi, c = ca.MX(nx, 0), ca.MX(ca.DM.eye(nx)), ca.MX.zeros(nx)
        for k in range(N):
            G = over_blocks(apply_A, held[k - 1] + 1, [0])(lin.A[:, k], G) if k else G
            B_k = dense_B(lin.B[:, k])
            G = ca.horzcat(G, B_k) if k == 0 or held[k] > held[k - 1] else ca.horzcat(G[:, :-nu], G[:, -nu:] + B_k)
            Phi = on_state[0](lin.A[:, k], Phi)
            c = on_defect[0](lin.A[:, k], c) + lin.b[:, k]
            self.G.append(G)
            self.Phi.append(Phi)
            self.c.append(c)

        # Backwards: W_i = H_i X_i + A_i' W_{i+1} for each response X, of G the blocks before node i alone; rows B_{i-1}' W_i.
        self.H: list[ca.MX] = [ca.MX.zeros(nu, nu * (k + 1)) for k in range(N_u)]
        M = [ca.MX.zeros(nu, nx) for _ in range(N_u)]
        m = [ca.MX.zeros(nu) for _ in range(N_u)]
        W_G, W_Phi, W_c = ca.MX.zeros(nx, nu * N_u), ca.MX.zeros(nx, nx), ca.MX.zeros(nx)
        for k in reversed(range(N)):
            blocks = held[k] + 1
            A_after = lin.A[:, k + 1] if k < N - 1 else ca.MX.zeros(lin.A_k.nnz())
            W_G = over_blocks(apply_H_A, blocks, [0, 1])(lin.hessian[:, k], A_after, self.G[k], W_G[:, : nu * blocks])
            W_Phi = on_state[1](lin.hessian[:, k], A_after, self.Phi[k], W_Phi)
            W_c = on_defect[1](lin.hessian[:, k], A_after, self.c[k], W_c) + lin.gradient[:nx, k]
            if lin.H_i.size1() > nx:  # the input before the node acts on its outputs, too; `increment_hessian` has the block of the input alone
                Hxu = ca.densify(lin.output_hessian(k)[0])
                W_G = ca.horzcat(W_G[:, :-nu], W_G[:, -nu:] + Hxu)
                self.H[blocks - 1] += Hxu.T @ self.G[k]
                M[blocks - 1] += Hxu.T @ self.Phi[k]
                m[blocks - 1] += Hxu.T @ self.c[k]
            self.H[blocks - 1] += over_blocks(apply_B, blocks, [0])(lin.B[:, k], W_G)
            M[blocks - 1] += on_state[2](lin.B[:, k], W_Phi)
            m[blocks - 1] += on_defect[2](lin.B[:, k], W_c)
        self.M, self.m = ca.vertcat(*M), ca.vertcat(*m)


_condensings: WeakKeyDictionary[Linearization, Condensing] = WeakKeyDictionary()


def condensing(ocp: Ocp, lin: Linearization) -> Condensing:
    """Return the condensed problem, which its transcriptions with and without softened bounds share, built at the first call."""
    if lin not in _condensings:
        _condensings[lin] = Condensing(ocp, lin)
    return _condensings[lin]


def kernels(lin: Linearization, width: int) -> tuple[ca.Function, ca.Function, ca.Function, ca.Function]:
    """Return ``A X``, ``H X + A' W`` and ``B' W`` for `width` columns, and B; from nonzeros, with every structural zero left out."""
    a, b, h = (ca.SX.sym(name, pattern.nnz()) for name, pattern in (("a", lin.A_k), ("b", lin.B_k), ("h", lin.H_i)))
    A, B, H = ca.SX(lin.A_k, a), ca.SX(lin.B_k, b), ca.SX(lin.H_i, h)
    H = H[: A.shape[0], : A.shape[0]]
    X, W = (ca.SX.sym(name, A.shape[0], width) for name in ("X", "W"))
    return (
        ca.Function(f"apply_A_{width}", [a, X], [ca.densify(A @ X)]),
        ca.Function(f"apply_H_A_{width}", [h, a, X, W], [ca.densify(H @ X + A.T @ W)]),
        ca.Function(f"apply_B_{width}", [b, W], [ca.densify(B.T @ W)]),
        ca.Function("dense_B", [b], [ca.densify(B)]),
    )


def over_blocks(function: ca.Function, blocks: int, shared: list[int]) -> ca.Function:
    """Return a function mapped over blocks side by side; the arguments in `shared` are the same for all blocks."""
    return function if blocks == 1 else function.map(f"{function.name()}_{blocks}", "serial", blocks, shared, [], {})


def sequential(ocp: Ocp, *, softened: bool = True) -> Transcription:
    """
    Transcribe an OCP with only the inputs as variables.

    Args:
        ocp: The problem.
        softened: Whether the softened bounds, on states and general constraints, and their slacks are there.
    """
    lin = linearization(ocp)
    condensed = condensing(ocp, lin)
    N, N_u, nu = ocp.N, ocp.N_u, ocp.model.nu
    ng = ocp.ng if softened else 0
    kind = KIND_NAMES[softened]
    to_s = N_u * nu
    n = to_s + N * ng

    A, rows = Blocks(), BoundRows()
    _, by_input, by_bound = measured_by(ocp)
    input_rows(ocp, lin, rows, A, 0)
    first_soft = rows.count

    sides: list[tuple[int, list[int]]] = []
    # Softened bounds on g: the same with g_x G_i for the response to the inputs; feedback subtracts the one to the initial state.
    responses: list[ca.MX] = []
    for bounds, limit, sign in ((ocp.tightest("ug"), lin.ug, -1), (ocp.tightest("lg"), lin.lg, 1)):
        at = finite(bounds) if ng else []
        for i in range(N) if at else ():
            G_x, G_u = (ca.densify(ca.MX(sparsity, e[:, i])[at, :]) for sparsity, e in ((lin.G_x, lin.g_x), (lin.G_u, lin.g_u)))
            value = lin.g[at, i] + G_x @ condensed.c[i]
            side = limit[at] if limit.size2() == 1 else limit[at, i]
            row = rows.add(None if sign < 0 else side, value, side if sign < 0 else None, by_bound[at])
            response = G_x @ condensed.G[i]
            response = ca.horzcat(response[:, :-nu], response[:, -nu:] + G_u)
            A.place_values(ca.vec(response), [(row, 0, ca.Sparsity.dense(*response.shape))])
            A.place(row, to_s + i * ng, sign * SLACK_UNIT * sp.csc_array(np.eye(ng)[at]))
            responses.append(G_x @ condensed.Phi[i])
        if at:
            rows.chain(rows.count - N * len(at), len(at))
            sides.append((rows.count - N * len(at), at))
    end_soft = rows.count
    if ng:
        A.place(rows.add_slacks(ng, N, by_bound, sides), to_s, sp.eye_array(N * ng))
    watched = rows.watched_from(first_soft)
    if not rows.count:
        A.place(rows.add(None, ca.MX.zeros(1), None, by_input[:1]), 0, sp.csc_array(np.eye(1)))  # OSQP needs at least one row

    P = Blocks()
    for k in range(N_u):
        column = condensed.H[k].T
        diagonal, _ = lin.increment_hessian(k)
        beside = lin.increment_hessian(k - 1)[1] if k else None
        addition = [ca.MX.zeros(nu * max(0, k - 1), nu), *([ca.densify(beside)] if beside is not None else []), ca.densify(diagonal)]
        column = column + ca.vertcat(*addition)
        upper = np.vstack([np.ones((k * nu, nu)), np.triu(np.ones((nu, nu)))])
        P.place_values(ca.vec(column)[np.flatnonzero(upper.T.ravel()).tolist()], [(0, k * nu, ca.DM(sp.csc_matrix(upper)).sparsity())])
    if ng:
        P.place_values(stacked(SLACK_UNIT**2 / 2 * lin.Zg, N), [(to_s, to_s, ca.Sparsity.diag(N * ng))])
    q_inputs = condensed.m + ca.vec(lin.increment_gradient())
    q = ca.vertcat(q_inputs, *([stacked(SLACK_UNIT / 2 * lin.zg, N)] if ng else []))

    lower, upper_bounds = ca.vertcat(*rows.lower), ca.vertcat(*rows.upper)
    Phi = ca.vertcat(*responses)
    known = [*head(lin), lin.A, lin.B, lin.b]
    memory = ca.veccat(*known, q_inputs, condensed.M, Phi, lower[first_soft:end_soft], upper_bounds[first_soft:end_soft])
    A_pattern, A_data = A.finish(rows.count, n)
    P_pattern, P_data = P.finish(n, n)
    checksum = lin.checksum + ca.sum1(memory) + ca.sum1(P_data)
    everything, varying, data = data_functions(
        lin, kind, q=q, P_data=P_data, A_data=A_data, lower=lower, upper=upper_bounds, memory=memory, checksum=checksum
    )
    return Transcription(
        P=P_pattern,
        A=A_pattern,
        everything=everything,
        varying=varying,
        data=data,
        embed=embed(ocp, kind, memory.numel(), sum(e.numel() for e in known), end_soft - first_soft),
        embedded=(("q", slice(0, to_s)), *((name, slice(first_soft, end_soft)) for name in ("lower", "upper") if end_soft > first_soft)),
        step=full_step(ocp, kind, lin, n, memory.numel()),
        columns=np.concatenate([np.tile(by_input, N_u), np.tile(by_bound[:ng], N)]),
        rows=np.array(rows.scales),
        eliminable=0,
        watched=watched,
    )


def embed(ocp: Ocp, kind: str, remembered: int, start: int, soft_rows: int) -> ca.Function:
    """Add the response to the initial state: to the gradient, and to the softened bounds."""
    nx, inputs = ocp.model.nx, ocp.N_u * ocp.model.nu
    x0 = ca.MX.sym("x0", nx)
    x = ca.MX.sym("x", nx, ocp.N + 1)
    memory = ca.MX.sym("memory", remembered)
    deviation = x0 - x[:, 0]
    lengths = (inputs, inputs * nx, soft_rows * nx, soft_rows, soft_rows)
    q, M, Phi, lower, upper = ca.vertsplit(memory[start:], np.cumsum([0, *lengths]).tolist())
    outputs = {"q_embedded": q + ca.reshape(M, inputs, nx) @ deviation}
    if soft_rows:
        response = ca.reshape(Phi, soft_rows, nx) @ deviation
        outputs |= {"lower_embedded": lower - response, "upper_embedded": upper - response}
    return function(f"embed_{kind}", {"x0": x0, "x": x, "memory": memory}, outputs)


def full_step(ocp: Ocp, kind: str, lin: Linearization, n: int, remembered: int) -> ca.Function:
    """Read the inputs from the solution, and compute the states by the linearized dynamics."""
    N, nx = ocp.N, ocp.model.nx
    z = ca.MX.sym("z", n)
    x0 = ca.MX.sym("x0", nx)
    known = Remembered(ocp, lin, remembered)
    x, u, u_prev, w = lin.x, lin.u, lin.u_prev, lin.w
    shapes = [e.shape for e in (lin.A, lin.B, lin.b)]
    ends = np.cumsum([0, *(rows * columns for rows, columns in shapes)]).tolist()
    A, B, b = (ca.reshape(known.rest[start:end], *shape) for (start, end), shape in zip(pairwise(ends), shapes, strict=True))
    du = ca.reshape(z[: u.numel()], u.shape)

    dx_k, du_k = ca.SX.sym("dx", nx), ca.SX.sym("du", u.shape[0])
    A_k, B_k, b_k = (ca.SX.sym(name, shape[0]) for name, shape in zip("ABb", shapes, strict=True))
    ahead = ca.SX(lin.A_k, A_k) @ dx_k + ca.SX(lin.B_k, B_k) @ du_k + b_k
    advance = ca.Function("advance", [dx_k, A_k, B_k, du_k, b_k], [ca.densify(ahead)])
    if N > 1:
        advance = advance.mapaccum("advances", N)
    deviation = x0 - x[:, 0]
    dx = ca.horzcat(deviation, advance(deviation, A, B, all_inputs(du, ocp.blocks), b))
    u_plan = clipped(u + du, u_prev, w)
    start = {"x": x, "u": u, "u_prev": u_prev, "solution": z, "x0": x0, "memory": known.memory}
    plan = {"x_plan": x + dx, "u_plan": u_plan, "violation": known.violation(dx, du, w), "change": change(lin, u_plan)}
    return function(f"step_{kind}", {**start, **lin.weights}, plan)
