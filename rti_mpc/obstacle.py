# SPDX-License-Identifier: Apache-2.0
r"""
Discs to keep out of, as stage parameters: one that moves is one whose parameters do.

    model, clearance = with_obstacles(pioneer_3dx(), [(1.0, 0.5, 0.3)])
    ocp = Ocp(model, ..., h_expr=clearance, lh=0.0)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

from rti_mpc.errors import OcpError
from rti_mpc.model import Model, Signal

TINY = 1e-9  # m^2: a distance of zero has no derivative


def with_obstacles(model: Model, discs: Sequence[tuple[float, float, float]]) -> tuple[Model, ca.SX]:
    r"""
    Add discs to the parameters of a model.

    The robot is a point: a disc's radius includes the robot's own, and what it
    may cut short between two nodes, :math:`(v \, dt)^2 / 8 r`.

    Args:
        model: A model whose first two outputs are a position, in m.
        discs: x, y and radius of each, in m; a reference may carry others, row by row.

    Returns:
        The model with parameters ``disc_i_x, disc_i_y, disc_i_r`` appended, and its clearance from each, shape ``(len(discs), 1)``, in m:
        distance less radius, negative inside.

    Raises:
        OcpError: The model has no position, or a radius is not positive.
    """
    if [signal.unit for signal in model.outputs[:2]] != ["m", "m"]:
        raise OcpError(f"model {model.name}: the first two outputs must be a position in m, got {[s.name for s in model.outputs[:2]]}")
    if any(radius <= 0 for _, _, radius in discs):
        raise OcpError(f"the radius of a disc must be positive, got {list(discs)}")
    p = ca.SX.sym("disc", 3, len(discs))
    names = [f"disc_{i}_{part}" for i in range(len(discs)) for part in ("x", "y", "r")]
    away = p[:2, :] - ca.repmat(model.y_expr[:2], 1, len(discs))
    clearance = ca.sqrt(ca.sum1(away**2) + TINY).T - p[2, :].T
    return (
        replace(
            model,
            p=ca.vertcat(model.p, ca.vec(p)),
            parameters=(*model.parameters, *(Signal(name, "m") for name in names)),
            p_nominal=(*model.p_nominal, *(float(value) for disc in discs for value in disc)),
        ),
        clearance,
    )
