# SPDX-License-Identifier: Apache-2.0
"""Plan without one of the bounds that act: the QP of the sample again, with that bound far away."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rti_mpc.array import Array
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.scaled import Scaled
from rti_mpc_service.case import QpCase, qp_at
from rti_mpc_service.config.schema import Config
from rti_mpc_service.replay.answer import of_other, of_ours
from rti_mpc_service.replay.plan import softened

FAR = 1e6  # scales by which a bound is moved away, at all stages
BOUNDS = {"input": ("lbu", "ubu"), "increment": ("lbdu", "ubdu"), "state": ("lbx", "ubx"), "constraint": ("lh", "uh"), "end": ("lbx_e", "ubx_e")}
BOUNDS["second difference"] = BOUNDS["constraint"]  # among which solvers have them


def without(case: QpCase, rti: Rti, config: Config, bound: Mapping[str, Any]) -> dict[str, float] | None:
    """
    Return the first inputs of the plan without a bound, by name; None if there is no such plan.

    Args:
        case: The sample.
        rti: Real-time iteration of its problem. Its arrays are overwritten.
        config: Its configuration.
        bound: The bound, as `rti_mpc_service.replay.plan.acting_bounds` returns it.
    """
    changed = moved(case, rti, config, bound)
    if rti.active_set is not None:
        found = of_ours(case, rti, changed)
    else:
        found = of_other(Scaled(qp_at(rti, case.guess | changed)), "daqp")
    if not found.status.usable:
        return None
    return {signal["name"]: float(value) for signal, value in zip(case.about["inputs"], case.inputs(found.z)[0], strict=True)}


def moved(case: QpCase, rti: Rti, config: Config, bound: Mapping[str, Any]) -> dict[str, Array]:
    """Return the array of bounds in which the bound is far away, by its name."""
    model, upper = rti.problem.model, bound["side"] == "upper"
    rows = {(soft.kind, soft.name): i for i, soft in enumerate(softened(rti, config))}
    kind, name = bound["kind"], bound["name"]
    if (kind, name) in rows:
        scale = rti.scale_g[rows[kind, name]]
        among = [row for row in rows if BOUNDS[row[0]] == BOUNDS["constraint"]]
        at = among.index((kind, name)) if (kind, name) in among else [s.name for s in model.states].index(name)
    else:
        at = [signal.name for signal in model.inputs].index(name)
        scale = rti.scale_u[at]
    array = BOUNDS[kind][upper]
    values = case.guess[array].copy()
    values[..., at] += FAR * scale * (1.0 if upper else -1.0)
    return {array: values}
