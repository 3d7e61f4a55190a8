# SPDX-License-Identifier: Apache-2.0
"""Description of a controller, as it publishes it on ``info``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

import rti_mpc
from rti_mpc.array import Array
from rti_mpc.errors import ConfigError
from rti_mpc.model.obstacle import discs_of
from rti_mpc.rti.ocp import Ocp
from rti_mpc.wire import info
from rti_mpc.wire.document import MAX_DOCUMENT_BYTES

LONGEST = 2.2250738585072014e-308  # a number with as many characters as one has
LIFE_BYTES = 4096  # of what a running controller adds: epoch, latch, real time, parameters that were changed


def controller_info(ocp: Ocp, np_: int, scales: tuple[Array, Array] | None = None) -> dict[str, Any]:
    """
    Return names, units and limits, null where there is no limit.

    Args:
        ocp: The problem.
        np_: Index of the first parameter that is a disturbance.
        scales: Those of states and inputs, see `rti_mpc.rti.scale`; None: they are not told.
    """
    model = ocp.model
    vectors = {"states": model.states, "inputs": model.inputs, "outputs": model.outputs}
    vectors |= {"stage_parameters": model.parameters[:np_], "disturbances": model.parameters[np_:]}
    limits = ("lbu", "ubu", "lbdu", "ubdu", "lbx", "ubx")
    return {
        "version": rti_mpc.__version__,
        "model": ocp.model.name,
        "quaternions": model.quaternions,
        **info.labels(model.counterparts(), **vectors),
        **info.bounds(**{name: ocp.widest(name).tolist() for name in limits}),
        **({} if scales is None else info.scales(scale_x=scales[0].tolist(), scale_u=scales[1].tolist())),
        "p_nominal": list(model.p_nominal[:np_]),
        **info.weights(Q=ocp.Q.tolist(), R=ocp.R.tolist(), delta=ocp.delta.tolist(), lambda_=ocp.lambda_[ocp.held].tolist()),
        **info.obstacles(discs_of(model)),
        "N": ocp.N,
        "N_u": ocp.N_u,
        "blocks": list(ocp.blocks),
        "dt_s": ocp.dt,
        "integrator": ocp.method,
    }


def fitting(description: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """
    Leave the weights out of a description that nobody would read, because it is too long.

    Returns:
        The description to publish, and what is to be said of its length; empty if it is whole.
    """
    if (size := _size(description)) <= MAX_DOCUMENT_BYTES:
        return dict(description), ""
    short = {name: value for name, value in description.items() if name != "weights"}
    said = f"the description on info has {size} bytes, and may have {MAX_DOCUMENT_BYTES}"
    if (left := _size(short)) > MAX_DOCUMENT_BYTES:
        return short, f"{said}; it has {left} without weights, so nobody reads it, and standbys do not take over parameters and stops from it"
    return short, f"{said}: it is without the weights of each stage, and viewers show no cost by term"


def check_length(ocp: Ocp) -> str:
    """
    Check that the description of a controller can be read, and return what is to be said of its length; empty if it is whole.

    Raises:
        ConfigError: It is too long even without weights.
    """
    scales = np.full(ocp.model.nx, LONGEST), np.full(ocp.model.nu, LONGEST)
    short, said = fitting(controller_info(ocp, ocp.model.np_, scales))
    if (size := _size(short)) > MAX_DOCUMENT_BYTES - LIFE_BYTES:
        raise ConfigError(
            f"the description of the model's signals must have at most {MAX_DOCUMENT_BYTES - LIFE_BYTES} bytes, for viewers and standbys to read it, "
            f"got {size}: have fewer states, outputs or stage parameters, or shorter names"
        )
    return said


def _size(description: Mapping[str, Any]) -> int:
    return len(json.dumps(description))
