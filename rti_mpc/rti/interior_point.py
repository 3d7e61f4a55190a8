# SPDX-License-Identifier: Apache-2.0
r"""
Primal-dual interior-point method on the Riccati recursion, for QPs whose places do not settle.

Each *side*, a lower or an upper bound of a row, has a distance t from its bound and a
multiplier :math:`\lambda`. One of a softened row also has a slack s and the multiplier
:math:`\nu` of its :math:`s \ge 0`. Linearized, the products :math:`t \lambda` and
:math:`s \nu` are eliminated side by side. This leaves a weight and a pull on the row,
so that a step is one recursion over matrices, and a sweep over vectors for the
corrector of [Mehrotra1992]_. Each step is computed in deviations from the iterate, not
from the guess: weights of 1e15 and more would multiply the rounding of the latter.

Distances and slacks are relative to the scale of what is bounded; multipliers are in
normalised cost per scale. Every iterate satisfies the dynamics.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from rti_mpc.codegen import function
from rti_mpc.rti.blocks import all_inputs, at_each
from rti_mpc.rti.linearization import Forms, Linearization, along_rows, change, divided
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.transcription import INFINITY
from rti_mpc.rti.riccati import Riccati, Rows, Stage, softened_steps

START_DISTANCE = 1.0  # least distance from a hard bound at the start
SHARE_OF_WAY = 0.995  # fraction to the boundary: of the way to the nearest bound, how much a step may go


class Point(NamedTuple):
    """Numbers of all sides, or their steps: distances, multipliers, and of the softened sides slacks and multipliers of slacks."""

    t: ca.MX
    lam: ca.MX
    s: ca.MX
    nu: ca.MX


class Sides:
    """
    The bounds that an OCP has: those of inputs and increments, which are hard, then the softened ones.

    Attributes:
        hard: Number of hard sides.
        softened: Number of softened sides.
        scale: Scale of each row, in the order of the places.
        scale_side: Scale of each side.
        z: Linear penalty on each slack; `Z`, the quadratic one.
    """

    def __init__(self, ocp: Ocp, lin: Linearization, forms: Forms) -> None:
        N, N_u, w = ocp.N, ocp.N_u, lin.w
        first = 2 * N_u * ocp.model.nu  # row with a softened bound

        tables = (ocp.lbu, ocp.lbdu, ocp.lg), (ocp.ubu, ocp.ubdu, ocp.ug)
        counts = (N_u, N_u, N)
        rows_of = [[np.broadcast_to(of, (n, of.shape[-1])).ravel() for of, n in zip(table, counts, strict=True)] for table in tables]
        finite = [np.flatnonzero(np.isfinite(np.concatenate(rows))) for rows in rows_of]
        sides = sorted(((int(row), sign) for sign, rows in zip((-1.0, 1.0), finite, strict=True) for row in rows), key=lambda side: side[0] >= first)
        self._rows, self._sign = [row for row, _ in sides], ca.DM([sign for _, sign in sides])
        self.hard = sum(row < first for row in self._rows)
        self.softened = len(sides) - self.hard
        number = {side: count for count, side in enumerate(sides)}
        rows = range(first + ocp.ng * N)
        self._lower, self._upper = ([number.get((row, sign), len(sides)) for row in rows] for sign in (-1.0, 1.0))  # beyond them: none
        self.scale = along_rows(ocp, lin.scale_u, lin.scale_u, lin.scale_g)
        self.scale_side = self.scale[self._rows]
        self.per_scale = 1 / self.scale
        self._per_scale = self._sign * self.per_scale[self._rows]
        zero = ca.MX.zeros(lin.scale_u.shape)
        soft, scale = self._rows[self.hard :], self.scale_side[self.hard :]
        self.z, self.Z = along_rows(ocp, zero, zero, lin.zg)[soft] * scale / 2, along_rows(ocp, zero, zero, lin.Zg)[soft] * scale**2 / 2
        lower, upper = along_rows(ocp, w["lbu"], w["lbdu"], lin.lg)[self._rows], along_rows(ocp, w["ubu"], w["ubdu"], lin.ug)[self._rows]
        bound = ca.if_else(self._sign > 0, upper, lower)
        self._room = self._per_scale * (bound - ca.veccat(lin.u, forms.increments, forms.g)[self._rows])

    def change(self, d: ca.MX) -> ca.MX:
        """Return how much nearer deviations of the rows bring each side to its bound."""
        return self._per_scale * d[self._rows]

    def room(self, d: ca.MX) -> ca.MX:
        """Return the room to each bound at deviations of the rows; negative where it is exceeded."""
        return self._room - self.change(d)

    def onto(self, sides: ca.MX) -> ca.MX:
        """Return the sum over the sides of each row."""
        lower, upper = self._of_rows(sides)
        return lower + upper

    def directed(self, sides: ca.MX) -> ca.MX:
        """Return the same with lower sides counted negative."""
        lower, upper = self._of_rows(sides)
        return upper - lower

    def _of_rows(self, sides: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return the lower and the upper side of each row, zero where there is none."""
        padded = ca.vertcat(sides, ca.MX.zeros(2))  # of a scalar, CasADi would make a row
        return padded[self._lower], padded[self._upper]

    def split(self, sides: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return the hard and the softened part."""
        return sides[: self.hard], sides[self.hard :]


def enter(ocp: Ocp, lin: Linearization, stages: ca.MX) -> ca.Function:
    """
    Build ``(x, u, u_prev, stages, *ARGUMENTS, scale, x_plan, u_plan, start) -> interior``: a plan pushed inside its bounds.

    `start` is the product of distance and multiplier at every hard side, and about that at softened ones. There, distance and slack grow by the
    same push, and the multipliers of both add up to the slope of the penalty, so that steps begin with all conditions on slacks met, whatever
    their weights are.
    """
    N, N_u, nx, nu = ocp.N, ocp.N_u, ocp.model.nx, ocp.model.nu
    forms = lin.forms_in(stages)
    sides = Sides(ocp, lin, forms)
    x_plan, u_plan = ca.MX.sym("x_plan", nx, N + 1), ca.MX.sym("u_plan", nu, N_u)
    dx, du = x_plan - lin.x, u_plan - lin.u
    softened = softened_steps(ocp, lin).map(N)(forms.g_x, forms.g_u, dx[:, 1:], all_inputs(du, ocp.blocks))
    d = ca.veccat(du, du - ca.horzcat(ca.MX.zeros(nu), du[:, :-1]), softened)
    hard, room = sides.split(sides.room(d))
    start = ca.MX.sym("start")
    t_hard, exceeded = ca.fmax(hard, START_DISTANCE), ca.fmax(-room, 0)
    slope = sides.z + sides.Z * exceeded
    push = 2 * start / (slope + ca.sqrt(slope**2 + 4 * sides.Z * start))  # with which (slope + Z push) push = start
    t, s = ca.fmax(room, 0) + push, exceeded + push
    share = (sides.z + sides.Z * s) / (t + s)
    interior = ca.veccat(dx, d, t_hard, t, start / t_hard, share * s, s, share * t)
    inputs = {"x": lin.x, "u": lin.u, "u_prev": lin.u_prev, "stages": stages, **lin.weights, "x_plan": x_plan, "u_plan": u_plan, "start": start}
    return function("enter", inputs, {"interior": interior})


def step(ocp: Ocp, lin: Linearization, recursion: Riccati, stages: ca.MX, x0: ca.MX) -> ca.Function:
    """
    Build one step of predictor and corrector.

    It is ``(x, u, u_prev, x0, stages, *ARGUMENTS, scale, interior, least) -> (interior_after, x_plan, u_plan, violation, change,
    places_found, multipliers, product)``, with the plan after it as from a roll-out, and the mean product of distances and multipliers. No step
    aims at products below `least`; at it, steps still remove what rounding has left in the gradient of the Lagrangian.
    """
    N, N_u, nx, nu = ocp.N, ocp.N_u, ocp.model.nx, ocp.model.nu
    forms = lin.forms_in(stages)
    sides = Sides(ocp, lin, forms)
    sizes = [nx * (N + 1), sides.scale.numel(), *[sides.hard + sides.softened] * 2, *[sides.softened] * 2]
    interior = ca.MX.sym("interior", sum(sizes))
    dx, d, *numbers = ca.vertsplit(interior, np.cumsum([0, *sizes]).tolist())
    now = Point(*numbers)
    per = Point(*(1 / number for number in now))  # once, because divisions take longest
    stiff, stiff_slack = now.lam * per.t, now.nu * per.s
    stiff_hard, stiff_soft = sides.split(stiff)
    per_divisor, slope = 1 / (sides.Z + stiff_soft + stiff_slack), sides.z + sides.Z * now.s
    share = stiff_soft * per_divisor  # of a push on a softened side that its slack takes
    padding = ca.MX.zeros(sides.hard)
    residual = now.t - sides.room(d) - ca.vertcat(padding, now.s)

    def rows(flat: ca.MX) -> Rows:
        return Rows(*divided(flat, [lin.u, lin.u, lin.g]))

    def force(wanted: ca.MX, slack: ca.MX) -> ca.MX:
        """Return the multipliers at d, the slacks eliminated: `wanted` without slacks, `slack` what acts on them."""
        hard, soft = sides.split(wanted)
        return sides.directed(ca.vertcat(hard, soft - share * (soft + slack))) * sides.per_scale

    def toward(by: ca.MX, product_t: ca.MX, product_s: ca.MX) -> Point:
        """Return the step with which rows change by these amounts, and the linearized products have these values after it."""
        nearer = residual + sides.change(by)
        wanted_t, wanted_s = product_t * per.t, product_s * per.s
        s = per_divisor * (sides.split(stiff * nearer + wanted_t)[1] + wanted_s - slope)
        t = ca.vertcat(padding, s) - nearer
        return Point(t, wanted_t - now.lam - stiff * t, s, wanted_s - now.nu - stiff_slack * s)

    def longest(by: Point) -> ca.MX:
        return 1 / ca.mmax(ca.vertcat(1, *(-change * per_one for per_one, change in zip(per, by, strict=True))))

    def moved(by: Point, length: ca.MX) -> Point:
        return Point(*(number + length * change for number, change in zip(now, by, strict=True)))

    def mean_product(at: Point) -> ca.MX:
        return (ca.dot(at.t, at.lam) + ca.dot(at.s, at.nu)) / max(1, sides.hard + 2 * sides.softened)

    weight = sides.onto(ca.vertcat(stiff_hard, share * (sides.Z + stiff_slack))) * sides.per_scale**2
    here, damped = moved_to(ocp, lin, forms, ca.reshape(dx, nx, N + 1), rows(d))
    gains = recursion.gains(ca.veccat(*here), rows(weight), rows(force(stiff * residual, -slope) + damped))
    states, _, predicted = recursion.rolled(here, gains, ca.vertcat(x0 - lin.x[:, 0] - dx[:nx], ca.MX.zeros(nu)), defects=True)
    d_affine = ca.veccat(predicted.u, predicted.du, predicted.g)
    affine = toward(d_affine, ca.MX.zeros(sides.hard + sides.softened), ca.MX.zeros(sides.softened))

    product = mean_product(now)
    least = ca.MX.sym("least")
    centre = ca.fmax(least, product * ca.fmin(1, (mean_product(moved(affine, longest(affine))) / product) ** 3))
    wanted_t, wanted_s = centre - affine.t * affine.lam, centre - affine.s * affine.nu
    states_by, by = recursion.response(stages, gains, rows(force(wanted_t * per.t, wanted_s * per.s)))
    d_full = d_affine + ca.veccat(by.u, by.du, by.g)
    full = toward(d_full, wanted_t, wanted_s)
    length = ca.fmin(1, SHARE_OF_WAY * longest(full))

    after = moved(full, length)
    dx, d = dx + length * ca.vec(states + states_by), d + length * d_full
    u_plan = lin.u + ca.reshape(d[: nu * N_u], nu, N_u)
    acts_hard, acts_soft = sides.split(after.lam > after.t)
    exceeded = -sides.split(sides.room(d))[1]
    outputs = {
        "interior_after": ca.veccat(dx, d, *after),
        "x_plan": lin.x + ca.reshape(dx, nx, N + 1),
        "u_plan": u_plan,
        "violation": ca.vertcat(*(ca.mmax(ca.vertcat(-INFINITY, e)) for e in (exceeded * sides.split(sides.scale_side)[1], exceeded))),
        "change": change(lin, u_plan),
        "places_found": sides.directed(ca.vertcat(acts_hard, acts_soft * (1 + (after.s > after.nu)))),
        "multipliers": (sides.directed(after.lam) * sides.per_scale)[nu * N_u :],
        "product": mean_product(after),
    }
    guess = {"x": lin.x, "u": lin.u, "u_prev": lin.u_prev, "x0": x0, "stages": stages}
    return function("step", {**guess, **lin.weights, "interior": interior, "least": least}, outputs)


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
