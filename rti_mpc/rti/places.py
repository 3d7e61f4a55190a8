# SPDX-License-Identifier: Apache-2.0
r"""
Functions of the active-set method: bounds enter the Riccati recursion by the *place* of what they bound. All places
together are what others call the working set.

A value at its bound is held there by a penalty too stiff to yield noticeably; a value
beyond a softened bound pays the penalty of its slack; any other value is free. In a
roll-out from the initial state, a value that crosses a bound is placed at it, and a
bound whose multiplier has changed its sign is released: a primal-dual active-set method
[Hintermueller2003]_. It may cycle, which `rti_mpc.rti.homotopy` does not. A
roll-out that changes no place is the solution, up to the small amount by which the
penalty yields; a refinement, one sweep over vectors with the same gains, removes that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from rti_mpc.codegen import function, function_in_c
from rti_mpc.rti import homotopy, interior_point
from rti_mpc.rti.blocks import all_inputs, at_each, moved_on, repeated
from rti_mpc.rti.composition import Names, compose
from rti_mpc.rti.linearization import Forms, Linearization, change, divided, linearization, partly, shift, where_bounded
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.transcription import INFINITY
from rti_mpc.rti.recursion import block_table, recur, stage_in_c
from rti_mpc.rti.riccati import Gain, Riccati, Rows, Stage, softened_steps

PENALTY = 3e9  # weight that holds values at their bounds, in units of their scale; with a larger one digits are lost
BOUND_TOLERANCE = 1e-9  # a bound acts when it is exceeded by more than this, relative to its scale, so that rounding does not decide
RELEASE_MULTIPLIER = 1e-6  # a bound is released when its multiplier has the wrong sign and is larger, in normalised cost per scale of what is bounded

UNTIL = """
  const casadi_real *now = arg[0], *of = arg[1];
  casadi_int j, k, differs = of[0] != of[0]; /* NaN: all stages, also those that have no place of their own */
  for (k = STAGES - 1; k >= 0; --k) {
    const casadi_int u = NU * BLOCK, du = NU * (FREE + BLOCK), g = NU * 2 * FREE + NG * k;
    for (j = 0; j < NG; ++j) differs |= now[g + j] != of[g + j];
    if (IS_FREE) for (j = 0; j < NU; ++j) differs |= now[u + j] != of[u + j] || now[du + j] != of[du + j];
    if (differs) break;
  }
  *res[0] = k + 1;
  casadi_copy(now, ROWS, res[1]);
  return 0;
