# SPDX-License-Identifier: Apache-2.0
"""Robots and problems in other units."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.model.model import Model, Signal
from rti_mpc.rti.ocp import Ocp
from rti_mpc.si import read

# km, mm, degrees, cm/s and rpm; mm/s and rpm
PIONEER_TEXTS = {"x": "km", "y": "mm", "psi": "deg", "u": "cm/s", "omega": "rpm", "u_c": "mm/s", "omega_c": "rpm"}
PIONEER_UNITS = np.array([1e3, 1e-3, np.pi / 180, 1e-2, 2 * np.pi / 60]), np.array([1e-3, 2 * np.pi / 60])


def model_in_other_units(model: Model, x_units: Array, u_units: Array) -> Model:
    """Return a model whose states and inputs count so many of the old units each; its outputs are the old ones."""
    x, u = ca.SX.sym("x", model.nx), ca.SX.sym("u", model.nu)
    old = (ca.DM(x_units) * x, ca.DM(u_units) * u)
    f, y, h = (ca.substitute([expr], [model.x, model.u], [*old])[0] for expr in (model.f_expl_expr, model.y_expr, model.h_expr))
    states, inputs = (
        tuple(Signal(signal.name, f"{unit:g} {signal.unit}") for signal, unit in zip(signals, units, strict=True))
        for signals, units in ((model.states, x_units), (model.inputs, u_units))
    )
    outputs = tuple(Signal(signal.name, signal.unit) for signal in model.outputs)
    given: dict[str, Any] = {
        "p": model.p,
        "parameters": model.parameters,
        "p_nominal": model.p_nominal,
        "u_rest": tuple(np.array(model.u_rest) / u_units),
    }
    return Model(model.name, x, u, f / ca.DM(x_units), y, states, inputs, outputs, h_expr=h, constraints=model.constraints, **given)


def in_other_units(ocp: Ocp, x_units: Array, u_units: Array) -> Ocp:
    """Return the same problem, whose states and inputs count so many of the old units each; with units of 1 its signals are no angles either."""
    constrained = replace(ocp.model, h_expr=ocp.h_expr, constraints=tuple(Signal(f"h_{i}", "1") for i in range(ocp.h_expr.numel())))
    bounds = {name: getattr(ocp, name) / u_units for name in ("lbu", "ubu", "lbdu", "ubdu")}
    bounds |= {name: getattr(ocp, name) / x_units for name in ("lbx", "ubx")} | {"lh": ocp.lh, "uh": ocp.uh}
    weights = {name: getattr(ocp, name) for name in ("Q", "Q_e", "delta", "lambda_", "zh", "Zh")}
    weights |= {"R": ocp.R * np.outer(u_units, u_units), "R_u": ocp.R_u * u_units**2, "z": ocp.z * x_units, "Z": ocp.Z * x_units**2}
    model = model_in_other_units(constrained, x_units, u_units)
    return Ocp(model, N=ocp.N, blocks=ocp.blocks, dt=ocp.dt, method=ocp.method, **bounds, **weights)


def with_units(model: Model, units: Mapping[str, str]) -> Model:
    """Return a model some of whose states, inputs and outputs have other units, by name; without roles, which are in m and rad."""
    vectors = {name: getattr(model, name) for name in ("states", "inputs", "outputs")}
    x_sizes, u_sizes, y_sizes = (np.array([size(signal, units) for signal in signals]) for signals in vectors.values())
    x, u = ca.SX.sym("x", model.nx), ca.SX.sym("u", model.nu)
    old = (ca.DM(x_sizes) * x, ca.DM(u_sizes) * u)
    f, y = (ca.substitute([expr], [model.x, model.u], [*old])[0] for expr in (model.f_expl_expr, model.y_expr))
    renamed = {name: tuple(replace(s, unit=units.get(s.name, s.unit), role="") for s in signals) for name, signals in vectors.items()}
    rest = tuple(np.array(model.u_rest) / u_sizes)
    return replace(model, x=x, u=u, f_expl_expr=f / ca.DM(x_sizes), y_expr=y / ca.DM(y_sizes), u_rest=rest, **renamed)


def size(signal: Signal, units: Mapping[str, str]) -> float:
    """Return how many old units the new unit of a signal is."""
    return read(units.get(signal.name, signal.unit)).size / read(signal.unit).size


def document_with_units(document: dict[str, Any], model: Model, units: Mapping[str, str]) -> dict[str, Any]:
    """Return the configuration of a robot, as its TOML file has it, for the same robot in other units; of those keys that tests of units have."""
    sizes = {s.name: size(s, units) for s in (*model.states, *model.inputs, *model.outputs)}
    scaled = deepcopy(document)
    powers = {"Q": 2, "R": 2, "R_u": 2, "inputs": -1, "increments": -1, "states": -1, "disturbances": -1, "noise": -1, "x0": -1, "noise_std": -1}
    tables = (scaled["ocp"]["weights"], scaled["ocp"].get("bounds", {}), scaled.get("observer", {}), scaled.get("sim", {}))
    for table in tables:
        for key in table.keys() & powers.keys():
            table[key] = {name: _times(value, sizes[name] ** powers[key]) for name, value in table[key].items()}
    return scaled


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, dict):
        return {name: _times(part, factor) for name, part in value.items()}
    return [_times(part, factor) for part in value] if isinstance(value, list) else value * factor
