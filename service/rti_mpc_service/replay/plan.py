# SPDX-License-Identifier: Apache-2.0
"""Facts about a plan before the next one is prepared: which bounds act, and what its cost is made of."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.approach import TOLERANCE_SHARE
from rti_mpc.rti.linearization import constraints, input_reference
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import COST_WEIGHTS, Rti
from rti_mpc_service.acting import at_bounds
from rti_mpc_service.config.schema import Config

FIRST = {"state": 1, "constraint": 1, "second difference": 0}  # node, or stage, from which on values are known; others are of the last node
SIDES = ("lower", "upper")


def acting_bounds(rti: Rti, config: Config) -> list[dict[str, Any]]:
    """
    Return the bounds that a plan touches, each with its name, its side, the stages at which it acts, and its value at each of them.

    Stages of inputs and increments begin at 0, which acts next; of inputs that are held the first one is named. Those of states and constraints
    begin at 1.
    """
    model, weights = rti.problem.model, rti.guess.weights
    increments = np.diff(rti.u, axis=0, prepend=rti.u_prev[None])
    found: list[dict[str, Any]] = []
    for kind, values, lower, upper in (("input", rti.u, "lbu", "ubu"), ("increment", increments, "lbdu", "ubdu")):
        for j, signal in enumerate(model.inputs):
            low, high = (np.broadcast_to(weights[name], values.shape)[:, j] for name in (lower, upper))
            for side, bound, acts in zip(SIDES, (low, high), at_bounds(values[:, j], low, high, rti.scale_u[j]), strict=True):
                found += _acting(kind, signal.name, signal.unit, side, bound[acts], rti.ocp.starts[acts], 0.0)
    for soft, scale in zip(softened(rti, config), rti.scale_g, strict=True):
        acting, over = at_bounds(soft.values, soft.lower, soft.upper, scale), (soft.lower - soft.values, soft.values - soft.upper)
        for side, bound, acts, beyond in zip(SIDES, (soft.lower, soft.upper), acting, over, strict=True):
            violation = most if (most := float(beyond.max())) > TOLERANCE_SHARE * scale else 0.0
            found += _acting(soft.kind, soft.name, soft.unit, side, bound[acts], soft.first + np.flatnonzero(acts), violation)
    return found


def _acting(kind: str, name: str, unit: str, side: str, bounds: Array, stages: Any, violation: float) -> Iterator[dict[str, Any]]:
    """Yield a bound if it acts at any stage, with its value at each of them."""
    if len(stages):
        at = {"bound": bounds.tolist(), "stages": stages.tolist()}
        yield {"kind": kind, "name": name, "unit": unit, "side": side, **at, "violation": violation}


class BoundAlongPlan(NamedTuple):
    """
    A softened bound along a plan.

    Attributes:
        kind: ``"state"``, ``"constraint"``, ``"second difference"`` of an input, or ``"end"`` for a state that is bounded at the last node alone.
        name: Name of the signal.
        unit: Its unit.
        lower: Lower bound, shape ``(nodes,)``.
        upper: Upper bound.
        values: Values along the plan.
        first: Node, or of a second difference stage, of the first of them.
    """

    kind: str
    name: str
    unit: str
    lower: Array
    upper: Array
    values: Array
    first: int


def softened(rti: Rti, config: Config) -> list[BoundAlongPlan]:
    """Return the softened bounds in the order of `Ocp.lg`."""
    ocp, w = rti.problem, rti.guess.weights
    g = outputs_of(constraints(ocp)[0], rti)
    rows = [("state", ocp.model.states[j], w["lbx"][..., j], w["ubx"][..., j]) for j in ocp.soft]
    rows += [("constraint", signal, w["lh"][..., j], w["uh"][..., j]) for j, signal in enumerate(constraint_signals(rti, config))]
    nh = rti.ocp.h_expr.numel()
    rows += [("second difference", ocp.model.inputs[j], w["lh"][..., nh + i], w["uh"][..., nh + i]) for i, j in enumerate(rti.ocp.soft_ddu)]
    rows += [("end", ocp.model.states[j], w["lbx_e"][j], w["ubx_e"][j]) for j in ocp.soft_e]
    found = []
    for j, (kind, signal, low, high) in enumerate(rows):
        first = FIRST.get(kind, ocp.N)
        values = g[-1:, j] if kind == "end" else g[:, j]
        lower, upper = (np.broadcast_to(bound, values.shape) for bound in (low, high))
        found.append(BoundAlongPlan(kind, signal.name, signal.unit, lower, upper, values, first))
    return found


def slack_weights(ocp: Ocp, w: Mapping[str, Array]) -> tuple[Array, Array]:
    """Return L1 and L2 weights of the slacks, in the order of `Ocp.lg`, at nodes 1 to N, shape ``(ng, N)``."""
    linear, square = (np.broadcast_to(ocp.softened(w[x], w[h], w[x]), (ocp.N, ocp.ng)).T for x, h in (("z", "zh"), ("Z", "Zh")))
    return linear, square


def constraint_signals(rti: Rti, config: Config) -> Sequence[Any]:
    """Return the signals of the general constraints that are bounded."""
    signals = [
        signal
        for signal in rti.ocp.model.constraints
        if signal.name in {**config.ocp.bounds.constraints, **config.ocp.stages.constraints} or signal.name.startswith("disc_")
    ]
    assert len(signals) == rti.ocp.h_expr.numel(), "those that `build_ocp` bounds"
    return signals


def outputs_of(function: Any, rti: Rti) -> Array:
    """Evaluate a function of state, input and parameters at nodes 1 to N of the plan, shape ``(N, outputs)``."""
    N, held = rti.ocp.N, rti.u[rti.ocp.held]
    x, p = (rti.guess.plan.x, rti.guess.sample["p"]) if function.size1_in(0) > rti.ocp.model.nx else (rti.x, rti.p)
    arguments = (x[1:].T, held.T, p[1:].T) if function.n_in() == 3 else (x[1:].T, p[1:].T)
    return np.array(function.map(N)(*arguments)).T


def cost_terms(rti: Rti, config: Config) -> dict[str, float]:
    """Return the cost (4) of a plan by term: error of each output, changes of each input, terminal weight, and slacks of each bound."""
    ocp, model = rti.ocp, rti.ocp.model
    w = {name: array / rti.cost_scale if name in COST_WEIGHTS else array for name, array in rti.guess.weights.items()}
    errors = outputs_of(model.outputs_at(), rti) - rti.y_ref
    increments = np.diff(rti.u, axis=0, prepend=rti.u_prev[None])
    weighed = np.sqrt(w["delta"]).reshape(ocp.N, -1) * errors
    by_output = (weighed * (weighed @ w["Q"])).sum(axis=0)
    weighed = np.sqrt(w["lambda_"]).reshape(ocp.N_u, -1) * increments
    by_input = (weighed * (weighed @ w["R"])).sum(axis=0)
    terms = {f"error of {signal.name}": float(value) for signal, value in zip(model.outputs, by_output, strict=True)}
    terms |= {f"changes of {signal.name}": float(value) for signal, value in zip(model.inputs, by_input, strict=True)}
    off = rti.u - np.array(input_reference(ocp)(rti.p[ocp.starts].T)).T
    for signal, value in zip(model.inputs, (w["R_u"] * off**2).sum(axis=0), strict=True):
        terms[f"{signal.name} itself"] = float(value)
    terms["terminal weight"] = float(errors[-1] @ w["Q_e"] @ errors[-1])
    for soft, linear, square in zip(softened(rti, config), *slack_weights(rti.problem, w), strict=True):
        slack = np.maximum(0.0, np.maximum(soft.lower - soft.values, soft.values - soft.upper))
        name = f"bounds of {'the second difference of ' if soft.kind == 'second difference' else ''}{soft.name}"
        at = slice(-len(slack), None)  # the last node, or all
        terms[name] = terms.get(name, 0.0) + float((linear[at] * slack + 0.5 * square[at] * slack**2).sum())
    return {name: value for name, value in terms.items() if value}