"""


@dataclass(frozen=True, eq=False)
class Places:
    """
    The functions of the two phases.

    A place is 0 for a free value, -1 or 1 at the lower or upper bound, -2 or 2 beyond a softened bound. There are places of inputs and of increments,
    shapes ``(nu, N_u)``, and of expressions with softened bounds, shape ``(ng, N)``, one after the other. Multipliers, of increments and of softened
    bounds, are positive at an upper bound.

    Attributes:
        linearize: ``(x, u, u_prev, y_ref, p, *ARGUMENTS, scale) -> stages``.
        advance: ``(x, u, u_prev, y_ref, p, *ARGUMENTS, scale, places) -> (x_next, u_next, places_next, stages)``: the same at
            the plan shifted by one stage.
        gains: ``(stages, u, *ARGUMENTS, scale, places, gains_known, P_known, p_known, places_of_known) -> (gains, P, p, places_of)``: gains, and the
            cost-to-go before each stage, all of these places. With the known ones of other places, but of the same linearization, compiled code goes
            only over the stages up to the last one whose places differ. What is known may be in the memory of the results. Known places
            that are NaN differ at all stages.
        roll_out: ``(x, u, u_prev, x0, stages, gains, *ARGUMENTS, scale, places) -> (x_plan, u_plan, violation, change, changes, stiff,
            places_found, multipliers, targets)``: the plan after the full step, its largest violation of softened bounds, in their unit and
            relative to their scale, the size of the step, and how many places change: -1 if data, gains or plan are not finite. `stiff` is the
            number of increments and softened bounds that are held, whose penalties the cost-to-go carries. Targets are the coordinates of the
            rows, see `rti_mpc.rti.homotopy`.
        roll_out_again: Gains of other places, then their roll-out, ``roll_out`` with the places ``places_of``.
        move_on: The way along the homotopy to the next change of a place, see `rti_mpc.rti.homotopy.move`, then the same of its ``places``. Of the
            change and the roll-out before, it takes ``places_known``, ``point_known``, ``places_found_known``, ``targets_known`` and ``still_known``.
        refine: ``(x, u, u_prev, stages, gains, *ARGUMENTS, scale, places, r, x_plan, u_plan, multipliers) -> (x_refined,
            u_refined, multipliers_refined)``: plan and multipliers after a Newton step that removes the remaining gradient r of the Lagrangian,
            see `rti_mpc.rti.certificate`.
        begin: The start of the homotopy; see `rti_mpc.rti.homotopy`.
        enter: The start of the interior point; see `rti_mpc.rti.interior_point`.
        step: A step of the interior point.
    """

    linearize: ca.Function
    advance: ca.Function
    gains: ca.Function
    roll_out: ca.Function
    roll_out_again: ca.Function
    move_on: ca.Function
    refine: ca.Function
    begin: ca.Function
    enter: ca.Function
    step: ca.Function


class Sample(NamedTuple):
    """
    Symbols that a roll-out and its refinement depend on.

    Attributes:
        lin: Expressions of the sample.
        forms: Its linearization.
        gains: Gains of all stages, shape ``(size, N_u)``.
        place: Places of all rows.
    """

    lin: Linearization
    forms: Forms
    gains: ca.MX
    place: Rows


def places(ocp: Ocp) -> Places:
    """Build the functions of an OCP."""
    lin = linearization(ocp)
    linearize = function("linearize", lin.arguments, {"stages": lin.stages})
    recursion = Riccati(ocp, lin)
    stages = ca.MX.sym("stages", linearize.numel_out("stages"))
    kinds = [lin.u, lin.u, lin.g]
    flat = ca.MX.sym("places", sum(kind.numel() for kind in kinds))
    x0, found = ca.MX.sym("x0", ocp.model.nx), ca.MX.sym("gains", recursion.size, ocp.N_u)
    at = Sample(lin, lin.forms_in(stages), found, Rows(*divided(flat, kinds)))

    x, u = shift(ocp)(lin.x, lin.u, lin.p)
    rows = *(moved_on(kind, ocp.blocks) for kind in (at.place.u, at.place.du)), ca.horzcat(at.place.g[:, 1:], at.place.g[:, -1])
    bounds = (ocp.lbu, ocp.ubu), (ocp.lbdu, ocp.ubdu), (ocp.lg, ocp.ug)
    moved = ca.veccat(
        *(where_bounded(row, *pair) if partly(pair[0]).any() or partly(pair[1]).any() else row for row, pair in zip(rows, bounds, strict=True))
    )
    linearized = linearize(**(lin.arguments | {"x": x, "u": u}))["stages"]
    advance = {"x_next": x, "u_next": u, "places_next": moved, "stages": linearized}

    guess = {"x": lin.x, "u": lin.u, "u_prev": lin.u_prev}
    fixed = {"stages": stages, "gains": found, **lin.weights, "places": flat}
    rolled = roll_out(ocp, at, x0)
    gains, rolling = gains_of(ocp, recursion, at, stages, flat), function("roll_out", {**guess, "x0": x0, **fixed}, rolled)
    again: list[tuple[ca.Function, Names]] = [(gains, {}), (rolling, {"places": "places_of"})]
    on_way = {name: f"{name}_known" for name in ("places", "places_found", "point", "targets", "still")}
    on_way |= {"places_next": "places", "point_next": "point", "still_next": "still"}
    plan = {"r": lin.u, "x_plan": lin.x, "u_plan": lin.u, "multipliers": rolled["multipliers"]}
    plan = {name: ca.MX.sym(name, *like.shape) for name, like in plan.items()}
    return Places(
        linearize,
        function("advance", {**lin.arguments, "places": flat}, advance),
        gains,
        rolling,
        compose("roll_out_again", again),
        compose("move_on", [(homotopy.move(flat.numel()), on_way), *again]),
        function("refine", {**guess, **fixed, **plan}, refine(ocp, recursion, at, stages, **plan)),
        homotopy.begin(ocp, lin, stages),
        interior_point.enter(ocp, lin, stages),
        interior_point.step(ocp, lin, recursion, stages, x0),
    )


def gains_of(ocp: Ocp, recursion: Riccati, at: Sample, stages: ca.MX, flat: ca.MX) -> ca.Function:
    """Build `Places.gains`."""
    lin, until, begins = at.lin, ca.MX.sym("until"), at.lin.begins()
    given = {"stages": stages, "u": lin.u, **lin.weights, "places": flat}
    data = recursion.data(at.forms, *penalties(ocp, at, until))
    own = {name: expression for name, expression in data.items() if name not in begins}
    terms = function("terms", {**given, "until": until}, {f"{name}_term": expression for name, expression in own.items()})
    names: dict[str, str | tuple[str, int]] = {name: f"{name}_term" if name in own else ("stages", begins[name]) for name in data}
    results = dict(zip(("gain", "P_before", "p_before"), ("gains", "P", "p"), strict=True))
    names |= results | {f"known_{result}": f"{name}_known" for result, name in results.items()}
    return compose("gains", [(stages_until(ocp, flat.numel()), {}), (terms, {}), (recursion.again, names)], [*results.values(), "places_of"])


def stages_until(ocp: Ocp, size: int) -> ca.Function:
    """
    Build ``(places, places_of_known) -> (until, places_of)``: the number of stages up to the last one whose places differ, and the places.

    Interpreted, that is the number of all stages.

    Args:
        ocp: The problem.
        size: Number of rows.
    """
    block = ocp.held.tolist()
    is_first, of_block = stage_in_c(block)
    body = UNTIL.replace("IS_FREE", is_first).replace("BLOCK", of_block)
    sizes = f"enum {{ STAGES = {ocp.N}, FREE = {ocp.N_u}, NU = {ocp.model.nu}, NG = {ocp.ng}, ROWS = {size} }};"
    rows = {name: ca.MX.sym(name, size) for name in ("places", "places_of_known")}
    found = {"until": ca.MX(ocp.N), "places_of": rows["places"]}
    return function_in_c("until", rows, found, "\n".join([sizes, block_table(block) if of_block != "k" else "", body]))


def penalties(ocp: Ocp, at: Sample, until: ca.MX) -> tuple[Rows, Rows]:
    """Return the weight and the pull of each row of the first stages, which follow from its place."""
    lin, w = at.lin, at.lin.w
    stiff_u, stiff_g = PENALTY / lin.scale_u**2, PENALTY / lin.scale_g**2
    limits = {name: w[name] for name in ("lbu", "ubu", "lbdu", "ubdu")} | {"lg": lin.lg, "ug": lin.ug, "zg": lin.zg, "Zg": lin.Zg}
    rows = "u", "du", "g"
    outputs = [f"{what}_{row}" for what in ("weight", "pull") for row in rows]
    along = recur(
        "penalties",
        repeated(penalties_free(ocp), penalties_held(ocp), ocp.blocks),
        {},
        outputs,
        shared=["stiff_u", "stiff_g", *(name for name, limit in limits.items() if limit.size2() == 1)],
        limited=True,
    )
    found = along(
        place_u=at.place.u,
        u=lin.u,
        place_du=at.place.du,
        increment=at.forms.increments,
        place_g=at.place.g,
        g=at.forms.g,
        stiff_u=stiff_u,
        stiff_g=stiff_g,
        **limits,
        until=until,
    )
    weight, pull = (Rows(*(found[f"{what}_{row}"] for row in rows)) for what in ("weight", "pull"))
    return weight, pull


def penalties_held(ocp: Ocp) -> ca.Function:
    """Build ``(place_g, g, lg, ug, stiff_g, zg, Zg) -> (weight_g, pull_g)`` of a stage whose input is that of the stage before."""
    names = "place_g", "g", "lg", "ug", "stiff_g", "zg", "Zg"
    place, value, lower, upper, stiff, z, Z = own = [ca.SX.sym(name, ocp.ng) for name in names]
    weight, pull = hold(place, value, lower, upper, stiff)
    beyond = (ca.fabs(place) == 2) / 2
    pull += beyond * (Z * (value - ca.if_else(place > 0, upper, lower)) + ca.sign(place) * z)
    return function("penalties_held", dict(zip(names, own, strict=True)), {"weight_g": weight + beyond * Z, "pull_g": pull})


def penalties_free(ocp: Ocp) -> ca.Function:
    """Build the same of a stage with an input, with the weights and pulls of the input and its increment."""
    softened = penalties_held(ocp)
    inputs = {name: ca.SX.sym(name, ocp.ng) for name in softened.name_in()}
    names = "place_u", "u", "lbu", "ubu", "place_du", "increment", "lbdu", "ubdu", "stiff_u"
    place_u, u, lbu, ubu, place_du, increment, lbdu, ubdu, stiff = own = [ca.SX.sym(name, ocp.model.nu) for name in names]
    weight_u, pull_u = hold(place_u, u, lbu, ubu, stiff)
    weight_du, pull_du = hold(place_du, increment, lbdu, ubdu, stiff)
    of_inputs = {"weight_u": weight_u, "pull_u": pull_u, "weight_du": weight_du, "pull_du": pull_du}
    return function("penalties_free", {**dict(zip(names, own, strict=True)), **inputs}, of_inputs | softened(**inputs))


def hold(place: ca.SX, value: ca.SX, lower: ca.SX, upper: ca.SX, weight: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return weight and gradient of the penalty on values that are placed at their bounds."""
    weight = weight * (ca.fabs(place) == 1)
    return ca.densify(weight), ca.densify(weight * (value - ca.if_else(place > 0, upper, lower)))


