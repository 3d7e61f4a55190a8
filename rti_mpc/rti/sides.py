# SPDX-License-Identifier: Apache-2.0
r"""
Sides of the bounds of an OCP, and what a step of the interior point makes of each.

A *side* is a lower or an upper bound of a row. It has a distance t from its bound and a
multiplier :math:`\lambda`. One of a softened row also has a slack s and the multiplier
:math:`\nu` of its :math:`s \ge 0`. Linearized, the products :math:`t \lambda` and
:math:`s \nu` are eliminated side by side. This leaves a weight and a pull on the row.

Distances and slacks are relative to the scale of what is bounded; multipliers are in
normalised cost per scale.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import NamedTuple

import casadi as ca
import numpy as np

from rti_mpc.rti.elementwise import elementwise
from rti_mpc.rti.linearization import Forms, Linearization, along_rows
from rti_mpc.rti.ocp import Ocp

START_DISTANCE = 1.0  # least distance from a hard bound at the start
OF_BOUND = "per_scale", "room", "z", "Z"  # what stays the same from step to step, the latter two of softened sides alone


class Point(NamedTuple):
    """Numbers of a side, or their steps: distance, multiplier, and of a softened one slack and multiplier of the slack, zero otherwise."""

    t: ca.SX
    lam: ca.SX
    s: ca.SX
    nu: ca.SX

    @classmethod
    def symbols(cls, prefix: str, softened: bool) -> Point:
        """Return symbols with the names of the fields; a hard side has no slack."""
        return cls(*(ca.SX.sym(f"{prefix}{name}") if softened or name in ("t", "lam") else ca.SX(0) for name in cls._fields))

    def named(self, prefix: str, softened: bool) -> dict[str, ca.SX]:
        """Return by name what a side has."""
        return {f"{prefix}{name}": number for name, number in zip(self._fields[: 4 if softened else 2], self, strict=False)}

    @property
    def product(self) -> ca.SX:
        """Sum of the products of distance and slack with their multipliers."""
        return self.t * self.lam + self.s * self.nu


START, CENTRE, LENGTH = (ca.SX.sym(name) for name in ("start", "centre", "length"))  # the same for all sides


class Side:
    """
    One side, in single numbers.

    Attributes:
        now: The iterate; `per`, one over each of its numbers.
        affine: Step of the predictor; `by`, that of the corrector.
        per_curvature: One over `curvature`.
        per_scale: One over the scale of the row, negative for a lower side.
        room: Distance of the guess from the bound, negative where it is exceeded.
        z: Linear penalty on the slack; `Z`, the quadratic one.
        d: Deviation of the row at the iterate, in its unit; `change`, its step.
        stiff: Weight of the distance; `stiff_slack`, of the slack.
    """

    def __init__(self, softened: bool) -> None:
        self.softened = softened
        self.now, self.per, self.affine, self.by = (Point.symbols(prefix, softened) for prefix in ("", "per_", "affine_", "by_"))
        self.per_curvature, self.z, self.Z = (ca.SX.sym(name) if softened else ca.SX(0) for name in ("per_curvature", "z", "Z"))
        self.per_scale, self.room, self.d, self.change = (ca.SX.sym(name) for name in ("per_scale", "room", "d", "change"))
        self.stiff, self.stiff_slack = self.now.lam * self.per.t, self.now.nu * self.per.s
        self.slope = self.z + self.Z * self.now.s
        self._share = self.stiff * self.per_curvature  # of a push on a softened side that its slack takes
        self._residual = self.now.t - self.distance - self.now.s

    @property
    def distance(self) -> ca.SX:
        """Distance of the row from the bound, negative where it is exceeded."""
        return self.room - self.per_scale * self.d

    def started(self, start: ca.SX) -> Point:
        """Return where the iteration starts; see `enter`."""
        room = self.distance
        if not self.softened:
            t = ca.fmax(room, START_DISTANCE)
            return Point(t, start / t, ca.SX(0), ca.SX(0))
        exceeded = ca.fmax(-room, 0)
        slope = self.z + self.Z * exceeded
        push = 2 * start / (slope + ca.sqrt(slope**2 + 4 * self.Z * start))  # with which (slope + Z push) push = start
        t, s = ca.fmax(room, 0) + push, exceeded + push
        share = (self.z + self.Z * s) / (t + s)
        return Point(t, share * s, s, share * t)

    @property
    def inverses(self) -> dict[str, ca.SX]:
        """What is divided by, once, because divisions take longest."""
        return Point(*(1 / number for number in self.now)).named("per_", self.softened)

    @property
    def curvature(self) -> ca.SX:
        """Second derivative in the slack, the multipliers eliminated."""
        return self.Z + self.stiff + self.stiff_slack

    @property
    def weight(self) -> ca.SX:
        """Weight on half the square of the row, the slack eliminated."""
        return self.per_scale**2 * (self._share * (self.Z + self.stiff_slack) if self.softened else self.stiff)

    @property
    def pull(self) -> ca.SX:
        """Pull on the row at d, the slack eliminated."""
        return self._pushed(self.stiff * self._residual, -self.slope)

    def correction(self, product_t: ca.SX, product_s: ca.SX) -> ca.SX:
        """Return the further pull with which the linearized products have these values."""
        return self._pushed(product_t * self.per.t, product_s * self.per.s)

    def _pushed(self, wanted: ca.SX, slack: ca.SX) -> ca.SX:
        """Return the pull on the row of a multiplier and of what acts on the slack."""
        return self.per_scale * (wanted - self._share * (wanted + slack))

    def toward(self, product_t: ca.SX, product_s: ca.SX) -> Point:
        """Return the step with which the row changes by `change`, and the linearized products have these values after it."""
        nearer = self._residual + self.per_scale * self.change
        wanted_t, wanted_s = product_t * self.per.t, product_s * self.per.s
        s = self.per_curvature * (self.stiff * nearer + wanted_t + wanted_s - self.slope)
        t = s - nearer
        return Point(t, wanted_t - self.now.lam - self.stiff * t, s, wanted_s - self.now.nu - self.stiff_slack * s)

    def moved(self, by: Point, length: ca.SX) -> Point:
        """Return the numbers after a step."""
        return Point(*(number + length * change for number, change in zip(self.now, by, strict=True)))

    def steps(self, prefix: str, by: Point) -> dict[str, ca.SX]:
        """Return a step, and the largest share of a number that it takes away, by name."""
        shares = [-change * per for change, per in zip(by, self.per, strict=True) if not per.is_zero()]
        return by.named(prefix, self.softened) | {"shrinking": reduce(ca.fmax, shares)}

    @property
    def centred(self) -> tuple[ca.SX, ca.SX]:
        """The products that the corrector aims at, less what the predictor neglects."""
        return CENTRE - self.affine.t * self.affine.lam, CENTRE - self.affine.s * self.affine.nu

    def ends(self, after: Point) -> dict[str, ca.SX]:
        """Return what a step leads to, by name: its numbers, and what a roll-out finds as well."""
        acts, sign = after.t < after.lam, 1 - 2 * (self.per_scale < 0)
        found = {"place": sign * acts * (1 + (after.nu < after.s) if self.softened else 1), "multiplier": self.per_scale * after.lam}
        exceeded = {"exceeded": -self.distance / ca.fabs(self.per_scale), "exceeded_share": -self.distance} if self.softened else {}
        return after.named("after_", self.softened) | {"product": after.product} | found | exceeded


class Sides:
    """
    All sides of a kind, hard or softened.

    Attributes:
        side: One of them.
        rows: The row of each, in the order of the places.
        signs: -1 of a lower side, 1 of an upper one.
        known: Numbers of all of them, by name.
    """

    def __init__(self, softened: bool, sides: Sequence[tuple[int, float]]) -> None:
        self.side, self.rows, self.signs = Side(softened), [row for row, _ in sides], [sign for _, sign in sides]
        self.known: dict[str, ca.MX] = {}

    def fields(self, names: Sequence[str]) -> Sequence[str]:
        """Return those of four names that a hard side has as well, or all: of the row, and of its slack."""
        return names if self.side.softened else names[:2]

    def find(self, name: str, outputs: Mapping[str, ca.SX], **shared: ca.MX) -> None:
        """Evaluate expressions of one side for all of them; what is shared has the same value for each."""
        symbols = {symbol.name(): symbol for symbol in ca.symvar(ca.veccat(*outputs.values()))}
        of_all = elementwise(f"{name}_{'softened' if self.side.softened else 'hard'}", symbols, outputs, len(self.rows), shared=shared)
        self.known |= of_all(**{symbol: shared[symbol] if symbol in shared else self.known[symbol] for symbol in symbols})


class Inequalities:
    """
    The inequalities of an OCP: the sides of all its bounds.

    Attributes:
        hard: Sides of the bounds on inputs and increments; `softened`, of the softened ones; `kinds`, both.
        products: Number of products of a distance or a slack with its multiplier; `size`, of the numbers in them.
    """

    def __init__(self, ocp: Ocp) -> None:
        N, N_u = ocp.N, ocp.N_u
        first = 2 * N_u * ocp.model.nu  # row with a softened bound
        tables = (ocp.lbu, ocp.lbdu, ocp.lg), (ocp.ubu, ocp.ubdu, ocp.ug)
        rows_of = [[np.broadcast_to(of, (n, of.shape[-1])).ravel() for of, n in zip(table, (N_u, N_u, N), strict=True)] for table in tables]
        finite = [np.flatnonzero(np.isfinite(np.concatenate(rows))).tolist() for rows in rows_of]
        sides = [(row, sign) for sign, rows in zip((-1.0, 1.0), finite, strict=True) for row in rows]
        hard, softened = ([side for side in sides if (side[0] >= first) is kind] for kind in (False, True))
        self.hard, self.softened = self.kinds = Sides(False, hard), Sides(True, softened)
        self.products = len(hard) + 2 * len(softened)
        self.size = 2 * self.products
        number = {side: count for count, side in enumerate(hard + softened)}
        rows = range(first + ocp.ng * N)
        self._lower, self._upper = ([number.get((row, sign), len(sides)) for row in rows] for sign in (-1.0, 1.0))  # beyond them: none

    def take(self, name: str, rows: ca.MX) -> None:
        """Take a number of each row for its sides."""
        for kind in self.kinds:
            kind.known[name] = rows[kind.rows]

    def find(self, name: str, outputs: Callable[[Side], Mapping[str, ca.SX]], **shared: ca.MX) -> None:
        """Evaluate expressions of one side for all of both kinds."""
        for kind in self.kinds:
            kind.find(name, outputs(kind.side), **shared)

    def all(self, name: str) -> ca.MX:
        """Return a number of all sides."""
        return ca.vertcat(*(kind.known[name] for kind in self.kinds))

    def onto(self, name: str) -> ca.MX:
        """Return the sum over the sides of each row."""
        padded = ca.vertcat(self.all(name), ca.MX.zeros(2))  # of a scalar, CasADi would make a row
        return padded[self._lower] + padded[self._upper]

    def pack(self, names: Sequence[str]) -> ca.MX:
        """Return numbers of all sides in one column."""
        return ca.vertcat(*(kind.known[name] for kind in self.kinds for name in kind.fields(names)))

    def unpack(self, names: Sequence[str], column: ca.MX) -> None:
        """Take them from there."""
        at = 0
        for kind in self.kinds:
            for name in kind.fields(names):
                kind.known[name] = column[at : at + len(kind.rows)]
                at += len(kind.rows)

    def measure(self, ocp: Ocp, lin: Linearization, forms: Forms) -> None:
        """Find what stays the same from step to step."""
        w, zero = lin.w, ca.MX.zeros(lin.scale_u.shape)
        guess, scale = ca.veccat(lin.u, forms.increments, forms.g), along_rows(ocp, lin.scale_u, lin.scale_u, lin.scale_g)
        lower, upper = along_rows(ocp, w["lbu"], w["lbdu"], lin.lg), along_rows(ocp, w["ubu"], w["ubdu"], lin.ug)
        z, Z = (along_rows(ocp, zero, zero, weights) for weights in (lin.zg, lin.Zg))
        for kind in self.kinds:
            of, sign = kind.rows, ca.DM(kind.signs)
            per_scale, bound = sign / scale[of], ca.if_else(sign > 0, upper[of], lower[of])
            of_slack = z[of] * scale[of] / 2, Z[of] * scale[of] ** 2 / 2
            kind.known |= zip(kind.fields(OF_BOUND), (per_scale, per_scale * (bound - guess[of]), *of_slack), strict=False)
