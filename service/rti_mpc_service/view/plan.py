# SPDX-License-Identifier: Apache-2.0
"""Facts about a plan from the messages alone: what its cost (4) is made of, and which bounds act in it."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.contract.message import Telemetry
from rti_mpc.si import ones
from rti_mpc.wire.info import Info
from rti_mpc_service.acting import at_bounds, unit

FREE, LATER = "free", " later"
LEVELS, RATES, TOUCHED = ("lower", "upper"), ("falls", "rises"), "touched"
SIDES = (*LEVELS, *RATES)
NOW = (TOUCHED, *(", ".join(some) for count in range(1, 5) for some in combinations(SIDES, count)))  # what may act at the first stage
ACTING = (*NOW, *(f"{words}{LATER}" for words in NOW))


def is_plan(sample: Telemetry) -> bool:
    """Whether a sample has a plan of its own."""
    return sample.mode.planned and 0 < len(sample.u) == len(sample.y_ref) == len(sample.x) - 1


def cost_terms(info: Info, sample: Telemetry, u_before: Array | None) -> dict[str, float]:
    r"""
    Split the cost of a plan.

    Args:
        info: Description with weights and with the state that each output is.
        sample: With a plan of its own.
        u_before: Inputs that acted before the plan, shape ``(nu,)``; None: not known.

    Returns:
        ``error/NAME`` of each output that is a state, :math:`\sum_i \delta_i e_i (Q e)_i`; ``changes/NAME`` of each input, likewise
        with :math:`\lambda`, R and the increments; and ``rest``: what remains of the cost, which is that of softened bounds, the
        terminal weight, inputs themselves and other outputs. Empty without weights.
    """
    if info.weights is None or len(info.weights.delta) != (N := len(sample.u)) or len(info.weights.lambda_) > N:
        return {}
    w = info.weights
    outputs, states = ([pair[k] for pair in info.tracked] for k in (0, 1))
    error = np.zeros((N, len(info.outputs)))
    error[:, outputs] = sample.x[1:, states] - sample.y_ref[:, outputs]
    change = np.diff(sample.u, axis=0, prepend=sample.u[:1] if u_before is None else u_before[None])
    lambda_ = np.array(w.lambda_).reshape(len(w.lambda_), -1)
    lambda_ = np.resize(lambda_, (N, lambda_.shape[1]))  # no input changes after the control horizon
    error, change = np.sqrt(np.array(w.delta)).reshape(N, -1) * error, np.sqrt(lambda_) * change
    by_output = (error * (error @ np.array(w.Q))).sum(axis=0)
    by_input = (change * (change @ np.array(w.R))).sum(axis=0)
    terms = {f"error/{info.outputs[i].name}": float(by_output[i]) for i in outputs}
    terms |= {f"changes/{label.name}": float(value) for label, value in zip(info.inputs, by_input, strict=True)}
    return {**terms, "rest": sample.cost - sum(terms.values())}


def acting_bounds(info: Info, sample: Telemetry, u_before: Array | None, discs: tuple[Array, ...] = ()) -> dict[str, str]:
    """
    Say which bounds a plan touches.

    Args:
        info: Description with the bounds.
        sample: With a plan of its own.
        u_before: Inputs that acted before the plan, shape ``(nu,)``; None: not known.
        discs: Distance of the position to the edge of each obstacle at nodes 1 to N, each of shape ``(N,)``, in m.

    Returns:
        By name of every bounded signal, and of every obstacle: the sides that act at the first stage; else those that act at a later one,
        followed by `LATER`; else `FREE`.
    """
    rates = np.diff(sample.u, axis=0, prepend=sample.u[:1] if u_before is None else u_before[None])
    along: dict[str, list[tuple[str, NDArray[np.bool_]]]] = {}
    # Descriptions of controllers that do not tell scales yet are in recordings.
    scale_x = info.scale_x or tuple(map(unit, info.lbx, info.ubx, ones(info.states)))
    scale_u = info.scale_u or tuple(map(unit, info.lbu, info.ubu, ones(info.inputs)))
    for labels, values, lower, upper, sides, scale in (
        (info.states, sample.x[1:], info.lbx, info.ubx, LEVELS, scale_x),
        (info.inputs, sample.u, info.lbu, info.ubu, LEVELS, scale_u),
        (info.inputs, rates, info.lbdu, info.ubdu, RATES, scale_u),
    ):
        for j, label in enumerate(labels):
            bounds = lower[j], upper[j]
            acting = zip(sides, bounds, at_bounds(values[:, j], *bounds, scale[j]), strict=True)
            along.setdefault(label.name, []).extend((side, acts) for side, bound, acts in acting if np.isfinite(bound))
    of_discs = unit(0.0, np.inf) if info.position is None or not info.scale_x else max(info.scale_x[j] for j in info.position)
    for i, away in enumerate(discs):
        along[f"obstacle_{i}"] = [(TOUCHED, at_bounds(away, 0.0, np.inf, of_discs)[0])]
    return {name: _said(sides) for name, sides in along.items() if sides}


def _said(sides: list[tuple[str, NDArray[np.bool_]]]) -> str:
    now = ", ".join(side for side, acts in sides if acts[0])
    later = ", ".join(side for side, acts in sides if acts.any())
    return now or (later and later + LATER) or FREE
