# SPDX-License-Identifier: Apache-2.0
r"""
Primal-dual interior-point method on the Riccati recursion, for QPs whose places do not settle.

The linearized conditions on the products of distances and multipliers are eliminated side
by side, see `rti_mpc.rti.sides`. What they leave is a weight and a pull on each bounded
row, so that a step is one recursion over matrices, and a sweep over vectors for the
corrector of [Mehrotra1992]_. Each step is computed in deviations from the iterate, not
from the guess: weights of 1e15 and more would multiply the rounding of the latter.

Every iterate satisfies the dynamics.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from rti_mpc.codegen import function
from rti_mpc.rti.blocks import all_inputs, at_each
from rti_mpc.rti.elementwise import largest, total
from rti_mpc.rti.linearization import Forms, Linearization, change, divided
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.transcription import INFINITY
from rti_mpc.rti.riccati import Riccati, Rows, Stage, softened_steps
from rti_mpc.rti.sides import LENGTH, OF_BOUND, START, Inequalities, Point

SHARE_OF_WAY = 0.995  # fraction to the boundary: of the way to the nearest bound, how much a step may go


def enter(ocp: Ocp, lin: Linearization, stages: ca.MX) -> ca.Function:
    """
    Build ``(x, u, u_prev, stages, *ARGUMENTS, scale, x_plan, u_plan, start) -> (interior, bounds)``: a plan pushed inside its bounds, and these.

    `start` is the product of distance and multiplier at every hard side, and about that at softened ones. There, distance and slack grow by the
    same push, and the multipliers of both add up to the slope of the penalty, so that steps begin with all conditions on slacks met, whatever
    their weights are.
    """
    N, N_u, nx, nu = ocp.N, ocp.N_u, ocp.model.nx, ocp.model.nu
    forms, sides = lin.forms_in(stages), Inequalities(ocp)
    sides.measure(ocp, lin, forms)
    x_plan, u_plan = ca.MX.sym("x_plan", nx, N + 1), ca.MX.sym("u_plan", nu, N_u)
    dx, du = x_plan - lin.x, u_plan - lin.u
    softened = softened_steps(ocp, lin).map(N)(forms.g_x, forms.g_u, dx[:, 1:], all_inputs(du, ocp.blocks))
    d = ca.veccat(du, du - ca.horzcat(ca.MX.zeros(nu), du[:, :-1]), softened)
    start = ca.MX.sym("start")
    sides.take("d", d)
    sides.find("start", lambda side: side.started(START).named("", side.softened), start=start)
    inputs = {"x": lin.x, "u": lin.u, "u_prev": lin.u_prev, "stages": stages, **lin.weights, "x_plan": x_plan, "u_plan": u_plan, "start": start}
    return function("enter", inputs, {"interior": ca.veccat(dx, d, sides.pack(Point._fields)), "bounds": sides.pack(OF_BOUND)})


def step(ocp: Ocp, lin: Linearization, recursion: Riccati, stages: ca.MX, x0: ca.MX) -> ca.Function:
    """
    Build one step of predictor and corrector.

    It is ``(x, u, u_prev, x0, stages, *ARGUMENTS, scale, interior, bounds, least) -> (interior_after, x_plan, u_plan, violation, change,
    places_found, multipliers, product)``, with the plan after it as from a roll-out, and the mean product of distances and multipliers. No step
    aims at products below `least`; at it, steps still remove what rounding has left in the gradient of the Lagrangian.
    """
    N, N_u, nx, nu = ocp.N, ocp.N_u, ocp.model.nx, ocp.model.nu
    forms, sides = lin.forms_in(stages), Inequalities(ocp)
    sizes = nx * (N + 1), 2 * lin.u.numel() + lin.g.numel()
    interior, least = ca.MX.sym("interior", sum(sizes) + sides.size), ca.MX.sym("least")
    of_bounds = ca.MX.sym("bounds", sides.size)
    dx, d, numbers = ca.vertsplit(interior, np.cumsum([0, *sizes, sides.size]).tolist())
    sides.unpack(Point._fields, numbers)
    sides.unpack(OF_BOUND, of_bounds)

    def rows(flat: ca.MX) -> Rows:
        return Rows(*divided(flat, [lin.u, lin.u, lin.g]))

    def longest() -> ca.MX:
        return 1 / largest(ca.vertcat(1, sides.all("shrinking")))

    def mean_product() -> ca.MX:
        return total(sides.all("product")) / max(1, sides.products)

    sides.take("d", d)
    sides.find("inverses", lambda side: side.inverses)
    sides.softened.find("curvature", {"per_curvature": 1 / sides.softened.side.curvature})
    sides.find("weight", lambda side: {"weight": side.weight, "pull": side.pull, "product": side.now.product})
    product = mean_product()
    here, damped = moved_to(ocp, lin, forms, ca.reshape(dx, nx, N + 1), rows(d))
    gains = recursion.gains(ca.veccat(*here), rows(sides.onto("weight")), rows(sides.onto("pull") + damped))
    states, _, predicted = recursion.rolled(here, gains, ca.vertcat(x0 - lin.x[:, 0] - dx[:nx], ca.MX.zeros(nu)), defects=True)
    d_affine = ca.veccat(predicted.u, predicted.du, predicted.g)
    sides.take("change", d_affine)
    sides.find("predictor", lambda side: side.steps("affine_", side.toward(ca.SX(0), ca.SX(0))))
    sides.find("affine", lambda side: {"product": side.moved(side.affine, LENGTH).product}, length=longest())
    centre = ca.fmax(least, product * ca.fmin(1, (mean_product() / product) ** 3))

    sides.find("corrector", lambda side: {"correction": side.correction(*side.centred)}, centre=centre)
    states_by, by = recursion.response(stages, gains, rows(sides.onto("correction")))
    d_full = d_affine + ca.veccat(by.u, by.du, by.g)
    sides.take("change", d_full)
    sides.find("full", lambda side: side.steps("by_", side.toward(*side.centred)), centre=centre)
    length = ca.fmin(1, SHARE_OF_WAY * longest())

    dx, d = dx + length * ca.vec(states + states_by), d + length * d_full
    sides.take("d", d)
    sides.find("after", lambda side: side.ends(side.moved(side.by, LENGTH)), length=length)
    u_plan = lin.u + ca.reshape(d[: nu * N_u], nu, N_u)
    outputs = {
        "interior_after": ca.veccat(dx, d, sides.pack([f"after_{name}" for name in Point._fields])),
        "x_plan": lin.x + ca.reshape(dx, nx, N + 1),
        "u_plan": u_plan,
        "violation": ca.vertcat(*(largest(ca.vertcat(-INFINITY, sides.softened.known[name])) for name in ("exceeded", "exceeded_share"))),
        "change": change(lin, u_plan),
        "places_found": sides.onto("place"),
        "multipliers": sides.onto("multiplier")[nu * N_u :],
        "product": mean_product(),
    }
    guess = {"x": lin.x, "u": lin.u, "u_prev": lin.u_prev, "x0": x0, "stages": stages}
    return function("step", {**guess, **lin.weights, "interior": interior, "bounds": of_bounds, "least": least}, outputs)


def moved_to(ocp: Ocp, lin: Linearization, forms: Forms, dx: ca.MX, d: Rows) -> tuple[Forms, ca.MX]:
    """Return the linearization in deviations from a plan, in which steps lose no digits near the optimum, and the pull of the damping there."""
    N, N_u = ocp.N, ocp.N_u
    of = Stage(ocp, lin)
    before, du, after = ca.SX.sym("before", of.nx), ca.SX.sym("du", of.nu), ca.SX.sym("after", of.nx)
    symbols = [*of.dynamics.values(), of.b, of.cost["H"], of.h, before, du, after]
    end = ca.vertcat(after, du)[: of.H.shape[0]]
    node = ca.Function("moved", symbols, [ca.densify(of.A @ before + of.B @ du + of.b - after), ca.densify(of.h + of.H @ end)]).map(N)
    b, h = node(forms.A, forms.B, forms.b, forms.H, forms.h, dx[:, :-1], all_inputs(d.u, ocp.blocks), dx[:, 1:])
    force = forms.force + lin.weighed(d.du)
    damped = ca.veccat(at_each(forms.damping, N_u) * d.u, ca.MX.zeros(d.du.shape), ca.MX.zeros(d.g.shape))
    return forms._replace(b=b, h=h, force=force), damped