def roll_out(ocp: Ocp, at: Sample, x0: ca.MX) -> dict[str, ca.MX]:
    """Return the outputs of `Places.roll_out`, by name."""
    lin, forms, w = at.lin, at.forms, at.lin.w
    nx, nu = ocp.model.nx, ocp.model.nu
    limits = {"lg": lin.lg, "ug": lin.ug, "zg": lin.zg, "Zg": lin.Zg, "stiff_g": PENALTY / lin.scale_g**2, "scale_g": lin.scale_g}
    bounds = {name: w[name] for name in ("lbu", "ubu", "lbdu", "ubdu")} | {"stiff_u": PENALTY / lin.scale_u**2, "scale_u": lin.scale_u}
    start = {
        "s": ca.vertcat(x0 - lin.x[:, 0], ca.MX.zeros(nu)),
        "slip": ca.MX.zeros(nx + nu),
        "verdict": ca.MX(ca.DM([0, 0, -INFINITY, -INFINITY])),  # changes, stiff rows, violation, violation relative to scale
        "before": lin.u_prev,
    }
    carried = {"s": "s_after", "slip": "slip_after", "verdict": "verdict_after", "before": "u_plan"}
    found, targets = ([f"{what}_{row}" for row in ("u", "du", "g")] for what in ("found", "target"))
    outputs = ["x_plan", "u_plan", "verdict_after", *found, *targets, "force", "paid"]
    rolling = repeated(roll_free(ocp, lin), roll_held(ocp, lin), ocp.blocks)
    along = recur("rolled_out", rolling, carried, outputs, shared=[name for name, e in (limits | bounds).items() if e.size2() == 1])(
        A=forms.A,
        B=forms.B,
        b=forms.b,
        g_x=forms.g_x,
        g_u=forms.g_u,
        g=forms.g,
        x_next=lin.x[:, 1:],
        u=lin.u,
        increment=forms.increments,
        gain=at.gains,
        place_u=at.place.u,
        place_du=at.place.du,
        place_g=at.place.g,
        **limits,
        **bounds,
        **start,
    )
    x_plan, u_plan, verdict = ca.horzcat(x0, along["x_plan"]), along["u_plan"], along["verdict_after"][:, -1]
    finite = forms.checksum + ca.sum1(ca.vec(u_plan)) + ca.sumsqr(x_plan) ** 2  # overflows if a state is too large
    return {
        "x_plan": x_plan,
        "u_plan": u_plan,
        "violation": verdict[2:],
        "change": change(lin, u_plan),
        "changes": ca.if_else(ca.fabs(finite) < np.inf, verdict[0], -1),
        "stiff": verdict[1],
        "places_found": ca.veccat(*(along[name] for name in found)),
        "multipliers": ca.veccat(along["force"], along["paid"]),
        "targets": ca.veccat(*(along[name] for name in targets)),
    }


