# SPDX-License-Identifier: Apache-2.0
r"""
The QP of a sample, solved exactly by a Riccati recursion over a set of active bounds.

The increments couple an input to the one before, so the recursion is in
:math:`s_k = (\Delta x_k, \Delta u_{k-1})`. From the cost-to-go
:math:`\tfrac12 s^T P s + p^T s` behind stage k follow the terms of its input,

.. math::

    \tfrac12 \Delta u_k^T Q_{uu} \Delta u_k + \Delta u_k^T (Q_{us} s_k + q_u) ,

and from these the gains. Bounds enter by the *place* of what they bound: at a
bound it is held by a penalty too stiff to give way noticeably; beyond a softened
one it pays for it; elsewhere it is free. Rolled out from the initial state,
whatever crosses a bound is placed there, and what a bound holds back no more is
set free: a primal-dual active set method [Hintermueller2003]_. A roll-out that
changes no place is the solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from rti_mpc.linearization import Linearization, change, nonzeros, shift
from rti_mpc.ocp import Ocp
from rti_mpc.transcription import INFINITY

TOLERANCE = 1e-9  # by which a bound may be crossed before it acts, relative to its scale: rounding must not decide
RELEASE = 1e-6  # multiplier of the wrong sign, times the scale, in units of the normalised cost, from which a bound is released


@dataclass(frozen=True, eq=False)
class Recursion:
    """
    The functions of the two phases.

    The places are 0 for what is free, -1 and 1 at the lower and the upper bound, -2 and 2 beyond a softened one: of inputs and of increments, shapes
    ``(nu, N_u)``, and of what has softened bounds, shape ``(ng, N)``, one after the other.

    Attributes:
        linearize: ``(x, u, u_prev, y_ref, p, *WEIGHTS, scale) -> stages``.
        advance: ``(x, u, u_prev, y_ref, p, *WEIGHTS, scale, places) -> (x+, u+, places+, stages)``: the same of a plan moved on by one stage.
        gains: ``(stages, u, *WEIGHTS, scale, places, stiff) -> gains``; `stiff` is the weight of the penalty that holds what is at its bound, for
            what is measured by its scale.
        roll_out: ``(x, u, u_prev, x0, stages, gains, *WEIGHTS, scale, places, stiff) -> (x+, u+, violation, change, changes, places+)``: the full
            step, by how much it exceeds softened bounds, as it is and relative to their scale, its size, and how many places change: -1 if data,
            gains or plan are not finite.
    """

    linearize: ca.Function
    advance: ca.Function
    gains: ca.Function
    roll_out: ca.Function


def riccati(ocp: Ocp) -> Recursion:
    """Build the recursion of an OCP."""
    lin = Linearization(ocp)
    forms = [lin.A, lin.B, lin.b, lin.hessian, lin.gradient, lin.force, lin.increments, lin.g, lin.g_x, lin.g_u, lin.damping, lin.checksum]
    linearize = ca.Function("linearize", lin.arguments, [ca.veccat(*forms)])

    stages = ca.MX.sym("stages", linearize.numel_out(0))
    forms = divided(stages, forms)
    kinds = (lin.u, lin.u, lin.g)
    flat = ca.MX.sym("places", sum(kind.numel() for kind in kinds))
    places = divided(flat, kinds)
    x, u = shift(ocp)(lin.x, lin.u, lin.p)
    moved = ca.veccat(*(ca.horzcat(kind[:, 1:], kind[:, -1]) for kind in places))
    advance = ca.Function("advance", [*lin.arguments, flat], [x, u, moved, linearize(x, u, *lin.arguments[2:])])
    stiff = ca.MX.sym("stiff")
    gains = ca.Function("gains", [stages, lin.u, *lin.weights, flat, stiff], [backward(ocp, lin, forms, places, stiff)])
    x0 = ca.MX.sym("x0", ocp.model.nx)
    found = ca.MX.sym("gains", *gains.size_out(0))
    rolled = forward(ocp, lin, forms, x0, found, places, stiff)
    roll_out = ca.Function("roll_out", [lin.x, lin.u, lin.u_prev, x0, stages, found, *lin.weights, flat, stiff], rolled)
    return Recursion(linearize, advance, gains, roll_out)


def divided(flat: ca.MX, like: list[ca.MX] | tuple[ca.MX, ...]) -> list[ca.MX]:
    """Divide a column into expressions of given shapes."""
    ends = np.cumsum([0, *(one.numel() for one in like)]).tolist()
    return [ca.reshape(part, one.shape) for part, one in zip(ca.vertsplit(flat, ends), like, strict=True)]


class Stage:
    """
    Symbols of one stage, and the linear forms made of them from nonzeros, every structural zero left out.

    Attributes:
        A: Sensitivities to the state; `B`, to the input; `b`, the defect.
        H: Hessian of the outputs at the end; `h`, their gradient.
        G: Sensitivities of what has softened bounds to s at the end, shape ``(ng, nx + nu)``; `g`, its value at the guess.
    """

    def __init__(self, ocp: Ocp, lin: Linearization) -> None:
        nx, nu, ng = ocp.model.nx, ocp.model.nu, len(ocp.lg)
        self.nx, self.nu, self.n, self.ng = nx, nu, nx + nu, ng
        patterns = {"A": lin.A_k, "B": lin.B_k, "H": lin.H_i, "G_x": lin.G_x, "G_u": lin.G_u}
        nz = {name: ca.SX.sym(name, pattern.nnz()) for name, pattern in patterns.items()}
        self.A, self.B, self.H, G_x, G_u = (ca.SX(pattern, nz[name]) for name, pattern in patterns.items())
        self.G = ca.horzcat(G_x, G_u)
        self.b, self.h = ca.SX.sym("b", nx), ca.SX.sym("h", nx)
        self.g, self.lg, self.ug, self.zg, self.Zg, self.place = (ca.SX.sym(name, ng) for name in ("g", "lg", "ug", "zg", "Zg", "place"))
        self.stiff, self.scale = ca.SX.sym("stiff", ng), ca.SX.sym("scale", ng)
        self.dynamics = [nz["A"], nz["B"], self.b]
        self.soft = [self.g, nz["G_x"], nz["G_u"], self.lg, self.ug, self.zg, self.Zg, self.place, self.stiff, self.scale]
        self.cost = [nz["H"], self.h]


def soft_stages(lin: Linearization, forms: list[ca.MX], places: ca.MX, stiff: ca.MX) -> list[list[ca.MX]]:
    """Return, for each stage, what `Stage.soft` stands for."""
    varying = [ca.horzsplit(form) if form.size1() else [ca.MX(0, 1)] * form.size2() for form in (*forms[7:10], places)]
    each = stiff / lin.scale_g**2
    return [[g, g_x, g_u, lin.lg, lin.ug, lin.zg, lin.Zg, place, each, lin.scale_g] for g, g_x, g_u, place in zip(*varying, strict=True)]


def backward(ocp: Ocp, lin: Linearization, forms: list[ca.MX], places: list[ca.MX], stiff: ca.MX) -> ca.MX:
    """Return the gains of all stages with an input, one a column, K and then kappa: ``du = -K s - kappa``."""
    N, N_u, n, w = ocp.N, ocp.N_u, ocp.model.nx + ocp.model.nu, lin.w
    free, held = backward_stage(ocp, lin, True), backward_stage(ocp, lin, False)
    A, B, b, H, h, force, increment = (ca.horzsplit(form) for form in forms[:7])
    soft = soft_stages(lin, forms, places[2], stiff)
    u, at, at_increment = (ca.horzsplit(e) for e in (lin.u, *places[:2]))
    lambda_ = ca.vertsplit(w["lambda_"])
    R, damping, of_input = nonzeros(lin.R), forms[10], stiff / lin.scale_u**2
    P, p = ca.MX.zeros(n * (n + 1) // 2), ca.MX.zeros(n)
    gains = []
    for k in reversed(range(N)):
        stage = A[k], B[k], b[k], *soft[k], H[k], h[k], P, p
        if k < N_u:
            bounds = w["lbu"], w["ubu"], w["lbdu"], w["ubdu"]
            P, p, gain = free(*stage, R, damping, lambda_[k], force[k], increment[k], u[k], at[k], at_increment[k], *bounds, of_input)
            gains.append(gain)
        else:
            P, p = held(*stage)
    return ca.horzcat(*reversed(gains))


def backward_stage(ocp: Ocp, lin: Linearization, free: bool) -> ca.Function:
    """Build one stage of the recursion; not `free`: the input is that of the stage before."""
    of = Stage(ocp, lin)
    nx, nu, n = of.nx, of.nu, of.n
    upper = ca.Sparsity.upper(n)
    P_nz, p = ca.SX.sym("P", upper.nnz()), ca.SX.sym("p", n)
    P = ca.triu2symm(ca.SX(upper, P_nz))

    held_back, pull = hold(of.stiff, of.place, of.g, of.lg, of.ug)
    beyond = ca.fabs(of.place) == 2
    pull += beyond / 2 * (of.Zg * (of.g - ca.if_else(of.place > 0, of.ug, of.lg)) + ca.sign(of.place) * of.zg)
    P = P + of.G.T @ ca.diag(held_back + beyond * of.Zg / 2) @ of.G
    p_end = p + of.G.T @ pull

    A, B = of.A, of.B
    Pxx, Pxu, Puu = P[:nx, :nx] + of.H, P[:nx, nx:], P[nx:, nx:]
    PB = Pxx @ B + Pxu
    Qxx, Qux, Quu = A.T @ Pxx @ A, PB.T @ A, B.T @ PB + Pxu.T @ B + Puu
    px = p_end[:nx] + of.h + Pxx @ of.b
    qx, qu = A.T @ px, B.T @ px + p_end[nx:] + Pxu.T @ of.b
    inputs = [*of.dynamics, *of.soft, *of.cost, P_nz, p]
    if not free:
        Qss, qs = ca.blockcat([[Qxx, Qux.T], [Qux, Quu]]), ca.vertcat(qx, qu)
        return ca.Function("held", inputs, ca.cse([nonzeros(ca.densify(Qss)[upper]), ca.densify(qs)]))

    R_nz, lambda_ = ca.SX.sym("R", lin.R.sparsity().nnz()), ca.SX.sym("lambda")
    damping = ca.SX.sym("damping", nu)
    force_guess, increment, u, place, at, lbu, ubu, lbdu, ubdu = (
        ca.SX.sym(name, nu) for name in ("force", "increment", "u", "place", "at", "lbu", "ubu", "lbdu", "ubdu")
    )
    stiff = ca.SX.sym("stiff", nu)
    R = ca.SX(lin.R.sparsity(), R_nz) * lambda_
    weight, pull = hold(stiff, at, increment, lbdu, ubdu)
    R, force = R + ca.diag(weight), force_guess + pull
    weight, pull = hold(stiff, place, u, lbu, ubu)
    Quu, qu = Quu + R + ca.diag(weight + damping), qu + force + pull
    Qus = ca.horzcat(Qux, -R)
    gain = cholesky_solve(Quu, ca.horzcat(Qus, qu))
    # The cost with du = -K s - kappa in it.
    P_before = ca.diagcat(Qxx, R) - Qus.T @ gain[:, :n]
    p_before = ca.vertcat(qx, -force) - Qus.T @ gain[:, n]
    out = [nonzeros(ca.densify(P_before)[upper]), ca.densify(p_before), ca.densify(ca.vec(gain))]
    return ca.Function("free", [*inputs, R_nz, damping, lambda_, force_guess, increment, u, place, at, lbu, ubu, lbdu, ubdu, stiff], ca.cse(out))


def hold(stiff: ca.SX, place: ca.SX, value: ca.SX, lower: ca.SX, upper: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return weight and gradient of the penalty on values that are placed at their bounds."""
    weight = stiff * (ca.fabs(place) == 1)
    return weight, weight * (value - ca.if_else(place > 0, upper, lower))


