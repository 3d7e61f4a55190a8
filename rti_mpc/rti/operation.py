# SPDX-License-Identifier: Apache-2.0
"""
States of operation: where a robot is driven, as far as its bounds tell, and how fast its states change there.

Rest is judged from them: what stands still is a share of how fast a state changes in
operation, and a stop must succeed wherever a robot may be when it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.model.model import Model
from rti_mpc.rti.ocp import Ocp

SEEDED = 6  # combinations of bounds, beside those where all are low or all high
UNBOUNDED = 1.0  # where there is no bound: the distance from rest that is tried, in the unit of the state or input


def states_of_operation(ocp: Ocp, count: int, seed: int = 1) -> tuple[Array, Array]:
    """
    Return states inside the bounds and the inputs that act there: corners of the bounds first, then seeded ones.

    Args:
        ocp: The problem whose bounds they are.
        count: How many, two or more.
        seed: Seed of all that is random.

    Returns:
        States, shape ``(count, nx)``, and inputs, shape ``(count, nu)``.
    """
    model, rng = ocp.model, np.random.default_rng(seed)
    lowest, highest = around(ocp.lbx, ocp.ubx, np.array(model.x_nominal or np.zeros(model.nx)))
    low_u, high_u = around(ocp.lbu, ocp.ubu, np.array(model.u_rest))
    ends = np.concatenate([lowest, low_u]), np.concatenate([highest, high_u])
    found = np.array([*corners(*ends, rng, count // 4), *rng.uniform(*ends, size=(count - count // 4 - 2, model.nx + model.nu))])
    return found[:, : model.nx], found[:, model.nx :]


def derivative(model: Model) -> Callable[[Array, Array], Array]:
    """Build the rates of the states, shape ``(nx,)``."""
    f = ca.Function("f", [model.x, model.u, model.p], [ca.densify(model.f_expl_expr)])
    return lambda x, u: np.array(f(x, u, model.p_nominal)).ravel()


def around(lower: Array, upper: Array, middle: Array) -> tuple[Array, Array]:
    """Return bounds, and where there are none `UNBOUNDED` to that side of a middle; each of shape ``(n,)``."""
    lowest = np.where(np.isfinite(lower), lower, np.minimum(middle, upper) - UNBOUNDED)
    return lowest, np.where(np.isfinite(upper), upper, np.maximum(middle, lower) + UNBOUNDED)


def corners(lowest: Array, highest: Array, rng: np.random.Generator, seeded: int = SEEDED) -> Iterator[Array]:
    """Yield combinations of bounds, each of shape ``(n,)``: all low, all high, and seeded ones."""
    yield lowest
    yield highest
    for _ in range(seeded):
        yield np.where(rng.random(len(lowest)) < 0.5, lowest, highest)