class Softened(NamedTuple):
    """
    The part of a stage of the roll-out that free and held stages share.

    Attributes:
        symbols: Symbols that it depends on, by name.
        outputs: Expressions that it returns, by name, without the verdict.
        verdict: Number of places changed so far, and of stiff rows, largest violation of a softened bound, and the same relative to its scale.
    """

    symbols: dict[str, ca.SX]
    outputs: dict[str, ca.SX]
    verdict: list[ca.SX]


def softened_rows(ocp: Ocp, of: Stage, s: ca.SX, slip: ca.SX, du: ca.SX, slipped: ca.SX) -> Softened:
    """
    Return the end of a stage, and the places of the expressions with softened bounds there.

    Args:
        ocp: The problem.
        of: Symbols of the stage.
        s: Symbol of the deviation at the start of the stage, shape ``(nx + nu,)``.
        slip: Symbol of the change of s so far that comes from clipping inputs exactly to their bounds.
        du: Deviation of its input.
        slipped: Difference between the clipped input and the input with that deviation.
    """
    nx = of.nx
    x_next, verdict = ca.SX.sym("x_next", nx), ca.SX.sym("verdict", 4)
    names = ("g", "place_g", "lg", "ug", "zg", "Zg", "stiff_g", "scale_g")
    g, place_g, lg, ug, zg, Zg, stiff_g, scale_g = own = [ca.SX.sym(name, of.ng) for name in names]
    changes, stiff_rows, worst, share = ca.vertsplit(verdict)
    drift = of.A @ slip[:nx] + of.B @ slipped
    dx = of.A @ s[:nx] + of.B @ du + of.b
    end = ca.vertcat(dx, du)
    value = g + of.G @ end
    planned = value + of.G @ ca.vertcat(drift, slipped)
    found, paid, target = (ca.SX(of.ng, 1) for _ in range(3))
    lb, ub = ocp.tightest("lg"), ocp.tightest("ug")
    for j in range(of.ng):
        over, under = excess_of(value[j], lg[j], ug[j], lb[j], ub[j])
        exceeds = ca.fmax(*excess_of(planned[j], lg[j], ug[j], lb[j], ub[j]))
        worst, share = ca.fmax(worst, exceeds), ca.fmax(share, exceeds / scale_g[j])
        found[j] = new_place(place_g[j], stiff_g[j], scale_g[j], over, under, zg[j] / 2)
        changes += found[j] != place_g[j]
        stiff_rows += ca.fabs(place_g[j]) == 1
        by = ca.if_else(place_g[j] > 0, over, under)
        target[j] = ca.if_else(ca.fabs(place_g[j]) == 1, stiff_g[j] * by, value[j])
        paid[j] = ca.sign(place_g[j]) * ca.if_else(ca.fabs(place_g[j]) == 2, (zg[j] + Zg[j] * by) / 2, stiff_g[j] * by)
    symbols = {**of.dynamics, **of.defect, **of.softened, **dict(zip(names, own, strict=True))}
    symbols |= {"x_next": x_next, "s": s, "slip": slip, "verdict": verdict}
    outputs = {"x_plan": x_next + dx + drift, "s_after": end, "slip_after": ca.vertcat(drift, slipped)}
    outputs |= {"found_g": ca.densify(found), "paid": ca.densify(paid), "target_g": ca.densify(target)}
    return Softened(symbols, outputs, [changes, stiff_rows, worst, share])


