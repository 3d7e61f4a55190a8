# SPDX-License-Identifier: Apache-2.0
"""
Excursions: starts and references that drive a controller to each of its bounds.

A wave of moderate size reaches few bounds, so an error of a solver at a bound could
stay hidden. Bounds of inputs and increments are reached by a reference ten times as far
away as those inputs can drive the outputs, softened bounds by a start beyond them. Both
stay where the model is regular: a tank has no level below its bottom, and no input
drives it there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti

REFERENCE_DISTANCE_FACTOR = 10.0  # the reference is this factor farther away than the outputs that a bound can reach
START_EXCESS_SCALES = 1.0  # the start exceeds a softened bound by this many scales of the bounded quantity
SHARES = tuple(0.5**k for k in range(11))  # of an excess, or of an input's way to its bound, tried until the model is regular
NEWTON_STEPS = 8  # to find such a start; a linear constraint takes one step
AT_BOUND_SCALES = 1e-3  # a plan this close to a bound, in scales of the bounded quantity, counts as at it


@dataclass(frozen=True)
class Excursion:
    """Initial state, shape ``(nx,)``, and reference rows, shape ``(N, ny)``."""

    x0: Array
    y_ref: Array


class Bounds:
    """
    The bounds of a problem, and which of them the plans of a controller have reached.

    Attributes:
        names: Name of each finite bound; lower and upper bounds count separately.
        reached: Which of them have been reached so far, shape ``(len(names),)``.
    """

    def __init__(self, rti: Rti) -> None:
        self._rti, ocp = rti, rti.ocp
        model = ocp.model
        self._scale_u, self._scale_g = rti.scale_u, rti.scale_g[: ocp.ng_path]
        lg, ug = (ocp.tightest(name)[: ocp.ng_path] for name in ("lg", "ug"))
        lbu, ubu, lbdu, ubdu = (ocp.tightest(name) for name in ("lbu", "ubu", "lbdu", "ubdu"))
        inputs = [signal.name for signal in model.inputs]
        softened = [model.states[j].name for j in ocp.soft] + [signal.name for signal in model.constraints[: ocp.h_expr.numel()]]
        softened += [f"constraint {j}" for j in range(len(softened) - len(ocp.soft), ocp.h_expr.numel())]
        kinds: tuple[tuple[str, list[str], Array, Array], ...]
        kinds = (("", inputs, lbu, ubu), ("increment of ", inputs, lbdu, ubdu), ("", softened, lg, ug))
        kinds += (("second difference of ", inputs, ocp.lbddu, ocp.ubddu),)
        self._there = np.concatenate([np.isfinite(bounds) for _, _, lower, upper in kinds for bounds in (lower, upper)])
        every = [f"{side} bound of {kind}{name}" for kind, names, _, _ in kinds for side in ("lower", "upper") for name in names]
        self.names = [name for name, there in zip(every, self._there, strict=True) if there]
        self.reached = np.zeros(len(self.names), dtype=bool)
        self._softened = ca.Function("softened", [model.x, model.u, model.p], [ca.vertcat(model.x[list(ocp.soft), 0], ocp.h_expr)]).map(ocp.N)

    def note_plan(self) -> None:
        """Note which bounds the last plan has reached."""
        rti, ocp = self._rti, self._rti.ocp
        held = rti.u[ocp.held]
        increments = np.diff(rti.u, axis=0, prepend=rti.u_prev[None])
        softened = np.array(self._softened(rti.x[1:].T, held.T, rti.p[1:].T)).reshape(-1, ocp.N).T
        found = []
        for values, lower, upper, scale in (
            (rti.u, ocp.lbu, ocp.ubu, self._scale_u),
            (increments, ocp.lbdu, ocp.ubdu, self._scale_u),
            (softened, ocp.lg[..., : ocp.ng_path], ocp.ug[..., : ocp.ng_path], self._scale_g),
            (np.diff(increments, axis=0, prepend=(rti.u_prev - rti.u_before)[None]), ocp.lbddu, ocp.ubddu, self._scale_u),
        ):
            found += [(values <= lower + AT_BOUND_SCALES * scale).any(axis=0), (values >= upper - AT_BOUND_SCALES * scale).any(axis=0)]
        self.reached |= np.concatenate(found)[self._there]

    @property
    def missed(self) -> list[str]:
        """Names of the bounds that no plan has reached."""
        return [name for name, reached in zip(self.names, self.reached, strict=True) if not reached]


def excursions(rti: Rti, x0: Array) -> Iterator[Excursion]:
    """Yield an excursion to each finite bound, near the state `x0`, shape ``(nx,)``."""
    ocp = rti.ocp
    rest = np.array(ocp.model.u_rest)
    nominal = outputs(ocp, x0, rest)
    for of_rest, lower, upper, reach in ((0.0, "lbu", "ubu", 1), (rest, "lbdu", "ubdu", ocp.N_u)):
        for bounds in (ocp.tightest(lower) + of_rest, ocp.tightest(upper) + of_rest):
            for j in np.flatnonzero(np.isfinite(bounds)):
                way = np.zeros(len(rest))
                way[j] = reach * (bounds[j] - rest[j])
                yield Excursion(x0, held(nominal + REFERENCE_DISTANCE_FACTOR * displacement(ocp, x0, nominal, way), ocp.N))
    regular = regular_at(ocp)
    scale_g = rti.scale_g
    for bounds, outward in ((ocp.tightest("lg")[: ocp.ng_path], -START_EXCESS_SCALES), (ocp.tightest("ug")[: ocp.ng_path], START_EXCESS_SCALES)):
        for j in np.flatnonzero(np.isfinite(bounds)):
            starts = (start_at(rti, x0, int(j), bounds[j] + share * outward * scale_g[j]) for share in SHARES)
            yield Excursion(next((x for x in starts if regular(x)), x0), held(nominal, ocp.N))


def outputs(ocp: Ocp, x: Array, u: Array) -> Array:
    """Return the outputs at nodes 1 to N under a constant input, shape ``(N, ny)``; fewer rows, at least that of node 0, where the model ends."""
    phi, h, p = ocp.phi(), ocp.model.outputs_at(), np.array(ocp.model.p_nominal)
    rows = [np.array(h(x, u, p)).ravel()]
    for _ in range(ocp.N):
        x = np.array(phi(x, u, p)).ravel()
        rows.append(np.array(h(x, u, p)).ravel())
        if not np.isfinite([*x, *rows[-1]]).all():
            return np.array(rows[1:-1] or rows[:1])
    return np.array(rows[1:])


def displacement(ocp: Ocp, x0: Array, nominal: Array, way: Array) -> Array:
    """Return how far the outputs are driven by inputs a `way`, shape ``(nu,)``, from rest; by a share of it, extrapolated, where the model ends."""
    for share in SHARES:
        driven = outputs(ocp, x0, ocp.model.u_rest + share * way)
        if len(driven) >= len(nominal):
            return np.asarray(driven[: len(nominal)] - nominal) / share
    return np.zeros_like(nominal)


def held(rows: Array, N: int) -> Array:
    """Return N rows, the last one held."""
    return rows[np.minimum(np.arange(N), len(rows) - 1)]


def regular_at(ocp: Ocp) -> Callable[[Array], bool]:
    """Build whether a stage from a state, shape ``(nx,)``, its inputs at rest, is finite and differentiable."""
    model, phi = ocp.model, ocp.phi()
    values = ca.vertcat(phi(model.x, model.u, model.p), model.y_expr, ocp.h_expr)
    stage = ca.Function("stage", [model.x, model.u, model.p], [values, ca.jacobian(values, ca.vertcat(model.x, model.u))])
    return lambda x: all(np.isfinite(np.array(part)).all() for part in stage(x, model.u_rest, model.p_nominal))


def start_at(rti: Rti, x0: Array, j: int, wanted: float) -> Array:
    """Return the state nearest to `x0`, in scales, at which the j-th softly bounded quantity is `wanted`; approximate, by Newton's method."""
    ocp = rti.ocp
    model = ocp.model
    g = ca.vertcat(model.x[list(ocp.soft), 0], ocp.h_expr)[j]
    value = ca.Function("value", [model.x, model.u, model.p], [g, ca.densify(ca.gradient(g, model.x))])
    squares = rti.scale_x**2
    x = x0.copy()
    for _ in range(NEWTON_STEPS):
        now, slope = (np.array(part).ravel() for part in value(x, model.u_rest, model.p_nominal))
        curvature = float(squares @ slope**2)
        if curvature <= 0.0 or not np.isfinite(curvature):
            return x0
        x = x + squares * slope * (wanted - float(now[0])) / curvature
    model.rotations("states").normalize(x)
    return x
