# SPDX-License-Identifier: Apache-2.0
r"""
Differential drive: a TurtleBot3 Waffle Pi, driven by the speeds of its two wheels.

.. math::

    \dot x = v \cos\psi, \quad \dot y = v \sin\psi, \quad \dot\psi = r (\omega_r - \omega_l) / b, \quad v = r (\omega_r + \omega_l) / 2

Bounds on its inputs are those of the motors, so that it turns more slowly the faster it drives.

Radius of the wheels and their distance are those of turtlebot3_bringup (ROBOTIS, Apache-2.0).
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pose import POSE_SIGNALS

SOURCE = "turtlebot3, Apache-2.0"
REST = "holds"


def differential_drive() -> Model:
    """Build the model."""
    x, u, p = ca.SX.sym("x", 3), ca.SX.sym("u", 2), ca.SX.sym("p", 2)
    (left, right), (r, b) = ca.vertsplit(u), ca.vertsplit(p)
    v = r * (left + right) / 2
    return Model(
        name="differential_drive",
        x=x,
        u=u,
        p=p,
        f_expl_expr=ca.vertcat(v * ca.cos(x[2]), v * ca.sin(x[2]), r * (right - left) / b),
        y_expr=x,
        states=POSE_SIGNALS,
        inputs=(Signal("omega_l", "rad/s"), Signal("omega_r", "rad/s")),
        outputs=POSE_SIGNALS,
        parameters=(Signal("r", "m"), Signal("b", "m")),
        p_nominal=(0.033, 0.287),
    )