def simplified(name: str, inputs: dict[str, ca.SX], outputs: dict[str, ca.SX]) -> ca.Function:
    """Build a function whose common subexpressions are computed once."""
    return function(name, inputs, dict(zip(outputs, ca.cse([*outputs.values()]), strict=True)))


def roll_held(ocp: Ocp, lin: Linearization) -> ca.Function:
    """Build a stage of the roll-out whose input is that of the stage before."""
    of = Stage(ocp, lin)
    s, slip = ca.SX.sym("s", of.n), ca.SX.sym("slip", of.n)
    symbols, outputs, verdict = softened_rows(ocp, of, s, slip, s[of.nx :], slip[of.nx :])
    return simplified("coast", symbols, {**outputs, "verdict_after": ca.vertcat(*verdict)})


def roll_free(ocp: Ocp, lin: Linearization) -> ca.Function:
    """Build a stage of the roll-out with an input."""
    of, nu = Stage(ocp, lin), ocp.model.nu
    s, slip, gain = ca.SX.sym("s", of.n), ca.SX.sym("slip", of.n), Gain(of)
    names = ("increment", "u", "before", "place_u", "place_du", "lbu", "ubu", "lbdu", "ubdu", "stiff_u", "scale_u")
    increment, u, before, place_u, place_du, lbu, ubu, lbdu, ubdu, stiff, scale = own = [ca.SX.sym(name, nu) for name in names]
    du = -(gain.K @ s + gain.kappa)
    # Clipping removes the small amount by which the penalty yields. States follow the clipped input, places do not: degenerate ones would cycle.
    u_plan = clipped_input(u + du, before, lbu, ubu, lbdu, ubdu)
    symbols, outputs, verdict = softened_rows(ocp, of, s, slip, du, u_plan - u - du)

    def placed(value: ca.SX, place: ca.SX, lower: ca.SX, upper: ca.SX, lb: Any, ub: Any) -> ca.SX:
        now = [new_place(place[j], stiff[j], scale[j], *excess_of(value[j], lower[j], upper[j], lb[j], ub[j]), INFINITY) for j in range(nu)]
        return ca.densify(ca.vertcat(*now))

    def targets(value: ca.SX, place: ca.SX, lower: ca.SX, upper: ca.SX) -> ca.SX:
        by = ca.if_else(place > 0, value - upper, lower - value)
        return ca.densify(ca.if_else(ca.fabs(place) == 1, stiff * by, value))

    planned = increment + du - s[of.nx :]
    outputs["found_u"] = placed(u + du, place_u, lbu, ubu, ocp.tightest("lbu"), ocp.tightest("ubu"))
    outputs["found_du"] = placed(planned, place_du, lbdu, ubdu, ocp.tightest("lbdu"), ocp.tightest("ubdu"))
    verdict[0] += ca.sum1(outputs["found_u"] != place_u)
    verdict[0] += ca.sum1(outputs["found_du"] != place_du)
    verdict[1] += ca.sum1(ca.fabs(place_du) == 1)
    outputs["target_u"], outputs["target_du"] = targets(u + du, place_u, lbu, ubu), targets(planned, place_du, lbdu, ubdu)
    outputs["force"] = ca.densify(stiff * (ca.fabs(place_du) == 1) * (planned - ca.if_else(place_du > 0, ubdu, lbdu)))
    inputs = {**symbols, "gain": gain.column, **dict(zip(names, own, strict=True))}
    return simplified("forward", inputs, {**outputs, "u_plan": u_plan, "verdict_after": ca.vertcat(*verdict)})


