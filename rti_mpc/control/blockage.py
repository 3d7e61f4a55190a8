# SPDX-License-Identifier: Apache-2.0
r"""
Blockage: obstacles or other softened bounds hold the robot, and its plans find no way round.

A plan is blocked if something holds it and it makes no progress over the whole
horizon, compared with the distance to the reference that remains at its end,

.. math::

    \|y_N - y_0\|_Q < \epsilon \, \|y_{ref,N} - y_N\|_Q .

The weight of the cost makes this a ratio without a unit. A plan is held by a general
constraint that it touches, such as an obstacle's, or by the bound of a state that is an
output, if the plan ends there and the reference lies beyond. Any other bound may be
touched by standing alone, as v >= 0 is by a robot that cannot reverse. One such plan is
a robot that hesitates. The robot is blocked after N such plans in a row, N being the
horizon in stages, and free again after N plans in a row that are not blocked.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled, function
from rti_mpc.contract.message import Notice, Severity
from rti_mpc.rti.blocks import all_inputs
from rti_mpc.rti.linearization import constraints, scale_size
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import TOUCHING_DISTANCE, Rti

MIN_PROGRESS_RATIO = 0.05  # epsilon, without a unit: a plan that passes an obstacle stays above 1, a blocked one is near 0.001


class Blockage:
    """
    Judge of one plan after the other.

    Attributes:
        blocked: Whether the robot is blocked.
    """

    def __init__(self, rti: Rti, *, compile: bool = True) -> None:
        ocp, own = rti.problem, rti.ocp.h_expr.numel()  # second differences follow the constraints, and hold no robot
        self.blocked = False
        self._stages = ocp.N
        self._contrary = 0
        self._squares: Array = np.zeros(2)
        self._names = [ocp.model.states[j].name for _, j in bounded_outputs(ocp)] + [""] * own
        self._held: Array = np.zeros(len(self._names))
        sample = {"x": rti.guess.plan.x, "u": rti.u, "y_ref": rti.y_ref, "p": rti.guess.sample["p"], "scale": rti.scale}
        weights = {name: rti.guess.weights[name] for name in ("lbx", "ubx", "lh", "uh")}
        measure = progress(ocp, own)
        self._measure = bind(compiled(measure)[0] if compile else measure, sample | weights, {"squares": self._squares, "held": self._held})

    @property
    def cause(self) -> str:
        """What holds the plan that was looked at last, in words."""
        names = dict.fromkeys(name for name, held in zip(self._names, self._held, strict=True) if held > 0.0)
        beyond = ", ".join(name for name in names if name)
        reasons = (f"the reference lies beyond the bounds of {beyond}" if beyond else "", "an obstacle or constraint holds it" if "" in names else "")
        return " and ".join(filter(None, reasons))

    @property
    def notice(self) -> Notice:
        """What to say when `blocked` has changed."""
        if self.blocked:
            return Notice(Severity.WARNING, "blocked", f"the way is blocked: the plan stops short of the reference, {self.cause}")
        return Notice(Severity.INFO, "free", "the way is free again")

    def judge(self) -> bool:
        """Judge the plan of a new sample, and return whether `blocked` has changed."""
        self._measure()
        moved, left = self._squares.tolist()
        standing = moved < MIN_PROGRESS_RATIO**2 * left and any(held > 0.0 for held in self._held.tolist())
        self._contrary = self._contrary + 1 if standing is not self.blocked else 0
        if self._contrary < self._stages:
            return False
        self.blocked = standing
        self._contrary = 0
        return True

    def clear(self) -> None:
        """Forget everything, for another life of the robot."""
        self.blocked = False
        self._contrary = 0


def bounded_outputs(ocp: Ocp) -> list[tuple[int, int]]:
    """Return pairs of an output and the state that it is, by index, of those states that are bounded."""
    names = [state.name for state in ocp.model.states]
    pairs = [(i, names.index(name)) for i, name in enumerate(ocp.model.counterparts()["outputs"]) if name]
    return [(i, j) for i, j in pairs if j in ocp.soft]


def progress(ocp: Ocp, own: int) -> ca.Function:
    """
    Build ``(x, u, y_ref, p, scale, lbx, ubx, lh, uh) -> (squares, held)``.

    ``squares`` is ``[|y_N - y_0|^2, |y_ref,N - y_N|^2]``, both weighted by Q; ``held`` is above 0 where the plan is held: first the
    bounds of `bounded_outputs`, then the first `own` general constraints.
    """
    model, N, Q, nh = ocp.model, ocp.N, ca.DM(ocp.Q), ocp.h_expr.numel()
    x, u, y_ref = ca.MX.sym("x", model.nx, N + 1), ca.MX.sym("u", model.nu, ocp.N_u), ca.MX.sym("y_ref", model.ny, N)
    p, scale = ca.MX.sym("p", model.np_, N + 1), ca.MX.sym("scale", scale_size(ocp))
    bounds = {name: ca.MX.sym(name, *np.shape(getattr(ocp, name))[::-1]) for name in ("lbx", "ubx", "lh", "uh")}
    lbx, ubx = (bound if bound.size2() == 1 else bound[:, -1] for bound in (bounds["lbx"], bounds["ubx"]))  # those of the end
    lh, uh = bounds["lh"], bounds["uh"]
    output = model.h()
    start, end = output(x[:, 0], p[:, -1]), output(x[:, -1], p[:, -1])  # both outputs with the parameters of one time: a moving beacon is no progress
    moved, left = end - start, y_ref[:, -1] - end
    squares = ca.vertcat(ca.bilin(Q, moved, moved), ca.bilin(Q, left, left))
    held = [
        ca.fmax(
            ca.fmin(x[j, -1] - ubx[j] + TOUCHING_DISTANCE * scale[j], y_ref[i, -1] - ubx[j]),
            ca.fmin(lbx[j] - x[j, -1] + TOUCHING_DISTANCE * scale[j], lbx[j] - y_ref[i, -1]),
        )
        for i, j in bounded_outputs(ocp)
    ]
    if own:
        constraint, *_ = constraints(ocp)
        u_held = all_inputs(u, ocp.blocks)
        g = constraint.map(N)(x[:, 1:], u_held, p[:, 1:])[len(ocp.soft) : ocp.ng_path, :]
        near = TOUCHING_DISTANCE * scale[model.nx + model.nu + len(ocp.soft) :][:nh]
        held += [ca.mmax(ca.fmax(g[k, :] - uh[k, :], lh[k, :] - g[k, :])) + near[k] for k in range(own)]
    inputs = {"x": x, "u": u, "y_ref": y_ref, "p": p, "scale": scale, **bounds}
    return function("progress", inputs, {"squares": squares, "held": ca.densify(ca.vertcat(*held))})
