# SPDX-License-Identifier: Apache-2.0
r"""
Disturbances, the part of the dynamics that a model leaves out, as further parameters: :math:`\dot x = f(x, u + d_u, p) + d_x`.

A disturbance of an input represents wrong gains and friction, one of a state slip and
wind. They are parameters like others, so every prediction with the model includes them
[Pannocchia2003]_.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import casadi as ca

from rti_mpc import given
from rti_mpc.errors import OcpError
from rti_mpc.model.model import Model, Signal

DISTURBANCE_PREFIX = "d_"


def with_disturbances(model: Model, names: Iterable[str]) -> Model:
    """
    Append disturbances to the parameters of a model.

    Args:
        model: The undisturbed one.
        names: Names of inputs, to which disturbances are added in the input's unit, or of states, to whose derivatives they are added in unit / s.

    Returns:
        The model with parameters ``d_<name>`` at the end, nominally zero.

    Raises:
        OcpError: A name is neither an input nor a state, or there twice.
    """
    given.instance("model", model, Model)
    if not isinstance(names, Iterable):
        raise OcpError(f"disturbances must be names of inputs or states, got {given.quoted(names)}")
    names = (names,) if isinstance(names, str) else tuple(names)
    if not names:
        return model
    inputs, states = [s.name for s in model.inputs], [s.name for s in model.states]
    if unknown := [str(name) for name in names if name not in (*inputs, *states)]:
        raise OcpError(f"a disturbance must be of an input ({', '.join(inputs)}) or of a state ({', '.join(states)}), got {', '.join(unknown)}")
    if len(set(names)) < len(names):
        raise OcpError(f"names of disturbances must be there once each, got {', '.join(names)}")
    d = ca.SX.sym("d", len(names))
    by_name = dict(zip(names, ca.vertsplit(d), strict=True))
    zero = ca.SX(0)
    u = model.u + ca.vertcat(*(by_name.get(name, zero) for name in inputs))
    of_states = ca.vertcat(*(by_name.get(name, zero) if name not in inputs else zero for name in states))
    span = 1.0 if model.dt is None else model.dt  # over which the disturbance of a rate adds up
    dynamics: dict[str, Any] = {name: ca.substitute(expr, model.u, u) + span * of_states for name, expr in model.dynamics.items()}
    units = {s.name: f"{s.unit}/s" for s in model.states} | {s.name: s.unit for s in model.inputs}
    return replace(
        model,
        p=ca.vertcat(model.p, d),
        **dynamics,
        parameters=(*model.parameters, *(Signal(DISTURBANCE_PREFIX + name, units[name]) for name in names)),
        p_nominal=(*model.p_nominal, *(0.0 for _ in names)),
    )