def cholesky_solve(M: ca.SX, rhs: ca.SX) -> ca.SX:
    """Solve with a small symmetric matrix; NaN if it is not positive definite."""
    size = M.shape[0]
    L = ca.SX(size, size)
    for i in range(size):
        for j in range(i + 1):
            rest = M[i, j] - ca.dot(L[i, :j], L[j, :j])
            L[i, j] = ca.sqrt(rest) if i == j else rest / L[j, j]
    rows = [rhs[i, :] for i in range(size)]
    for i in range(size):
        rows[i] = (rows[i] - sum((L[i, k] * rows[k] for k in range(i)), ca.SX(1, rhs.shape[1]))) / L[i, i]
    for i in reversed(range(size)):
        rows[i] = (rows[i] - sum((L[k, i] * rows[k] for k in range(i + 1, size)), ca.SX(1, rhs.shape[1]))) / L[i, i]
    return ca.vertcat(*rows)


def forward(ocp: Ocp, lin: Linearization, forms: list[ca.MX], x0: ca.MX, gains: ca.MX, places: list[ca.MX], stiff: ca.MX) -> list[ca.MX]:
    """Return what a roll-out returns."""
    N, N_u, w = ocp.N, ocp.N_u, lin.w
    free, held = forward_stage(ocp, lin, True), forward_stage(ocp, lin, False)
    A, B, b, _, _, _, increment = (ca.horzsplit(form) for form in forms[:7])
    soft = soft_stages(lin, forms, places[2], stiff)
    x, u, gain, at, at_increment = (ca.horzsplit(e) for e in (lin.x, lin.u, gains, *places[:2]))
    bounds = (w["lbu"], w["ubu"], w["lbdu"], w["ubdu"], stiff / lin.scale_u**2, lin.scale_u)
    s = ca.vertcat(x0 - x[0], ca.MX.zeros(ocp.model.nu))
    before = lin.u_prev
    verdict = ca.MX(ca.DM([0, -INFINITY, -INFINITY]))  # changes, violation, violation relative to scale
    states, inputs = [x0], []
    found: tuple[list[ca.MX], ...] = ([], [], [])
    for k in range(N):
        stage = A[k], B[k], b[k], *soft[k], x[k + 1], s, verdict
        if k < N_u:
            state, s, verdict, acts, before, *now = free(*stage, gain[k], increment[k], u[k], before, at[k], at_increment[k], *bounds)
            inputs.append(before)
            for kind, one in zip(found, now, strict=False):
                kind.append(one)
        else:
            state, s, verdict, acts = held(*stage)
        states.append(state)
        found[2].append(acts)
    x_plan, u_plan = ca.horzcat(*states), ca.horzcat(*inputs)
    finite = forms[-1] + ca.sum1(ca.vec(u_plan)) + ca.sumsqr(x_plan) ** 2  # overflows for what is no state
    changes = ca.if_else(ca.fabs(finite) < np.inf, verdict[0], -1)
    return [x_plan, u_plan, verdict[1:], change(lin, u_plan), changes, ca.veccat(*(ca.horzcat(*kind) for kind in found))]


