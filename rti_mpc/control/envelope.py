# SPDX-License-Identifier: Apache-2.0
"""
Envelope of the inputs: the last check of every plan, whichever solver made it.

Bounds hold for each row, those of its stage, slew limits from row to row; the first two rows are also held
to what `rti_mpc.control.sent.Sent.reach` allows. The check needs no solver, and a plan
that is inside already passes unchanged.
"""

from __future__ import annotations

from math import isfinite

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled, function
from rti_mpc.rti.ocp import Ocp

INPUT_BOUNDS = ("lbu", "ubu", "lbdu", "ubdu")  # attributes of the Ocp


class Envelope:
    """
    Bounds and slew limits of the inputs.

    Attributes:
        limits: Bounds by the names in `INPUT_BOUNDS`, each of shape ``(nu,)``, the widest of all stages; may be overwritten, and hold from the next
            plan on.
        bounds: Those of a fresh plan, a row per block, ``(N_u, nu)``, where they differ from stage to stage; else the same arrays.
        written: The arrays that `fit` writes.
    """

    def __init__(self, ocp: Ocp, *, compile: bool) -> None:
        nu = ocp.model.nu
        self.limits = {name: ocp.widest(name) for name in INPUT_BOUNDS}
        by_stage = {name: np.array(getattr(ocp, name)) for name in INPUT_BOUNDS if getattr(ocp, name).ndim == 2}
        self.bounds = self.limits | by_stage
        self._u_rest: Array = np.array(ocp.model.u_rest)
        self._u: Array = np.zeros((ocp.N_u, nu))
        self._rows: Array = np.zeros((ocp.N, nu))
        self._reach: tuple[Array, Array] = (np.zeros((2, nu)), np.zeros((2, nu)))
        square: Array = np.zeros(1)  # of the plan
        self._square = square.data
        self.written = (self._u, *self._reach, self._rows, square)
        fit = clipping(ocp)
        inputs = {"u": self._u, "lowest": self._reach[0], "highest": self._reach[1], **self.bounds}
        self._fit = bind(compiled(fit)[0] if compile else fit, inputs, {"rows": self._rows, "square": square})

    @property
    def finite(self) -> bool:
        """Whether the plan that was fitted last was finite."""
        return isfinite(self._square[0])

    def take(self, name: str, bound: Array) -> None:
        """Take another bound of inputs, of the shape that it has in the problem."""
        self.bounds[name][...] = bound
        if bound.ndim == 2:
            self.limits[name][:] = (bound.min if name.startswith("l") else bound.max)(axis=0)

    def fit(self, u: Array, reach: tuple[Array, Array]) -> Array:
        """
        Bring a plan inside, each row as near to the planned one as the rows before it allow; what was not `finite` is inside, too, and no plan.

        Args:
            u: Inputs, shape ``(N_u, nu)``.
            reach: Lowest and highest first two rows, each of shape ``(2, nu)``.

        Returns:
            All `N` rows, inputs held over their blocks, shape ``(N, nu)``.
        """
        self._u[:] = u
        self._reach[0][:], self._reach[1][:] = reach
        self._fit()
        return self._rows.copy()

    def refit(self, rows: Array, elapsed: int, reach: tuple[Array, Array]) -> Array:
        """
        Bring an earlier plan inside again, without its first rows, whose time is over. Its rows keep the bounds of the stages they were planned for.

        Args:
            rows: Inputs of all stages, shape ``(N, nu)``; the last is repeated.
            elapsed: Rows to leave out.
            reach: Lowest and highest first two rows, each of shape ``(2, nu)``.
        """
        shifted = rows[np.minimum(np.arange(len(rows)) + elapsed, len(rows) - 1)]
        lower, upper = reach[0][0], reach[1][0]
        for k, row in enumerate(shifted):
            row[:] = np.clip(row, lower, upper)
            lower, upper = row + self.limits["lbdu"], row + self.limits["ubdu"]
            if k == 0:
                lower, upper = np.maximum(lower, reach[0][1]), np.minimum(upper, reach[1][1])
        return shifted

    def ramp(self, reach: tuple[Array, Array]) -> Array:
        """Return the brake law, shape ``(N, nu)``: from the inputs sent to rest, as fast as the slew limits allow; no measured speed enters."""
        return self.refit(np.tile(self._u_rest, (len(self._rows), 1)), 0, reach)


def clipping(ocp: Ocp) -> ca.Function:
    """Build ``(u, lowest, highest, *INPUT_BOUNDS) -> (rows, square)``, columns being stages; `square` is the sum of all u squared."""
    nu = ocp.model.nu
    u = ca.SX.sym("u", nu, ocp.N_u)
    lowest, highest = ca.SX.sym("lowest", nu, 2), ca.SX.sym("highest", nu, 2)
    bounds = {name: ca.SX.sym(name, *np.shape(getattr(ocp, name))[::-1]) for name in INPUT_BOUNDS}
    rows: list[ca.SX] = []
    for k, j in enumerate(ocp.held.tolist()):
        if k > 1 and ocp.starts[j] != k:
            rows.append(rows[-1])
            continue
        lbu, ubu, lbdu, ubdu = (bound[:, j] if bound.size2() > 1 else bound for bound in bounds.values())
        lower, upper = (rows[-1] + lbdu, rows[-1] + ubdu) if k else (lowest[:, 0], highest[:, 0])
        if k == 1:
            lower, upper = ca.fmax(lower, lowest[:, 1]), ca.fmin(upper, highest[:, 1])
        wanted = ca.fmin(ca.fmax(u[:, j], lbu), ubu)
        rows.append(ca.fmin(ca.fmax(wanted, lower), upper))
    inputs = {"u": u, "lowest": lowest, "highest": highest, **bounds}
    return function("clipping", inputs, {"rows": ca.densify(ca.horzcat(*rows)), "square": ca.sumsqr(u)})
