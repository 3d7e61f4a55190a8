# SPDX-License-Identifier: Apache-2.0
r"""
Discs that the robot must stay out of, as stage parameters: a disc moves if its parameters change along the horizon.

    model = with_obstacles(pioneer_3dx(), [(1.0, 0.5, 0.3)])
    ocp = Ocp(model, ..., lh=0.0)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from rti_mpc import given
from rti_mpc.errors import OcpError
from rti_mpc.model.model import Model
from rti_mpc.signals import Role, Signal, plane

DISC_ROLES: dict[str, Role] = {"x": "disc_x", "y": "disc_y", "r": "disc_radius"}  # key: last part of a parameter's name, disc_0_x
SMOOTHING_M2 = 1e-9  # added to a squared distance in m^2, since a distance of zero has no derivative


def with_obstacles(model: Model, discs: Sequence[tuple[float, float, float]]) -> Model:
    r"""
    Add discs to the parameters of a model, and the clearance from each to its constraints.

    The robot is a point: the radius of a disc must include the robot's own, and
    :math:`(v \, dt)^2 / 8 r`, by which the path between two nodes may cut into the disc.

    Args:
        model: A model that has outputs with the roles x and y.
        discs: x, y and radius of each, in m; a reference may carry others, row by row.

    Returns:
        The model with parameters ``disc_i_x, disc_i_y, disc_i_r`` appended, and constraints ``disc_i``, in m: distance less radius, negative inside.

    Raises:
        OcpError: The model has no position, discs are no rows of three numbers, or a radius is not positive.
    """
    given.instance("model", model, Model)
    rows = given.numbers("discs", discs)
    if not rows.size:
        return model
    if rows.ndim != 2 or rows.shape[1] != 3 or not np.isfinite(rows).all():
        raise OcpError(f"discs must be finite rows of x, y and radius, got {given.quoted(discs)}")
    discs = [(x, y, radius) for x, y, radius in rows.tolist()]
    if (position := plane(model.outputs)) is None:
        raise OcpError(f"model {model.name}: two outputs must be a position, with role x and role y, got {[s.name for s in model.outputs]}")
    if any(radius <= 0 for _, _, radius in discs):
        raise OcpError(f"the radius of a disc must be positive, got {list(discs)}")
    p = ca.SX.sym("disc", 3, len(discs))
    away = p[:2, :] - ca.repmat(model.y_expr[list(position), 0], 1, len(discs))
    clearance = ca.sqrt(ca.sum1(away**2) + SMOOTHING_M2).T - p[2, :].T
    return replace(
        model,
        p=ca.vertcat(model.p, ca.vec(p)),
        parameters=(*model.parameters, *(Signal(f"disc_{i}_{part}", "m", role=role) for i in range(len(discs)) for part, role in DISC_ROLES.items())),
        p_nominal=(*model.p_nominal, *(float(value) for disc in discs for value in disc)),
        h_expr=ca.vertcat(model.h_expr, clearance),
        constraints=(*model.constraints, *(Signal(f"disc_{i}", "m") for i in range(len(discs)))),
    )


def discs_of(model: Model) -> list[tuple[int, float, float, float]]:
    """Return the discs among the parameters of a model: the index of each disc's x, and its nominal x, y and radius in m."""
    p = model.p_nominal
    return [(i, p[i], p[i + 1], p[i + 2]) for i, signal in enumerate(model.parameters) if signal.role == "disc_x"]
