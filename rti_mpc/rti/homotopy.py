# SPDX-License-Identifier: Apache-2.0
r"""
Homotopy of the parametric active-set method [Ferreau2008]_: from a QP whose solution is known to that of the sample.

A solution has a value and a multiplier for each bounded row. Both together are on a
curve of up to five *segments*, and the place of the row says on which: between its
bounds, where only the value is free; at a bound, where only the multiplier is, up to
the linear penalty of its slack; beyond a softened bound, where only the value is. So a
row is at one number, its *coordinate* on its segment.

Any point on the curves is the solution of some QP. On the line from the data of that QP
to those of the sample's, all coordinates move straight towards those that are rolled
out with the same places, until the first of them comes to the end of its segment. That
row goes on to the next segment, and the next roll-out gives the new direction: one
change of a place for each roll-out with its gains. As the QP is convex, the homotopy
ends. It begins at the guess.

Rows that come to their ends together change together, which is right as a rule. If they
then have to change again at once, some of them can be at their bounds only without the
others, and they would take turns for ever. So after a few moves without a way they
change one at a time, always the first of them [Bland1977]_.
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.codegen import BEFORE_BODY, function, function_in_c
from rti_mpc.rti.linearization import Linearization, along_rows
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.transcription import INFINITY

LIMITS = "lower", "upper", "most"  # names of what `limits` returns
MAX_STILL = 3  # moves in a row that lead nowhere; from then on one row changes at a time


def limits(ocp: Ocp, lin: Linearization) -> list[ca.MX]:
    """Return the lower and the upper bound of each row, and the largest multiplier that it has at one: half the linear penalty, as of the cost."""
    w, hard = lin.w, ca.MX(ca.DM.zeros(ocp.model.nu) + INFINITY)
    lower, upper = along_rows(ocp, w["lbu"], w["lbdu"], lin.lg), along_rows(ocp, w["ubu"], w["ubdu"], lin.ug)
    return [lower, upper, along_rows(ocp, hard, hard, lin.zg / 2)]


class BoundedRow:
    """
    Symbols of a row.

    Attributes:
        place: Its place; `found`, that which the roll-out has found.
        now: Its coordinate, a value, or the multiplier at its bound; `target`, that of the roll-out with its place.
        symbols: These, and the row's `limits`.
        held: Whether it is at its bound.
        bound: The bound from which, or to which, it goes.
        most: Its largest multiplier.
    """

    def __init__(self) -> None:
        names = ("place", "found", "now", "target", "lower", "upper", "most")
        self.symbols = [ca.SX.sym(name) for name in names]
        self.place, self.found, self.now, self.target, self.lower, self.upper, self.most = self.symbols
        self.held = ca.fabs(self.place) == 1
        self.bound = ca.if_else(self.place + self.found > 0, self.upper, self.lower)

    @property
    def start(self) -> ca.SX:
        """
        The coordinate at which a row begins.

        That is its guess, `now`, on its segment. A multiplier outside it begins inside: as large with the other sign, or at half of the largest one.
        Otherwise all rows that change would do so at the very beginning, in an arbitrary order.
        """
        beyond = ca.if_else(self.place > 0, ca.fmax(self.now, self.upper), ca.fmin(self.now, self.lower))
        inside = ca.if_else(self.target > self.most, self.most / 2, ca.fmin(ca.fabs(self.target), self.most))
        return ca.if_else(self.held, inside, ca.if_else(self.place == 0, ca.fmax(self.lower, ca.fmin(self.now, self.upper)), beyond))

    @property
    def share(self) -> ca.SX:
        """The share of the way to its target after which it comes to the end of its segment."""
        end = ca.if_else(self.held, ca.if_else(self.found == 0, 0, self.most), self.bound)
        return ca.if_else(self.found == self.place, INFINITY, ca.fmax((end - self.now) / (self.target - self.now), 0))

    def after(self, changes: ca.SX, least: ca.SX) -> list[ca.SX]:
        """Return place and coordinate after the least share of all rows, where the row changes or not."""
        first = ca.if_else(ca.fabs(self.found) == 1, ca.if_else(self.place == 0, 0, self.most), self.bound)
        return [ca.if_else(changes, self.found, self.place), ca.if_else(changes, first, self.now + least * (self.target - self.now))]


def begin(ocp: Ocp, lin: Linearization, stages: ca.MX) -> ca.Function:
    """
    Build ``(u, stages, *ARGUMENTS, scale, places, targets) -> (point, still, lower, upper, most)``.

    That is where the homotopy begins, from the guess and a roll-out with places, no moves without a way, and the `limits` of its rows.
    """
    row, forms = BoundedRow(), lin.forms_in(stages)
    guess = ca.veccat(lin.u, forms.increments, forms.g)
    given, of_rows = {name: ca.MX.sym(name, guess.numel()) for name in ("places", "targets")}, limits(ocp, lin)
    start = ca.Function("start", [row.place, row.now, row.target, row.lower, row.upper, row.most], [row.start]).map(guess.numel())
    point = start(*(of.T for of in (given["places"], guess, given["targets"], *of_rows))).T
    found = {"point": point, "still": ca.MX(0), **dict(zip(LIMITS, of_rows, strict=True))}
    return function("begin", {"u": lin.u, "stages": stages, **lin.weights, **given}, found)


# The same as `BoundedRow`, without the division for rows that do not change.
SHARE = """
static casadi_real share_of(casadi_real place, casadi_real found, casadi_real now, casadi_real target, casadi_real bound, casadi_real most) {
  const casadi_real end = fabs(place) != 1 ? bound : found == 0 ? 0 : most;
  const casadi_real share = (end - now) / (target - now);
  return share > 0 ? share : 0;
}
"""
MOVE = """
  const casadi_real *place = arg[0], *found = arg[1], *point = arg[2], *target = arg[3], *lower = arg[4], *upper = arg[5], *most = arg[6];
  const casadi_real still = arg[7][0];
  casadi_real least = 1;
  casadi_int i, changed = 0;
  for (i = 0; i < ROWS; ++i) {
    if (found[i] != place[i]) {
      const casadi_real bound = place[i] + found[i] > 0 ? upper[i] : lower[i];
      const casadi_real share = share_of(place[i], found[i], point[i], target[i], bound, most[i]);
      if (share < least) least = share;
    }
  }
  for (i = 0; i < ROWS; ++i) {  /* a row is read before it is written: results may share the memory of arguments */
    const casadi_real of = place[i], to = found[i], now = point[i], bound = of + to > 0 ? upper[i] : lower[i];
    const casadi_int together = still < MAX_STILL || !changed;
    if (of != to && together && share_of(of, to, now, target[i], bound, most[i]) == least) {
      changed = 1;
      res[0][i] = to;
      res[1][i] = fabs(to) != 1 ? bound : of == 0 ? 0 : most[i];
    } else {
      res[0][i] = of;
      res[1][i] = now + least * (target[i] - now);
    }
  }
  res[2][0] = least > 0 ? 0 : still + 1;
  return 0;
