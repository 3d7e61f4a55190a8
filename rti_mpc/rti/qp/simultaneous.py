# SPDX-License-Identifier: Apache-2.0
r"""
The simultaneous formulation: states and inputs are variables, the QP is sparse.

Its variables are :math:`z = (\Delta x_0, \dots, \Delta x_N, \Delta u_0, \dots,
\Delta u_{N_u - 1}, s_1, \dots, s_N)`, its rows

1. the initial state, the only ones the feedback phase touches,
2. the dynamics,
3. the bounds on inputs, and on increments,
4. the softened bounds, from above and from below, and :math:`s \ge 0`.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
import scipy.sparse as sp

from rti_mpc.codegen import function
from rti_mpc.rti.blocks import at_each, stacked
from rti_mpc.rti.linearization import Linearization, change, linearization, nonzeros
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
    of_signals,
    picked,
)


def simultaneous(ocp: Ocp, *, softened: bool = True) -> Transcription:
    """
    Transcribe an OCP with states and inputs as variables.

    Args:
        ocp: The problem.
        softened: Whether the softened bounds, on states and general constraints, and their slacks are there.
    """
    lin = linearization(ocp)
    N, N_u, nx, nu, held = ocp.N, ocp.N_u, ocp.model.nx, ocp.model.nu, ocp.held.tolist()
    ng = ocp.ng if softened else 0
    kind = KIND_NAMES[softened]
    to_du, to_s = (N + 1) * nx, (N + 1) * nx + N_u * nu
    n = to_s + N * ng

    A, rows = Blocks(), BoundRows()
    by_state, by_input, by_bound = measured_by(ocp)
    zero = ca.MX.zeros(nx)
    A.place(rows.add(zero, zero, zero, by_state), 0, sp.eye_array(nx))

    # Dynamics: A_k dx_k + B_k du_k - dx_{k+1} = -b_k.
    row = rows.add(ca.MX.zeros(lin.b.shape), lin.b, ca.MX.zeros(lin.b.shape), by_state)
    A.place_values(ca.vec(lin.A), [(row + k * nx, k * nx, lin.A_k) for k in range(N)])
    A.place_values(ca.vec(lin.B), [(row + k * nx, to_du + held[k] * nu, lin.B_k) for k in range(N)])
    A.place(row, nx, -sp.eye_array(N * nx))

    input_rows(ocp, lin, rows, A, to_du)

    first_soft = rows.count
    sides: list[tuple[int, list[int]]] = []
    # Softened bounds: g - s <= ug, g + s >= lg, s >= 0.
    for bounds, limit, sign in ((ocp.tightest("ug"), lin.ug, -1), (ocp.tightest("lg"), lin.lg, 1)):
        at = finite(bounds) if ng else []
        if at:
            side = at_each(of_signals(limit, at), N)
            row = rows.add(None if sign < 0 else side, lin.g[at, :], side if sign < 0 else None, by_bound[at])
            places = [(row + i * len(at), nx + i * nx, to_du + held[i] * nu) for i in range(N)]  # row, column of dx, column of du
            for column, values, sparsity in ((1, lin.g_x, lin.G_x), (2, lin.g_u, lin.G_u)):
                chosen, block = picked(sparsity, at)
                if chosen:
                    A.place_values(ca.vec(values[chosen, :]), [(place[0], place[column], block) for place in places])
            A.place(row, to_s, sign * SLACK_UNIT * sp.kron(sp.eye_array(N), np.eye(ng)[at]))
            rows.chain(row, len(at))
            sides.append((row, at))
    if ng:
        A.place(rows.add_slacks(ng, N, by_bound, sides), to_s, sp.eye_array(N * ng))

    P = Blocks()
    in_upper = [i for i, (row, col) in enumerate(zip(*lin.H_i.get_triplet(), strict=True)) if row <= col < nx]
    H_upper = ca.triu(ca.DM(lin.H_i, 1)[:nx, :nx]).sparsity()
    P.place_values(ca.vec(lin.hessian[in_upper, :]), [(nx + i * nx, nx + i * nx, H_upper) for i in range(N)])
    for i in range(N) if lin.H_i.size1() > nx else ():
        coupling, _ = lin.output_hessian(i)
        P.place_values(nonzeros(coupling), [(nx + i * nx, to_du + held[i] * nu, coupling.sparsity())])
    for k in range(N_u):
        at_k = to_du + k * nu
        diagonal, beside = lin.increment_hessian(k)
        P.place_values(nonzeros(ca.triu(diagonal)), [(at_k, at_k, ca.triu(diagonal).sparsity())])
        if beside is not None:
            P.place_values(nonzeros(beside), [(at_k, at_k + nu, beside.sparsity())])
    if ng:
        P.place_values(stacked(SLACK_UNIT**2 / 2 * lin.Zg, N), [(to_s, to_s, ca.Sparsity.diag(N * ng))])
    q = ca.vertcat(zero, ca.vec(lin.gradient[:nx, :]), ca.vec(lin.increment_gradient()), *([stacked(SLACK_UNIT / 2 * lin.zg, N)] if ng else []))

    A_pattern, A_data = A.finish(rows.count, n)
    P_pattern, P_data = P.finish(n, n)
    memory = ca.veccat(*head(lin))
    lower, upper = ca.vertcat(*rows.lower), ca.vertcat(*rows.upper)
    everything, varying, data = data_functions(
        lin, kind, q=q, P_data=P_data, A_data=A_data, lower=lower, upper=upper, memory=memory, checksum=lin.checksum
    )
    return Transcription(
        P=P_pattern,
        A=A_pattern,
        everything=everything,
        varying=varying,
        data=data,
        embed=embed(ocp, kind, memory.numel()),
        embedded=(("lower", slice(0, nx)), ("upper", slice(0, nx))),
        step=full_step(ocp, kind, lin, n, memory.numel()),
        columns=np.concatenate([np.tile(by_state, N + 1), np.tile(by_input, N_u), np.tile(by_bound[:ng], N)]),
        rows=np.array(rows.scales),
        eliminable=to_du,
        watched=rows.watched_from(first_soft),
    )


def embed(ocp: Ocp, kind: str, remembered: int) -> ca.Function:
    """Write the initial state into the bounds of its rows."""
    x0 = ca.SX.sym("x0", ocp.model.nx)
    x = ca.SX.sym("x", ocp.model.nx, ocp.N + 1)
    deviation = x0 - x[:, 0]
    memory = ca.SX.sym("memory", remembered)
    return function(f"embed_{kind}", {"x0": x0, "x": x, "memory": memory}, {"lower_embedded": deviation, "upper_embedded": deviation})


def full_step(ocp: Ocp, kind: str, lin: Linearization, n: int, remembered: int) -> ca.Function:
    """Read states and inputs from the solution."""
    z = ca.MX.sym("z", n)
    x0 = ca.MX.sym("x0", ocp.model.nx)
    known = Remembered(ocp, lin, remembered)
    x, u, u_prev, w = lin.x, lin.u, lin.u_prev, lin.w
    to_du, to_s = x.numel(), x.numel() + u.numel()
    dx, du = ca.reshape(z[:to_du], x.shape), ca.reshape(z[to_du:to_s], u.shape)
    u_plan = clipped(u + du, u_prev, w)
    start = {"x": x, "u": u, "u_prev": u_prev, "solution": z, "x0": x0, "memory": known.memory}
    plan = {"x_plan": x + dx, "u_plan": u_plan, "violation": known.violation(dx, du, w), "change": change(lin, u_plan)}
    return function(f"step_{kind}", {**start, **lin.weights}, plan)