def clipped_input(u: ca.SX, before: ca.SX, lbu: ca.SX, ubu: ca.SX, lbdu: ca.SX, ubdu: ca.SX) -> ca.SX:
    """Return an input clipped exactly to its bounds, as an actuator needs it."""
    paced = ca.fmax(ca.fmin(u, before + ubdu), before + lbdu)
    return ca.fmax(ca.fmin(paced, ubu), lbu)


def excess_of(value: ca.SX, lower: ca.SX, upper: ca.SX, lb: float, ub: float) -> tuple[ca.SX, ca.SX]:
    """Return by how much a value is above its upper and below its lower bound; minus `INFINITY` where there is no bound."""
    absent = ca.SX(-INFINITY)
    return value - upper if np.isfinite(ub) else absent, lower - value if np.isfinite(lb) else absent


def new_place(place: ca.SX, stiff: ca.SX, scale: ca.SX, over: ca.SX, under: ca.SX, most: ca.SX | float) -> ca.SX:
    """Return the new place of a value that exceeds its bounds by `over` and `under`; a pull above `most` places it beyond a softened bound."""
    tolerance = BOUND_TOLERANCE * scale
    side = ca.sign(place)
    by = ca.if_else(place > 0, over, under)
    free = (over > tolerance) - (under > tolerance)
    held = ca.if_else(stiff * by > most, 2 * side, side * (stiff * by * scale > -RELEASE_MULTIPLIER))
    beyond = ca.if_else(by < -tolerance, side, 2 * side)
    return ca.SX(ca.if_else(place == 0, free, ca.if_else(ca.fabs(place) == 1, held, beyond)))


