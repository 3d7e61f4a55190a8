# SPDX-License-Identifier: Apache-2.0
r"""
Functions of the active-set method: bounds enter the Riccati recursion by the *place* of what they bound.

At a bound it is held by a penalty too stiff to give way noticeably; beyond a
softened one it pays for it; elsewhere it is free. Rolled out from the initial
state, whatever crosses a bound is placed there, and a bound whose multiplier has
changed its sign is released: a primal-dual active set method [Hintermueller2003]_.
A roll-out that changes no place is the solution, up to what the penalty gives way;
a refinement, one sweep over vectors with the gains as they are, takes that away.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from rti_mpc.linearization import Linearization, change, divided, shift
from rti_mpc.ocp import Ocp
from rti_mpc.riccati import Columns, Riccati, Rows, Stage, columns
from rti_mpc.transcription import INFINITY

TOLERANCE = 1e-9  # by which a bound may be crossed before it acts, relative to its scale: rounding must not decide
RELEASE = 1e-6  # multiplier of the wrong sign, times the scale, in units of the normalised cost, from which a bound is released


@dataclass(frozen=True, eq=False)
class Places:
    """
    The functions of the two phases.

    The places are 0 for what is free, -1 and 1 at the lower and the upper bound, -2 and 2 beyond a softened one: of inputs and of increments, shapes
    ``(nu, N_u)``, and of what has softened bounds, shape ``(ng, N)``, one after the other. Multipliers, of increments and of what has softened
    bounds, are positive at an upper bound.

    Attributes:
        linearize: ``(x, u, u_prev, y_ref, p, *WEIGHTS, scale) -> stages``.
        advance: ``(x, u, u_prev, y_ref, p, *WEIGHTS, scale, places) -> (x+, u+, places+, stages)``: the same of a plan moved on by one stage.
        gains: ``(stages, u, *WEIGHTS, scale, places, stiff) -> gains``; `stiff` is the weight of the penalty that holds what is at its bound, for
            what is measured by its scale.
        roll_out: ``(x, u, u_prev, x0, stages, gains, *WEIGHTS, scale, places, stiff) -> (x+, u+, violation, change, changes, places+, multipliers)``:
            the full step, by how much it exceeds softened bounds, as it is and relative to their scale, its size, and how many places change: -1
            if data, gains or plan are not finite.
        refine: ``(x, u, u_prev, stages, gains, *WEIGHTS, scale, places, stiff, r, x+, u+, multipliers) -> (x+, u+, multipliers)``: what a plan and
            its multipliers become if the gradient r that is left of the Lagrangian, see `rti_mpc.certificate`, is taken away.
    """

    linearize: ca.Function
    advance: ca.Function
    gains: ca.Function
    roll_out: ca.Function
    refine: ca.Function


def places(ocp: Ocp) -> Places:
    """Build the functions of an OCP."""
    lin = Linearization(ocp)
    linearize = ca.Function("linearize", lin.arguments, [lin.stages])
    recursion = Riccati(ocp, lin)
    stages = ca.MX.sym("stages", linearize.numel_out(0))
    forms = divided(stages, lin.forms)
    kinds = [lin.u, lin.u, lin.g]
    flat, stiff = ca.MX.sym("places", sum(kind.numel() for kind in kinds)), ca.MX.sym("stiff")
    at = Rows(*divided(flat, kinds))
    x, u = shift(ocp)(lin.x, lin.u, lin.p)
    moved = ca.veccat(*(ca.horzcat(kind[:, 1:], kind[:, -1]) for kind in (at.inputs, at.increments, at.softened)))
    advance = ca.Function("advance", [*lin.arguments, flat], [x, u, moved, linearize(x, u, *lin.arguments[2:])])

    weight, pull = penalties(ocp, lin, forms, at, stiff)
    gains = ca.Function("gains", [stages, lin.u, *lin.weights, flat, stiff], [recursion.gains(forms, weight, pull)])
    x0, found = ca.MX.sym("x0", ocp.model.nx), ca.MX.sym("gains", recursion.size, ocp.N_u)
    rolled = roll_out(ocp, lin, forms, x0, found, at, stiff)
    fixed = [stages, found, *lin.weights, flat, stiff]
    refined = [ca.MX.sym("r", *lin.u.shape), ca.MX.sym("x_plan", *lin.x.shape), ca.MX.sym("u_plan", *lin.u.shape)]
    refined.append(ca.MX.sym("multipliers", *rolled[-1].shape))
    better = refine(ocp, lin, recursion, forms, found, at, stiff, *refined)
    return Places(
        linearize,
        advance,
        gains,
        ca.Function("roll_out", [lin.x, lin.u, lin.u_prev, x0, *fixed], rolled),
        ca.Function("refine", [lin.x, lin.u, lin.u_prev, *fixed, *refined], better),
    )


def penalties(ocp: Ocp, lin: Linearization, forms: list[ca.MX], at: Rows, stiff: ca.MX) -> tuple[Rows, Rows]:
    """Return weight and pull of each row, by its place."""
    w, nu, ng = lin.w, ocp.model.nu, len(ocp.lg)
    place, value, lower, upper, weight = (ca.SX.sym(name, nu) for name in ("place", "value", "lower", "upper", "weight"))
    held = ca.Function("hold", [place, value, lower, upper, weight], [*hold(place, value, lower, upper, weight)]).map(ocp.N_u)
    place, value, lower, upper, weight, z, Z = (ca.SX.sym(name, ng) for name in ("place", "value", "lower", "upper", "weight", "z", "Z"))
    weighs, pulls = hold(place, value, lower, upper, weight)
    beyond = ca.fabs(place) == 2
    pulls += beyond / 2 * (Z * (value - ca.if_else(place > 0, upper, lower)) + ca.sign(place) * z)
    softened = ca.Function("hold_softened", [place, value, lower, upper, weight, z, Z], [weighs + beyond * Z / 2, pulls]).map(ocp.N)

    def repeated(*rows: ca.MX, times: int) -> list[ca.MX]:
        return [ca.repmat(row, 1, times) for row in rows]

    of_inputs = stiff / lin.scale_u**2
    inputs = held(at.inputs, lin.u, *repeated(w["lbu"], w["ubu"], of_inputs, times=ocp.N_u))
    increments = held(at.increments, forms[6], *repeated(w["lbdu"], w["ubdu"], of_inputs, times=ocp.N_u))
    limits = repeated(lin.lg, lin.ug, stiff / lin.scale_g**2, lin.zg, lin.Zg, times=ocp.N)
    bounded = softened(at.softened, forms[7], *limits)
    return Rows(inputs[0], increments[0], bounded[0]), Rows(inputs[1], increments[1], bounded[1])


def hold(place: ca.SX, value: ca.SX, lower: ca.SX, upper: ca.SX, weight: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return weight and gradient of the penalty on values that are placed at their bounds."""
    weight = weight * (ca.fabs(place) == 1)
    return ca.densify(weight), ca.densify(weight * (value - ca.if_else(place > 0, upper, lower)))


