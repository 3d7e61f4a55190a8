# SPDX-License-Identifier: Apache-2.0
r"""
Acceleration of the iterations within a sample, by the long step of [Barzilai1988]_.

Gauss-Newton neglects curvature, so its steps do not shrink quadratically but by a
factor: along an obstacle, whose curvature they overestimate, each is two thirds of the
one before. From two steps follow the factor, and with it the sum of all steps that would
come. The next guess is extrapolated beyond the plan by this sum. For steps in one
direction that is Aitken's formula.
"""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from rti_mpc.array import copy, memories
from rti_mpc.codegen import bind, function
from rti_mpc.rti.blocks import at_each
from rti_mpc.rti.linearization import linearization
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.qp import Guess

MIN_RELAXATION = 1.5  # that is worth it: below, each step is less than a third of the one before
MAX_RELAXATION = 4.0  # for steps of three quarters of the one before, and more
LARGE_STEP = 0.25  # of an input, in half ranges: after such a step, as from a cold start, the factor means nothing yet
BOUNDS = "lbx", "ubx", "lbu", "ubu"


def relaxation(ocp: Ocp) -> ca.Function:
    r"""
    Build ``(x, u, x_plan, u_plan, step, omega, lbx, ubx, lbu, ubu, scale) -> (x_next, u_next, step_next, omega_next)``: the guess after a plan.

    With the step :math:`s` from guess to plan in the inputs, in half ranges, and the step :math:`s_-` of the iteration before and its relaxation
    :math:`\omega_-`, which are `step` and `omega`,

    .. math::

        \omega = \frac{\omega_- \, s_-^T s_-}{s_-^T (s_- - s)}, \qquad x_{next} = x + \omega \, (x_{plan} - x),

    likewise the inputs. It is at most `MAX_RELAXATION`, also where steps grow. It is 1 instead of less than `MIN_RELAXATION`, after a `LARGE_STEP`,
    and if there was no step before, which is then 0: the guess is the plan. No guess is ahead of its plan beyond `lbx`, `ubx`, `lbu` or `ubu`,
    where the model may not be defined. Results may be in the memory of the guess, the step and its relaxation.
    """
    lin = linearization(ocp)
    bounds = {name: lin.w[name] for name in BOUNDS}
    x, u, step = ca.MX.sym("x_plan", *lin.x.shape), ca.MX.sym("u_plan", *lin.u.shape), ca.MX.sym("step", *lin.u.shape)
    omega = ca.MX.sym("omega")
    step_next = (u - lin.u) / ca.repmat(lin.scale_u, 1, ocp.N_u)
    square = ca.dot(step, step)
    rest = square - ca.dot(step, step_next)
    omega_next = ca.if_else(MAX_RELAXATION * rest > omega * square, omega * square / rest, MAX_RELAXATION)
    near = ca.logic_and(square > 0, ca.mmax(ca.fabs(step_next)) < LARGE_STEP)
    omega_next = ca.if_else(ca.logic_and(near, omega_next > MIN_RELAXATION), omega_next, 1)

    def ahead(plan: ca.MX, guess: ca.MX, of: str) -> ca.MX:
        lower, upper = (at_each(bounds[bound + of], plan.shape[1]) for bound in ("lb", "ub"))
        return ca.fmax(ca.fmin(plan, lower), ca.fmin(ca.fmax(plan, upper), plan + (omega_next - 1) * (plan - guess)))

    x_next = ca.horzcat(x[:, 0], ahead(x[:, 1:], lin.x[:, 1:], "x"))
    given = {"x": lin.x, "u": lin.u, "x_plan": x, "u_plan": u, "step": step, "omega": omega, **bounds, "scale": lin.weights["scale"]}
    found = {"x_next": x_next, "u_next": ahead(u, lin.u, "u"), "step_next": step_next, "omega_next": omega_next}
    return function("relaxation", given, found)


class Acceleration:
    """
    The guesses of a sample after its first one.

    Args:
        built: See `relaxation`.
        guess: Arrays of guess and plan.
        make: Returns a function compiled.
    """

    def __init__(self, built: ca.Function, guess: Guess, make: Callable[[ca.Function], ca.Function]) -> None:
        x, u, plan = guess.sample["x"], guess.sample["u"], guess.plan
        self._step, self._omega = np.zeros_like(u), np.ones(1)
        weights = {name: guess.weights[name] for name in (*BOUNDS, "scale")}
        given = {"x": x, "u": u, "x_plan": plan.x, "u_plan": plan.u, "step": self._step, "omega": self._omega, **weights}
        self._relax = bind(make(built), given, {"x_next": x, "u_next": u, "step_next": self._step, "omega_next": self._omega})
        self._plan = memories((np.zeros_like(array), array) for array in (plan.x, plan.u))

    def begin(self) -> None:
        """Begin a sample, whose second guess is the first plan."""
        self._step.fill(0.0)

    def advance(self) -> None:
        """Make the next guess, and keep the plan, which an iteration that fails must `restore`."""
        self._relax()
        copy(self._plan)

    def restore(self) -> None:
        """Take the plan before the guess back."""
        for kept, plan in self._plan:
            plan[:] = kept
