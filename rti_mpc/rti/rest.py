# SPDX-License-Identifier: Apache-2.0
r"""
Rest of a robot: a check that it comes to rest when its inputs do.

A stop commands the inputs at rest. That stops a robot that is driven by speeds. One
that is driven by accelerations coasts on, one that is driven by torques falls.
Which of them a model is, its own equations tell. From states of operation

.. math::

    \dot x = f(x, u_{rest}, p)

is integrated for a while; then every state must stand still, compared with how fast
it changes in operation. And the robot must stay wherever it has stopped: a state
whose derivative does not depend on itself, such as a position, a heading or a joint
angle, is displaced, and nothing may begin to move.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.model.model import Model
from rti_mpc.rti.ocp import Ocp

SETTLING_S = 10.0  # after which a robot must stand
DRIVEN_S = 2.0  # for which inputs at their bounds drive the robot, to see which states it gets into
STILL = 0.01  # of the rate in operation, below which a state stands still
SEEDED = 6  # states, and combinations of bounds, beside those where all are low or all high
UNBOUNDED = 1.0  # where there is no bound: the distance from rest that is tried, in the unit of the state or input

Motion = Callable[[Array, Array, float], Array]


def motion_at_rest(ocp: Ocp) -> str:
    """
    Return how a robot moves although its inputs are at rest, empty if it comes to rest and stays there.

    Args:
        ocp: Its model, and the bounds inside which it is operated.
    """
    model, rng = ocp.model, np.random.default_rng(1)
    u_rest: Array = np.array(model.u_rest)
    move, rate = motion(model), derivative(model)
    inputs = list(corners(*around(ocp.lbu, ocp.ubu, u_rest), rng))
    lowest, highest = around(ocp.lbx, ocp.ubx, np.zeros(model.nx))
    start = np.clip(0.0, ocp.lbx, ocp.ubx)
    states = [np.clip(move(start, u, DRIVEN_S), ocp.lbx, ocp.ubx) for u in inputs]
    states += [rng.uniform(lowest, highest) for _ in range(SEEDED)]
    states = [x for x in states if np.isfinite(x).all()]
    rates = np.abs([rate(x, u) for x in states for u in (*inputs, u_rest)])
    still = np.maximum(STILL * np.max(rates, axis=0, where=np.isfinite(rates), initial=0.0), 1e-9)
    positions = [j for j in range(model.nx) if not ca.depends_on(model.f_expl_expr[j], model.x[j])]
    ends = [move(x, u_rest, SETTLING_S) for x in states]
    for settled in ends:
        if moving := moves(model, rate(settled, u_rest), still):
            return f"{SETTLING_S:g} s after its inputs have come to rest {moving}"
    for settled in ends:
        for j in positions:
            aside = settled.copy()
            aside[j] += 0.5 * (highest[j] - lowest[j]) * rng.choice((-0.5, 0.5))
            if moving := moves(model, rate(aside, u_rest), still):
                return f"where it stands at {model.states[j].name} = {aside[j]:.3g} {model.states[j].unit}, its inputs at rest, {moving}"
    return ""


def moves(model: Model, rates: Array, still: Array) -> str:
    """Return which state moves fastest, compared with what is still, each of shape ``(nx,)``; empty if none does."""
    j = int(np.argmax(np.abs(np.where(np.isnan(rates), np.inf, rates)) / still))
    signal = model.states[j]
    return "" if abs(rates[j]) <= still[j] else f"{signal.name} changes by {rates[j]:.3g} {signal.unit} per second"


def motion(model: Model) -> Motion:
    """Build the state, shape ``(nx,)``, to which an input, shape ``(nu,)``, leads in a time in s; NaN where the model has none."""
    t = ca.SX.sym("t")  # as a parameter: of time 1, one integrator serves all
    dae = {"x": model.x, "p": ca.vertcat(model.u, model.p, t), "ode": t * model.f_expl_expr}
    integrate = ca.integrator("motion", "cvodes", dae, 0.0, 1.0, {"show_eval_warnings": False, "disable_internal_warnings": True})

    def move(x: Array, u: Array, span_s: float) -> Array:
        try:
            return np.array(integrate(x0=x, p=[*u, *model.p_nominal, span_s])["xf"]).ravel()
        except RuntimeError:  # it diverges
            return np.full(len(x), np.nan)

    return move


def derivative(model: Model) -> Callable[[Array, Array], Array]:
    """Build the rates of the states, shape ``(nx,)``."""
    f = ca.Function("f", [model.x, model.u, model.p], [ca.densify(model.f_expl_expr)])
    return lambda x, u: np.array(f(x, u, model.p_nominal)).ravel()


def around(lower: Array, upper: Array, middle: Array) -> tuple[Array, Array]:
    """Return bounds, and where there are none `UNBOUNDED` to that side of a middle; each of shape ``(n,)``."""
    lowest = np.where(np.isfinite(lower), lower, np.minimum(middle, upper) - UNBOUNDED)
    return lowest, np.where(np.isfinite(upper), upper, np.maximum(middle, lower) + UNBOUNDED)


def corners(lowest: Array, highest: Array, rng: np.random.Generator) -> Iterator[Array]:
    """Yield combinations of bounds, each of shape ``(n,)``."""
    yield lowest
    yield highest
    for _ in range(SEEDED):
        yield np.where(rng.random(len(lowest)) < 0.5, lowest, highest)