def refine(
    ocp: Ocp, recursion: Riccati, at: Sample, stages: ca.MX, *, r: ca.MX, x_plan: ca.MX, u_plan: ca.MX, multipliers: ca.MX
) -> dict[str, ca.MX]:
    """Return the outputs of `Places.refine`, by name: a Newton step on the optimality conditions that brings held softened rows to their bounds."""
    lin, forms, place = at.lin, at.forms, at.place
    N, N_u, nu, w = ocp.N, ocp.N_u, ocp.model.nu, lin.w
    of_increments, of_softened = divided(multipliers, [lin.u, lin.g])
    du = u_plan - lin.u
    values = forms.g + softened_steps(ocp, lin).map(N)(forms.g_x, forms.g_u, x_plan[:, 1:] - lin.x[:, 1:], all_inputs(du, ocp.blocks))
    weight = ca.repmat(PENALTY / lin.scale_g**2, 1, N) * (ca.fabs(place.g) == 1)
    lower, upper = (at_each(e, N) for e in (lin.lg, lin.ug))
    excess = values - ca.if_else(place.g > 0, upper, lower)
    # A row that no free input moves stays where it is: its multiplier would grow with each refinement, and with it those that hold the inputs.
    movable = recur("movable", repeated(movable_free(nu), movable_held(), ocp.blocks), {"before": "moves"}, ["moves"])
    weight *= ca.repmat(movable(place_u=place.u, place_du=place.du, before=ca.MX(0))["moves"], ocp.ng, 1)
    zero = ca.MX.zeros(nu, N_u)
    _, rows = recursion.response(stages, at.gains, Rows(r * (place.u == 0), zero, weight * excess))
    step = rows.u
    side = ca.sign(place.g)
    by = side * (excess + rows.g)
    beyond = side * (at_each(lin.zg, N) + at_each(lin.Zg, N) * by) / 2
    paid = ca.if_else(ca.fabs(place.g) == 2, beyond, (of_softened + weight * (excess + rows.g)) * (ca.fabs(place.g) == 1))
    force = of_increments + ca.repmat(PENALTY / lin.scale_u**2, 1, N_u) * (ca.fabs(place.du) == 1) * rows.du
    amending = repeated(amend_free(lin, nu), amend_held(lin, nu), ocp.blocks)
    carried = {"before": "u_refined", "du": "du_after", "dx": "dx_after"}
    bounds = {name: w[name] for name in ("lbu", "ubu", "lbdu", "ubdu")}
    amended = recur("amended", amending, carried, ["x_refined", "u_refined"], shared=[name for name, e in bounds.items() if e.size2() == 1])(
        A=forms.A,
        B=forms.B,
        x_plan=x_plan[:, 1:],
        u_plan=u_plan,
        step=step,
        before=lin.u_prev,
        du=ca.MX.zeros(nu),
        dx=ca.MX.zeros(ocp.model.nx),
        **bounds,
    )
    states = ca.horzcat(x_plan[:, 0], amended["x_refined"])
    return {"x_refined": states, "u_refined": amended["u_refined"], "multipliers_refined": ca.veccat(force, paid)}


