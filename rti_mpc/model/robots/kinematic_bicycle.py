# SPDX-License-Identifier: Apache-2.0
r"""
Kinematic bicycle: an F1TENTH car, its position on the rear axle, driven by an acceleration and a steering rate.

.. math::

    \dot x = v \cos\psi, \quad \dot y = v \sin\psi, \quad \dot\psi = v \tan\delta / L, \quad \dot v = a, \quad \dot\delta = \omega_\delta

The wheelbase is that of f1tenth_gym (MIT), as are the bounds of steering and acceleration in its TOML file, the latter with a margin.
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pose import POSE_SIGNALS

SOURCE = "f1tenth_gym, MIT"
REST = "drifts"


def kinematic_bicycle() -> Model:
    """Build the model."""
    x, u, L = ca.SX.sym("x", 5), ca.SX.sym("u", 2), ca.SX.sym("L")
    _, _, psi, v, delta = ca.vertsplit(x)
    return Model(
        name="kinematic_bicycle",
        x=x,
        u=u,
        p=L,
        f_expl_expr=ca.vertcat(v * ca.cos(psi), v * ca.sin(psi), v * ca.tan(delta) / L, u[0], u[1]),
        y_expr=x[:3],
        states=(*POSE_SIGNALS, Signal("v", "m/s"), Signal("delta", "rad")),
        inputs=(Signal("a", "m/s^2"), Signal("omega_delta", "rad/s")),
        outputs=POSE_SIGNALS,
        parameters=(Signal("L", "m"),),
        p_nominal=(0.3302,),
    )
