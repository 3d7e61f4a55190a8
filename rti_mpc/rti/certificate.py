# SPDX-License-Identifier: Apache-2.0
r"""
Certificate of a plan for the QP of a sample: a bound on its cost above the optimum, from the problem's own data.

Of the solver it uses only the multipliers of increments and softened bounds, which may
come from any solver: wrong ones make the bound looser, but never invalid. Let
r be the gradient of the Lagrangian, reduced to the inputs by one adjoint sweep. By
convexity it bounds the cost of every plan from below, so that a plan costs at most

.. math::

    \sum_i \max_{lbu_i \le v \le ubu_i} r_i (u_i - v)
    + \sum_j \mu_j \, (\text{distance to its bound})
    + \sum_j \left( p_j(s_j) - \mu_j s_j - \min_{s \ge 0} (p_j(s) - \mu_j s) \right)

more than the optimum: the duality gap, where p is the penalty on a slack. The
multipliers of bounds on inputs follow from r, and need not be known.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from rti_mpc.codegen import function
from rti_mpc.rti.blocks import all_inputs, at_each, summed
from rti_mpc.rti.linearization import Linearization, divided, linearization, partly, where_bounded
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.transcription import INFINITY
from rti_mpc.rti.recursion import recur

SMALLEST_DIVISOR = 1e-300  # replaces a quadratic penalty of zero


def certificate(ocp: Ocp) -> ca.Function:
    """
    Build ``(x, u, u_prev, x0, stages, x_plan, u_plan, multipliers, *ARGUMENTS, scale) -> (r, primal, gap, cost)``.

    `multipliers` holds those of increments, shape ``(nu, N_u)``, and then those of softened bounds, shape ``(ng, N)``; positive at an upper bound.
    `r` is the gradient of the Lagrangian reduced to the inputs, shape ``(nu, N_u)``, without the multipliers of bounds on inputs. `primal` is the
    largest violation of dynamics, bounds and increments relative to their scales. `gap` is a bound on the cost above the optimum, and `cost` the
    cost of the plan, penalties included, both normalised.
    """
    lin = linearization(ocp)
    N, N_u, nx, nu, ng = ocp.N, ocp.N_u, ocp.model.nx, ocp.model.nu, ocp.ng
    x_plan, u_plan, x0 = ca.MX.sym("x_plan", nx, N + 1), ca.MX.sym("u_plan", nu, N_u), ca.MX.sym("x0", nx)
    stages, multipliers = ca.MX.sym("stages", lin.stages.numel()), ca.MX.sym("multipliers", nu * N_u + ng * N)
    forms = lin.forms_in(stages)
    given_increments, of_softened = divided(multipliers, [lin.u, lin.g])
    of_increments = where_bounded(given_increments, ocp.lbdu, ocp.ubdu)
    if partly(ocp.lg).any() or partly(ocp.ug).any():
        of_softened = where_bounded(of_softened, ocp.lg, ocp.ug)
    w = lin.w

    dx, du = x_plan - lin.x, u_plan - lin.u
    shared = [at_each(e, N) for e in (lin.lg, lin.ug, lin.zg, lin.Zg, lin.scale_x, lin.scale_g)]
    data = (forms.A, forms.B, forms.b, forms.H, forms.h, forms.g, forms.g_x, forms.g_u)
    nodes = node(ocp, lin).map(N)(*data, dx[:, :-1], all_inputs(du, ocp.blocks), dx[:, 1:], of_softened, *shared)
    sums, by_x, by_u = nodes[:3, :], nodes[3 : 3 + nx, :], nodes[3 + nx :, :]

    sweep = recur("adjoint", [(adjoint(lin), N)], {"pi": "pi_before"}, ["gradient"], backward=True)
    gradient = sweep(A=forms.A, B=forms.B, by_u=by_u, by_x=by_x, pi=ca.MX.zeros(nx))["gradient"]
    reduced = summed(gradient, ocp.blocks)

    planned = u_plan - ca.horzcat(lin.u_prev, u_plan[:, :-1])
    forces = lin.weighed(planned)
    push, at_guess, of_steps = forces + of_increments, forms.force, ca.MX(0)
    if ocp.R_u.any():  # the force has the gradient of the cost of inputs, summed up
        at_guess = lin.weighed(forms.increments)
        push += forms.force - at_guess
        of_steps = ca.dot(forms.force - at_guess, planned - forms.increments) + ca.dot(at_each(w["R_u"], N_u) * du, du) / 2
    push = push - ca.horzcat(push[:, 1:], ca.MX.zeros(nu)) + at_each(forms.damping, N_u) * du
    shared = [at_each(e, N_u) for e in (w["lbu"], w["ubu"], w["lbdu"], w["ubdu"], lin.scale_u)]
    inputs = of_inputs(ocp).map(N_u)(reduced + push, u_plan, planned, of_increments, *shared)

    primal = ca.fmax(ca.fmax(ca.mmax(sums[0, :]), ca.mmax(inputs[0, :])), ca.mmax(ca.fabs(x_plan[:, 0] - x0) / lin.scale_x))
    gap = ca.sum2(sums[1, :]) + ca.sum2(inputs[1, :])
    total = (forms.cost - ca.dot(forms.increments, at_guess) + ca.dot(planned, forces)) / 2 + of_steps + ca.sum2(sums[2, :])
    guess = {"x": lin.x, "u": lin.u, "u_prev": lin.u_prev, "x0": x0, "stages": stages}
    plan = {"x_plan": x_plan, "u_plan": u_plan, "multipliers": multipliers}
    return function("certificate", {**guess, **plan, **lin.weights}, {"r": inputs[2:, :], "primal": primal, "gap": gap, "cost": total})


def node(ocp: Ocp, lin: Linearization) -> ca.Function:
    """Build the terms of one stage and the node at its end: ``-> [violation of the dynamics; gap; cost; gradients in dx and du]``."""
    nx, nu, ng = ocp.model.nx, ocp.model.nu, ocp.ng
    nz = [ca.SX.sym(name, pattern.nnz()) for name, pattern in zip("ABHXU", (lin.A_k, lin.B_k, lin.H_i, lin.G_x, lin.G_u), strict=True)]
    A, B, H, G_x, G_u = (ca.SX(pattern, values) for pattern, values in zip((lin.A_k, lin.B_k, lin.H_i, lin.G_x, lin.G_u), nz, strict=True))
    b, before, after, scale_x = (ca.SX.sym(name, nx) for name in ("b", "before", "after", "scale_x"))
    h = ca.SX.sym("h", H.shape[0])
    du = ca.SX.sym("du", nu)
    g, mu, lg, ug, zg, Zg, scale_g = (ca.SX.sym(name, ng) for name in ("g", "mu", "lg", "ug", "zg", "Zg", "scale_g"))
    violation = ca.mmax(ca.fabs(A @ before + B @ du + b - after) / scale_x)
    value = g + G_x @ after + G_u @ du
    gap = ca.SX(0)
    end = ca.vertcat(after, du)[: H.shape[0]]
    cost = ca.dot(h, end) + ca.dot(end, H @ end) / 2
    taken = ca.SX(ng, 1)
    below, above = (np.isfinite(ocp.tightest(name)) for name in ("lg", "ug"))
    for j in range(ng):
        for sign, bound, there in ((1, ug[j], above[j]), (-1, -lg[j], below[j])):
            if there:
                beyond = sign * value[j] - bound
                s = ca.fmax(0, beyond)
                penalty = (zg[j] * s + Zg[j] * s**2 / 2) / 2
                most = (zg[j] + Zg[j] * (s + scale_g[j])) / 2  # slope of the penalty beyond this slack: no multiplier is larger
                multiplier = ca.fmax(0, ca.fmin(sign * mu[j], most))
                gap += penalty - multiplier * beyond + ca.fmax(0, multiplier - zg[j] / 2) ** 2 / ca.fmax(Zg[j], SMALLEST_DIVISOR)
                cost += penalty
                taken[j] += sign * multiplier
    by_end = H @ end + h
    by_x, by_u = by_end[:nx] + G_x.T @ taken, by_end[nx:] + G_u.T @ taken if H.shape[0] > nx else G_u.T @ taken
    inputs = [nz[0], nz[1], b, nz[2], h, g, nz[3], nz[4], before, du, after, mu, lg, ug, zg, Zg, scale_x, scale_g]
    return ca.Function("certify_node", inputs, [ca.cse(ca.densify(ca.vertcat(violation, gap, cost, by_x, by_u)))])


def adjoint(lin: Linearization) -> ca.Function:
    """Build one stage of the adjoint sweep, from the gradients in the state at its end and in its input."""
    a, b = ca.SX.sym("a", lin.A_k.nnz()), ca.SX.sym("b", lin.B_k.nnz())
    A, B = ca.SX(lin.A_k, a), ca.SX(lin.B_k, b)
    by_u, pi, by_x = ca.SX.sym("by_u", B.shape[1]), ca.SX.sym("pi", A.shape[0]), ca.SX.sym("by_x", A.shape[0])
    after = pi + by_x
    inputs = {"A": a, "B": b, "by_u": by_u, "by_x": by_x, "pi": pi}
    return function("certify_back", inputs, {"gradient": ca.densify(B.T @ after + by_u), "pi_before": ca.densify(A.T @ after)})


def of_inputs(ocp: Ocp) -> ca.Function:
    """Build the terms of one input: ``-> [violation of its bounds; gap; reduced gradient]``."""
    nu = ocp.model.nu
    names = ("r", "u", "increment", "mu", "lbu", "ubu", "lbdu", "ubdu", "scale")
    r, u, increment, mu, lbu, ubu, lbdu, ubdu, scale = symbols = [ca.SX.sym(name, nu) for name in names]
    violation, gap = ca.SX(0), ca.SX(0)
    upper, lower = (("ubu", "ubdu"), ("lbu", "lbdu"))
    for j in range(nu):
        for sign, (of_input, of_step), at, pace in ((1, upper, ubu[j], ubdu[j]), (-1, lower, -lbu[j], -lbdu[j])):
            bounds, limits = ocp.tightest(of_input), ocp.tightest(of_step)
            room = at - sign * u[j] if np.isfinite(bounds[j]) else scale[j]
            if partly(getattr(ocp, of_input))[j]:
                room = ca.if_else(at < INFINITY / 2, room, scale[j])
            gap += ca.fmax(0, -sign * r[j]) * ca.fmax(0, room)
            if np.isfinite(bounds[j]):
                violation = ca.fmax(violation, -room / scale[j])
            if np.isfinite(limits[j]):
                left = pace - sign * increment[j]
                violation = ca.fmax(violation, -left / scale[j])
                gap += ca.fmax(0, sign * mu[j]) * ca.fmax(0, left)
    return ca.Function("certify_input", symbols, [ca.cse(ca.densify(ca.vertcat(violation, gap, r)))])
