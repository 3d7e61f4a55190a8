# SPDX-License-Identifier: Apache-2.0
r"""
Kinematic unicycle: a position on the axle, driven by a speed and a turning rate that it has at once.

.. math::

    \dot x = v \cos\psi, \quad \dot y = v \sin\psi, \quad \dot\psi = \omega

It has no parameters.
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pose import POSE_SIGNALS

SOURCE = "no parameters"
REST = "holds"


def unicycle() -> Model:
    """Build the model."""
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    return Model(
        name="unicycle",
        x=x,
        u=u,
        f_expl_expr=ca.vertcat(u[0] * ca.cos(x[2]), u[0] * ca.sin(x[2]), u[1]),
        y_expr=x,
        states=POSE_SIGNALS,
        inputs=(Signal("v", "m/s"), Signal("omega", "rad/s")),
        outputs=POSE_SIGNALS,
    )