def movable_free(nu: int) -> ca.Function:
    """Build ``(place_u, place_du, before) -> moves``: whether the input of a stage, or one before, moves what comes after it."""
    place_u, place_du, before = ca.SX.sym("place_u", nu), ca.SX.sym("place_du", nu), ca.SX.sym("before")
    free = ca.sum1(ca.logic_and(place_u == 0, place_du == 0)) > 0
    return function("movable_free", {"place_u": place_u, "place_du": place_du, "before": before}, {"moves": ca.logic_or(before, free)})


def movable_held() -> ca.Function:
    """Build the same of a stage whose input is that of the stage before."""
    before = ca.SX.sym("before")
    return function("movable_held", {"before": before}, {"moves": before})


def amended_stage(lin: Linearization, du: ca.SX) -> tuple[dict[str, ca.SX], dict[str, ca.SX]]:
    """Return symbols and results of a stage of a plan whose input changes by du."""
    a, b = ca.SX.sym("a", lin.A_k.nnz()), ca.SX.sym("b", lin.B_k.nnz())
    x_plan, dx = (ca.SX.sym(name, lin.A_k.size1()) for name in ("x_plan", "dx"))
    after = ca.densify(ca.SX(lin.A_k, a) @ dx + ca.SX(lin.B_k, b) @ du)
    return {"A": a, "B": b, "x_plan": x_plan, "dx": dx}, {"x_refined": x_plan + after, "dx_after": after}


def amend_held(lin: Linearization, nu: int) -> ca.Function:
    """Build a stage of a plan whose input changes as that of the stage before."""
    du = ca.SX.sym("du", nu)
    symbols, outputs = amended_stage(lin, du)
    return function("amend_held", {**symbols, "du": du}, outputs)


def amend_free(lin: Linearization, nu: int) -> ca.Function:
    """Build a stage of a plan whose input changes by a step, clipped to its bounds."""
    names = ("u_plan", "step", "before", "lbu", "ubu", "lbdu", "ubdu", "du")
    u_plan, step, before, lbu, ubu, lbdu, ubdu, _ = own = [ca.SX.sym(name, nu) for name in names]
    u_refined = clipped_input(u_plan + step, before, lbu, ubu, lbdu, ubdu)
    symbols, outputs = amended_stage(lin, u_refined - u_plan)
    outputs |= {"u_refined": u_refined, "du_after": u_refined - u_plan}
    return function("amend_free", {**symbols, **dict(zip(names, own, strict=True))}, outputs)