def roll_out(ocp: Ocp, lin: Linearization, forms: list[ca.MX], x0: ca.MX, gains: ca.MX, at: Rows, stiff: ca.MX) -> list[ca.MX]:
    """Return what a roll-out returns."""
    N, N_u, w = ocp.N, ocp.N_u, lin.w
    free, held = roll_stage(ocp, lin, True), roll_stage(ocp, lin, False)
    A, B, b, _, _, _, increment, g, g_x, g_u = (columns(form) for form in forms[:10])
    x, u, gain = columns(lin.x), columns(lin.u), columns(gains)
    place, pace, of_softened = at.columns()
    limits = (lin.lg, lin.ug, lin.zg, lin.Zg, stiff / lin.scale_g**2, lin.scale_g)
    bounds = (w["lbu"], w["ubu"], w["lbdu"], w["ubdu"], stiff / lin.scale_u**2, lin.scale_u)
    s, slip = ca.vertcat(x0 - x[0], ca.MX.zeros(ocp.model.nu)), ca.MX.zeros(ocp.model.nx + ocp.model.nu)
    before = lin.u_prev
    verdict = ca.MX(ca.DM([0, -INFINITY, -INFINITY]))  # changes, violation, violation relative to scale
    states, inputs = [x0], []
    found: tuple[Columns, ...] = ([], [], [], [], [])
    for k in range(N):
        stage = A[k], B[k], b[k], g_x[k], g_u[k], g[k], of_softened[k], *limits, x[k + 1], s, slip, verdict
        if k < N_u:
            state, s, slip, verdict, acts, paid, before, *now = free(*stage, gain[k], increment[k], u[k], before, place[k], pace[k], *bounds)
            inputs.append(before)
            for kind, one in zip(found, now, strict=False):
                kind.append(one)
        else:
            state, s, slip, verdict, acts, paid = held(*stage)
        states.append(state)
        found[3].append(acts)
        found[4].append(paid)
    x_plan, u_plan = ca.horzcat(*states), ca.horzcat(*inputs)
    finite = forms[11] + ca.sum1(ca.vec(u_plan)) + ca.sumsqr(x_plan) ** 2  # overflows for what is no state
    changes = ca.if_else(ca.fabs(finite) < np.inf, verdict[0], -1)
    of_inputs, of_increments, forces, of_softened_rows, paid_rows = (ca.horzcat(*kind) for kind in found)
    now_at = ca.veccat(of_inputs, of_increments, of_softened_rows)
    return [x_plan, u_plan, verdict[1:], change(lin, u_plan), changes, now_at, ca.veccat(forces, paid_rows)]


