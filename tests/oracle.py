# SPDX-License-Identifier: Apache-2.0
"""Independent solution of a whole OCP: its nonlinear program, written anew from the equations and solved by IPOPT."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.rti.ocp import Ocp

# Bounds are not relaxed and the tolerances are tight: at a weakly active bound an interior point method stays sqrt(mu) away, and IPOPT's own
# error would be what a test of 1e-5 sees.
IPOPT = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-12,
    "ipopt.compl_inf_tol": 1e-13,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.max_iter": 500,
}


ROOT = 6**0.5
RADAU = {  # Radau IIA as in the literature, by the number of stages
    2: [[5 / 12, -1 / 12], [3 / 4, 1 / 4]],
    3: [
        [(88 - 7 * ROOT) / 360, (296 - 169 * ROOT) / 1800, (-2 + 3 * ROOT) / 225],
        [(296 + 169 * ROOT) / 1800, (88 + 7 * ROOT) / 360, (-2 - 3 * ROOT) / 225],
        [(16 - ROOT) / 36, (16 + ROOT) / 36, 1 / 9],
    ],
}


def collocated(ocp: Ocp, x: ca.SX, u: ca.SX, K: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the state after a stage of an implicit integrator and the equations of the rates K of its steps, which are variables of the program."""
    model, steps, stages = ocp.model, ocp.model.sim_method_num_steps, ocp.model.sim_method_num_stages
    f, h, a = ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr]), ocp.dt / steps, RADAU[stages]
    equations = []
    for step in range(steps):
        rates = ca.horzsplit(K)[step * stages : (step + 1) * stages]
        ends = [x + h * sum((a_ij * rate for a_ij, rate in zip(row, rates, strict=True)), start=ca.SX(0)) for row in a]
        equations += [rate - f(end, u, model.p_nominal) for rate, end in zip(rates, ends, strict=True)]
        x = ends[-1]
    return x, ca.vertcat(*equations)


def row(bound: Array, k: int) -> Array:
    """Return the bound, or the weights, of a stage."""
    return bound if bound.ndim == 1 else bound[k]


