# SPDX-License-Identifier: Apache-2.0
"""Description of a controller, as it publishes it on ``info``."""

from __future__ import annotations

from typing import Any

import rti_mpc
from rti_mpc.model.obstacle import discs_of
from rti_mpc.rti.ocp import Ocp
from rti_mpc.wire import info


def controller_info(ocp: Ocp, np_: int) -> dict[str, Any]:
    """Return names, units and limits, null where there is no limit. Parameters from index `np_` on are disturbances."""
    model = ocp.model
    vectors = {"states": model.states, "inputs": model.inputs, "outputs": model.outputs}
    vectors |= {"stage_parameters": model.parameters[:np_], "disturbances": model.parameters[np_:]}
    limits = ("lbu", "ubu", "lbdu", "ubdu", "lbx", "ubx")
    return {
        "version": rti_mpc.__version__,
        "model": ocp.model.name,
        **info.labels(model.counterparts(), **vectors),
        **info.bounds(**{name: ocp.widest(name).tolist() for name in limits}),
        "p_nominal": list(model.p_nominal[:np_]),
        **info.weights(Q=ocp.Q.tolist(), R=ocp.R.tolist(), delta=ocp.delta.tolist(), lambda_=ocp.lambda_[ocp.held].tolist()),
        **info.obstacles(discs_of(model)),
        "N": ocp.N,
        "N_u": ocp.N_u,
        "blocks": list(ocp.blocks),
        "dt_s": ocp.dt,
        "integrator": ocp.method,
    }