def forward_stage(ocp: Ocp, lin: Linearization, free: bool) -> ca.Function:
    """Build one stage of the roll-out."""
    of = Stage(ocp, lin)
    nx, nu, n = of.nx, of.nu, of.n
    x_next, s, verdict = ca.SX.sym("x_next", nx), ca.SX.sym("s", n), ca.SX.sym("verdict", 3)
    gain = ca.SX.sym("gain", nu * (n + 1))
    increment, u, before, place, pace, lbu, ubu, lbdu, ubdu = (
        ca.SX.sym(name, nu) for name in ("increment", "u", "before", "place", "pace", "lbu", "ubu", "lbdu", "ubdu")
    )
    stiff, scale = ca.SX.sym("stiff", nu), ca.SX.sym("scale", nu)
    changes, worst, share = ca.vertsplit(verdict)

    K = ca.reshape(gain, nu, n + 1)
    du = -(K[:, :n] @ s + K[:, n]) if free else s[nx:]
    dx = of.A @ s[:nx] + of.B @ du + of.b
    end = ca.vertcat(dx, du)
    value = of.g + of.G @ end
    acts = ca.SX(of.ng, 1)
    for j in range(of.ng):
        over, under = exceeded(value[j], of.lg[j], of.ug[j], ocp.lg[j], ocp.ug[j])
        exceeds = ca.fmax(over, under)
        worst, share = ca.fmax(worst, exceeds), ca.fmax(share, exceeds / of.scale[j])
        acts[j] = belongs(of.place[j], of.stiff[j], of.scale[j], over, under, of.zg[j] / 2)
        changes += acts[j] != of.place[j]
    inputs = [*of.dynamics, *of.soft, x_next, s, verdict]
    outputs = [x_next + dx, end]
    if not free:
        return ca.Function("coast", inputs, ca.cse([*outputs, ca.vertcat(changes, worst, share), ca.densify(acts)]))

    found = []
    for value, at, lower, upper, lb, ub in (
        (u + du, place, lbu, ubu, ocp.lbu, ocp.ubu),
        (increment + du - s[nx:], pace, lbdu, ubdu, ocp.lbdu, ocp.ubdu),
    ):
        now = [belongs(at[j], stiff[j], scale[j], *exceeded(value[j], lower[j], upper[j], lb[j], ub[j]), INFINITY) for j in range(nu)]
        found.append(ca.densify(ca.vertcat(*now)))
        changes += ca.sum1(found[-1] != at)
    # Bounds are met exactly, as an actuator wants them.
    u_plan = ca.fmax(ca.fmin(u + du, before + ubdu), before + lbdu)
    u_plan = ca.fmax(ca.fmin(u_plan, ubu), lbu)
    outputs += [ca.vertcat(changes, worst, share), ca.densify(acts), u_plan, *found]
    return ca.Function("forward", [*inputs, gain, increment, u, before, place, pace, lbu, ubu, lbdu, ubdu, stiff, scale], ca.cse(outputs))


def exceeded(value: ca.SX, lower: ca.SX, upper: ca.SX, lb: float, ub: float) -> tuple[ca.SX, ca.SX]:
    """Return by how much a value is over its upper and under its lower bound, far from it where there is none."""
    absent = ca.SX(-INFINITY)
    return value - upper if np.isfinite(ub) else absent, lower - value if np.isfinite(lb) else absent


def belongs(place: ca.SX, stiff: ca.SX, scale: ca.SX, over: ca.SX, under: ca.SX, most: ca.SX | float) -> ca.SX:
    """Return where something belongs that exceeds its bounds by so much; `most` is the pull that brings it beyond, if they are softened."""
    tolerance = TOLERANCE * scale
    side = ca.sign(place)
    by = ca.if_else(place > 0, over, under)
    free = (over > tolerance) - (under > tolerance)
    held = ca.if_else(stiff * by > most, 2 * side, side * (stiff * by * scale > -RELEASE))
    beyond = ca.if_else(by < -tolerance, side, 2 * side)
    return ca.SX(ca.if_else(place == 0, free, ca.if_else(ca.fabs(place) == 1, held, beyond)))