def roll_stage(ocp: Ocp, lin: Linearization, free: bool) -> ca.Function:
    """Build one stage of the roll-out."""
    of = Stage(ocp, lin)
    nx, nu = of.nx, of.nu
    x_next, s, slip, verdict = ca.SX.sym("x_next", nx), ca.SX.sym("s", of.n), ca.SX.sym("slip", of.n), ca.SX.sym("verdict", 3)
    g, at_g, lg, ug, zg, Zg, stiff_g, scale_g = softened = [ca.SX.sym(f"softened_{i}", of.ng) for i in range(8)]
    increment, u, before, place, pace, lbu, ubu, lbdu, ubdu, stiff, scale = bounded = [ca.SX.sym(f"bounded_{i}", nu) for i in range(11)]
    column, K, kappa, _ = of.gain()
    changes, worst, share = ca.vertsplit(verdict)

    du = -(K @ s + kappa) if free else s[nx:]
    # By so little the penalty gives way. States are to know what the actuator will do, places are not: degenerate ones would go in circles.
    u_plan = met(u + du, before, lbu, ubu, lbdu, ubdu) if free else u
    slipped = u_plan - u - du if free else slip[nx:]
    drift = of.A @ slip[:nx] + of.B @ slipped
    dx = of.A @ s[:nx] + of.B @ du + of.b
    end = ca.vertcat(dx, du)
    value = g + of.G @ end
    planned = value + of.G @ ca.vertcat(drift, slipped)
    acts, paid = ca.SX(of.ng, 1), ca.SX(of.ng, 1)
    for j in range(of.ng):
        over, under = exceeded(value[j], lg[j], ug[j], ocp.lg[j], ocp.ug[j])
        exceeds = ca.fmax(*exceeded(planned[j], lg[j], ug[j], ocp.lg[j], ocp.ug[j]))
        worst, share = ca.fmax(worst, exceeds), ca.fmax(share, exceeds / scale_g[j])
        acts[j] = belongs(at_g[j], stiff_g[j], scale_g[j], over, under, zg[j] / 2)
        changes += acts[j] != at_g[j]
        by = ca.if_else(at_g[j] > 0, over, under)
        paid[j] = ca.sign(at_g[j]) * ca.if_else(ca.fabs(at_g[j]) == 2, (zg[j] + Zg[j] * by) / 2, stiff_g[j] * by)
    inputs = [*of.matrices, of.b, *of.softened, *softened, x_next, s, slip, verdict]
    outputs = [x_next + dx + drift, end, ca.vertcat(drift, slipped)]
    if not free:
        return ca.Function("coast", inputs, ca.cse([*outputs, ca.vertcat(changes, worst, share), ca.densify(acts), ca.densify(paid)]))

    found = []
    for values, at, lower, upper, lb, ub in (
        (u + du, place, lbu, ubu, ocp.lbu, ocp.ubu),
        (increment + du - s[nx:], pace, lbdu, ubdu, ocp.lbdu, ocp.ubdu),
    ):
        now = [belongs(at[j], stiff[j], scale[j], *exceeded(values[j], lower[j], upper[j], lb[j], ub[j]), INFINITY) for j in range(nu)]
        found.append(ca.densify(ca.vertcat(*now)))
        changes += ca.sum1(found[-1] != at)
    force = stiff * (ca.fabs(pace) == 1) * (increment + du - s[nx:] - ca.if_else(pace > 0, ubdu, lbdu))
    outputs += [ca.vertcat(changes, worst, share), ca.densify(acts), ca.densify(paid), u_plan, *found]
    return ca.Function("forward", [*inputs, column, *bounded], ca.cse([*outputs, ca.densify(force)]))