def nlp(ocp: Ocp, *, slacks: bool = True) -> Callable[..., tuple[Array, Array, float]]:
    """
    Build the nonlinear program of `rti_mpc.rti.ocp`, by multiple shooting, or by collocation where the integrator is implicit.

    Args:
        ocp: The problem.
        slacks: Whether bounds on states and second differences are softened; hard ones if not.

    Returns:
        ``solve(x0, u_prev, y_ref, x, u, u_before) -> (x, u, cost)`` from the guess ``x, u``; it fails where IPOPT does not converge. The input
        before `u_prev` is as that one if it is left out.
    """
    model, N, N_u = ocp.model, ocp.N, ocp.N_u
    nx, nu = model.nx, model.nu
    p = ca.DM(model.p_nominal)
    phi, u_ref = ocp.phi(), ca.Function("u_ref", [model.p], [ocp.u_ref])(p)
    h = ca.Function("h", [model.x, model.u, model.p], [model.y_expr])
    x = ca.SX.sym("x", nx, N + 1)
    u = ca.SX.sym("u", nu, N_u)
    s = ca.SX.sym("s", nx, N)
    s_e = ca.SX.sym("s_e", nx)
    nh = ocp.h_expr.numel()
    s_h, constraint = ca.SX.sym("s_h", nh, N), ca.Function("constraint", [model.x, model.u, model.p], [ca.densify(ocp.h_expr)])
    s_u = ca.SX.sym("s_u", nu, N_u)
    implicit = ocp.method == "irk"
    K = [ca.SX.sym(f"K_{k}", nx, model.sim_method_num_steps * model.sim_method_num_stages if implicit else 0) for k in range(N)]
    x0 = ca.SX.sym("x0", nx)
    u_prev, u_before = ca.SX.sym("u_prev", nu), ca.SX.sym("u_before", nu)
    y_ref = ca.SX.sym("y_ref", model.ny, N)

    rows: list[tuple[Array, ca.SX, Array]] = [(np.zeros(nx), x[:, 0] - x0, np.zeros(nx))]
    cost = ca.SX(0)
    for k in range(N):
        held = u[:, [j for j, length in enumerate(ocp.blocks) for _ in range(length)][k]]
        e = model.residual(h(x[:, k + 1], held, p), y_ref[:, k])
        factors = np.broadcast_to(ocp.delta[k], model.ny) ** 0.5
        cost += ca.bilin(ca.DM(ocp.Q), factors * e, factors * e)
        cost += ca.bilin(ca.DM(ocp.Q_e), e, e) if k == N - 1 else 0.0
        cost += ca.dot(ca.DM(row(ocp.z, k)), s[:, k]) + 0.5 * ca.dot(ca.DM(row(ocp.Z, k)), s[:, k] ** 2)
        x_next, equations = collocated(ocp, x[:, k], held, K[k]) if implicit else (phi(x[:, k], held, p), ca.SX(0, 1))
        equations = ca.vertcat(x_next - x[:, k + 1], equations)
        rows.append((np.zeros(equations.numel()), equations, np.zeros(equations.numel())))
        rows.append((np.full(nx, -np.inf), x[:, k + 1] - s[:, k], row(ocp.ubx, k)))
        rows.append((row(ocp.lbx, k), x[:, k + 1] + s[:, k], np.full(nx, np.inf)))
        if nh:
            value = constraint(x[:, k + 1], held, p)
            cost += ca.dot(ca.DM(row(ocp.zh, k)), s_h[:, k]) + 0.5 * ca.dot(ca.DM(row(ocp.Zh, k)), s_h[:, k] ** 2)
            rows += [(np.full(nh, -np.inf), value - s_h[:, k], row(ocp.uh, k)), (row(ocp.lh, k), value + s_h[:, k], np.full(nh, np.inf))]
    cost += ca.dot(ca.DM(row(ocp.z, N - 1)), s_e) + 0.5 * ca.dot(ca.DM(row(ocp.Z, N - 1)), s_e**2)
    rows.append((np.full(nx, -np.inf), x[:, N] - s_e, ocp.ubx_e))
    rows.append((ocp.lbx_e, x[:, N] + s_e, np.full(nx, np.inf)))
    last, du_last = u_prev, u_prev - u_before
    for k in range(N_u):
        du = u[:, k] - last
        changed = np.broadcast_to(ocp.lambda_[k], nu) ** 0.5 * du
        cost += ca.bilin(ca.DM(ocp.R), changed, changed)
        rows.append((row(ocp.lbdu, k), du, row(ocp.ubdu, k)))
        cost += ca.dot(ca.DM(np.broadcast_to(ocp.R_u, (N_u, nu))[k]), (u[:, k] - u_ref) ** 2)
        cost += ca.dot(ca.DM(ocp.zddu), s_u[:, k]) + 0.5 * ca.dot(ca.DM(ocp.Zddu), s_u[:, k] ** 2)
        rows.append((np.full(nu, -np.inf), du - du_last - s_u[:, k], ocp.ubddu))
        rows.append((ocp.lbddu, du - du_last + s_u[:, k], np.full(nu, np.inf)))
        last, du_last = u[:, k], du

    lbg, g, ubg = zip(*rows, strict=True)
    program = {"x": ca.veccat(x, u, s, s_e, s_h, s_u, *K), "f": cost, "g": ca.vertcat(*g), "p": ca.veccat(x0, u_prev, u_before, y_ref)}
    solver = ca.nlpsol("nlp", "ipopt", program, IPOPT)
    free, rates = np.full(nx * (N + 1), np.inf), np.full(sum(each.numel() for each in K), np.inf)
    slack = nx * (N + 1) + nh * N + nu * N_u
    most = np.full(slack, np.inf if slacks else 0.0)
    bounds = {
        "lbg": np.concatenate(lbg),
        "ubg": np.concatenate(ubg),
        "lbx": np.concatenate([-free, np.broadcast_to(ocp.lbu, (N_u, nu)).ravel(), np.zeros(slack), -rates]),
        "ubx": np.concatenate([free, np.broadcast_to(ocp.ubu, (N_u, nu)).ravel(), most, rates]),
    }

    def solve(x0: Array, u_prev: Array, y_ref: Array, x: Array, u: Array, u_before: Array | None = None) -> tuple[Array, Array, float]:
        guess = np.concatenate([x.ravel(), u.ravel(), np.zeros(slack + len(rates))])
        answer = solver(x0=guess, p=np.concatenate([x0, u_prev, u_prev if u_before is None else u_before, y_ref.ravel()]), **bounds)
        assert solver.stats()["success"], solver.stats()["return_status"]
        z = np.array(answer["x"]).ravel()
        return z[: x.size].reshape(x.shape), z[x.size : x.size + u.size].reshape(u.shape), float(answer["f"])

    return solve
