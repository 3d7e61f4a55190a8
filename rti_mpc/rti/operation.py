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
from rti_mpc.rti.nominal import model_and_derivatives, nominal_state
from rti_mpc.rti.ocp import Ocp
from rti_mpc.si import ones

SEEDED_CORNERS = 6  # combinations of bounds, beside those where all are low or all high
UNBOUNDED_DISTANCE = 1.0  # from the nominal state, or the input at rest, that is tried where there is no bound; in its SI unit
ROUNDING = 1e-9  # by which a number may exceed its bound, relative to the larger one of its two
MAX_DRAWS = 20  # of all states anew, where some are not regular


def states_of_operation(ocp: Ocp, count: int, seed: int = 1) -> tuple[Array, Array]:
    """
    Return states inside the bounds and the inputs that act there: corners of the bounds first, then seeded ones; only where the model is regular.

    Args:
        ocp: The problem whose bounds they are.
        count: How many, two or more; around the nominal state where there are no bounds.
        seed: Seed of all that is random.

    Returns:
        States, shape ``(count, nx)``, and inputs, shape ``(count, nu)``. The nominal state, at rest, stands in for those that were not found.
    """
    model, rng, is_regular = ocp.model, np.random.default_rng(seed), regular(ocp)
    attitudes = model.rotations("states")
    nominal, rest = nominal_state(ocp), np.array(model.u_rest)
    (lowest, highest), (low_u, high_u) = range_of_states(ocp, nominal), range_of_inputs(ocp)
    ends = np.concatenate([lowest, low_u]), np.concatenate([highest, high_u])
    found: list[Array] = []
    drawn = [*corners(*ends, rng, count // 4), *rng.uniform(*ends, size=(count - count // 4 - 2, model.nx + model.nu))]
    for _ in range(MAX_DRAWS):
        drawn = [attitudes.completed(z) for z in drawn]
        found += [z for z in drawn if inside(z, *ends) and is_regular(z[: model.nx], z[model.nx :])]
        if len(found) >= count:
            break
        drawn = list(rng.uniform(*ends, size=(count - len(found), model.nx + model.nu)))
    kept = np.array([*found, *[np.concatenate([nominal, rest])] * (count - len(found))])
    return kept[:, : model.nx], kept[:, model.nx :]


def regular(ocp: Ocp) -> Callable[[Array, Array], bool]:
    """Build whether the model is finite and differentiable at a state, shape ``(nx,)``, and an input, shape ``(nu,)``."""
    values = model_and_derivatives(ocp)
    return lambda x, u: bool(np.isfinite(np.array(values(x, u, ocp.model.p_nominal))).all())


def derivative(model: Model) -> Callable[[Array, Array], Array]:
    """Build the rates of the states, shape ``(nx,)``."""
    f = ca.Function("f", [model.x, model.u, model.p], [ca.densify(model.rate_expr)])
    return lambda x, u: np.array(f(x, u, model.p_nominal)).ravel()


def inside(z: Array, lowest: Array, highest: Array) -> bool:
    """Return whether a vector is inside bounds, all of shape ``(n,)``: an attitude may not be any more, once it has length 1."""
    rounding = ROUNDING * np.maximum(np.abs(lowest), np.abs(highest))
    return bool((z >= lowest - rounding).all() and (z <= highest + rounding).all())


def range_of_states(ocp: Ocp, nominal: Array) -> tuple[Array, Array]:
    """Return between which values states are driven around a nominal one, each of shape ``(nx,)``."""
    return around(ocp.widest("lbx"), ocp.widest("ubx"), nominal, ones(ocp.model.states))


def range_of_inputs(ocp: Ocp) -> tuple[Array, Array]:
    """Return between which values inputs drive the robot, each of shape ``(nu,)``."""
    return around(ocp.widest("lbu"), ocp.widest("ubu"), np.array(ocp.model.u_rest), ones(ocp.model.inputs))


def around(lower: Array, upper: Array, middle: Array, one: Array) -> tuple[Array, Array]:
    """Return bounds, and where there are none `UNBOUNDED_DISTANCE` of `one` SI unit to that side of a middle; each of shape ``(n,)``."""
    distance = UNBOUNDED_DISTANCE * one
    lowest = np.where(np.isfinite(lower), lower, np.minimum(middle, upper) - distance)
    return lowest, np.where(np.isfinite(upper), upper, np.maximum(middle, lower) + distance)


def corners(lowest: Array, highest: Array, rng: np.random.Generator, seeded: int = SEEDED_CORNERS) -> Iterator[Array]:
    """Yield combinations of bounds, each of shape ``(n,)``: all low, all high, and seeded ones."""
    yield lowest
    yield highest
    for _ in range(seeded):
        yield np.where(rng.random(len(lowest)) < 0.5, lowest, highest)