"""


def move(size: int) -> ca.Function:
    """
    Build ``(places, places_found, point, targets, lower, upper, most, still) -> (places_next, point_next, still_next)``.

    The way to the first change of a place. `still` is the number of moves before it that led nowhere. Compiled, the results may be in the memory of
    places, point and still.

    Args:
        size: Number of rows.
    """
    row = BoundedRow()
    names = "places", "places_found", "point", "targets", *LIMITS
    given, still = {name: ca.MX.sym(name, size) for name in names}, ca.MX.sym("still")
    of_rows = [of.T for of in given.values()]
    shares = ca.Function("share", row.symbols, [row.share]).map(size)(*of_rows)
    least, index = ca.fmin(ca.mmin(shares), 1), ca.DM(range(size)).T
    at_end = shares == least
    first = ca.mmin(size + at_end * (index - size))
    changes = ca.logic_and(at_end, ca.logic_or(still < MAX_STILL, index == first))
    symbols = [ca.SX.sym(name) for name in ("changes", "least")]
    after = ca.Function("after", [*row.symbols, *symbols], row.after(*symbols)).map(size)
    places, point = after(*of_rows, changes, ca.repmat(least, 1, size))
    body = f"{SHARE}{BEFORE_BODY}enum {{ ROWS = {size}, MAX_STILL = {MAX_STILL} }};{MOVE}"
    results = {"places_next": places.T, "point_next": point.T, "still_next": ca.if_else(least > 0, 0, still + 1)}
    return function_in_c("move", given | {"still": still}, results, body)