def met(u: ca.SX, before: ca.SX, lbu: ca.SX, ubu: ca.SX, lbdu: ca.SX, ubdu: ca.SX) -> ca.SX:
    """Return an input that meets its bounds to the last bit, as an actuator wants it."""
    paced = ca.fmax(ca.fmin(u, before + ubdu), before + lbdu)
    return ca.fmax(ca.fmin(paced, ubu), lbu)


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


def refine(
    ocp: Ocp,
    lin: Linearization,
    recursion: Riccati,
    forms: list[ca.MX],
    gains: ca.MX,
    at: Rows,
    stiff: ca.MX,
    r: ca.MX,
    x_plan: ca.MX,
    u_plan: ca.MX,
    multipliers: ca.MX,
) -> list[ca.MX]:
    """Return what a refinement returns: one Newton step on the optimality conditions, softened rows that are held brought to their bounds."""
    N, N_u, nu, w = ocp.N, ocp.N_u, ocp.model.nu, lin.w
    of_increments, of_softened = divided(multipliers, [lin.u, lin.g])
    du = u_plan - lin.u
    held = ca.horzcat(du, ca.repmat(du[:, -1], 1, N - N_u))
    of = Stage(ocp, lin)
    dx_i, du_i, g_i = ca.SX.sym("dx", of.nx), ca.SX.sym("du", nu), ca.SX.sym("g", of.ng)
    value = ca.Function("softened_value", [g_i, *of.softened, dx_i, du_i], [ca.densify(g_i + of.G @ ca.vertcat(dx_i, du_i))])
    values = value.map(N)(forms[7], forms[8], forms[9], x_plan[:, 1:] - lin.x[:, 1:], held)
    weight = ca.repmat(stiff / lin.scale_g**2, 1, N) * (ca.fabs(at.softened) == 1)
    lower, upper = (ca.repmat(e, 1, N) for e in (lin.lg, lin.ug))
    excess = values - ca.if_else(at.softened > 0, upper, lower)
    zero = ca.MX.zeros(nu, N_u)
    corrected = recursion.corrected(forms, gains, Rows(r * (at.inputs == 0), zero, weight * excess))
    start = ca.MX.zeros(of.n)
    _, step, rows = recursion.rolled(forms, corrected, start, defects=False)
    side = ca.sign(at.softened)
    by = side * (excess + rows.softened)
    beyond = side * (ca.repmat(lin.zg, 1, N) + ca.repmat(lin.Zg, 1, N) * by) / 2
    paid = ca.if_else(ca.fabs(at.softened) == 2, beyond, (of_softened + weight * (excess + rows.softened)) * (ca.fabs(at.softened) == 1))
    force = of_increments + ca.repmat(stiff / lin.scale_u**2, 1, N_u) * (ca.fabs(at.increments) == 1) * rows.increments
    clip, follow = met_function(nu), follow_function(lin)
    last, change_k, inputs, states = lin.u_prev, ca.MX.zeros(of.nx), [], [x_plan[:, 0]]
    planned, A, B = columns(u_plan), columns(forms[0]), columns(forms[1])
    for k in range(N):
        if k < N_u:
            last = clip(planned[k] + step[:, k], last, w["lbu"], w["ubu"], w["lbdu"], w["ubdu"])
            inputs.append(last)
        change_k = follow(A[k], B[k], change_k, last - planned[min(k, N_u - 1)])
        states.append(x_plan[:, k + 1] + change_k)
    return [ca.horzcat(*states), ca.horzcat(*inputs), ca.veccat(force, paid)]


def follow_function(lin: Linearization) -> ca.Function:
    """Return ``(A, B, dx, du) -> dx`` at the end of a stage: what states become of inputs as they were clipped."""
    a, b = ca.SX.sym("a", lin.A_k.nnz()), ca.SX.sym("b", lin.B_k.nnz())
    dx, du = ca.SX.sym("dx", lin.A_k.size1()), ca.SX.sym("du", lin.B_k.size2())
    return ca.Function("follow", [a, b, dx, du], [ca.densify(ca.SX(lin.A_k, a) @ dx + ca.SX(lin.B_k, b) @ du)])


def met_function(nu: int) -> ca.Function:
    """Return `met` as a function."""
    symbols = [ca.SX.sym(name, nu) for name in ("u", "before", "lbu", "ubu", "lbdu", "ubdu")]
    return ca.Function("met", symbols, [met(*symbols)])
