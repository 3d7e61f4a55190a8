# SPDX-License-Identifier: Apache-2.0
r"""
The Pioneer 3-DX of the paper: unicycle kinematics of a point ahead of the axle, first-order speed dynamics.

.. math::

    \dot x &= u \cos\psi - a \omega \sin\psi \\
    \dot y &= u \sin\psi + a \omega \cos\psi \\
    \dot\psi &= \omega \\
    \dot u &= (\theta_3 \omega^2 - \theta_4 u + u_c) / \theta_1 \\
    \dot\omega &= (-\theta_5 u \omega - \theta_6 \omega + \omega_c) / \theta_2

Equation (9) of [Rosales]_, identified by [DeLaCruz2006]_.
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pose import POSE_SIGNALS

SOURCE = "the paper"
REST = "holds"
NOMINAL_PARAMETERS = {
    "theta_1": 0.24089,
    "theta_2": 0.2424,
    "theta_3": -0.00093603,
    "theta_4": 0.99629,
    "theta_5": -0.0037256,
    "theta_6": 1.0915,
    "a": 0.2,  # [m], not printed in the paper: the value that the authors of its robot use
}


def pioneer_3dx() -> Model:
    """Build the model with the paper's printed parameters and ``a = 0.2 m``."""
    x = ca.SX.sym("x", 5)
    v = ca.SX.sym("u", 2)
    p = ca.SX.sym("p", len(NOMINAL_PARAMETERS))
    _, _, psi, u, omega = ca.vertsplit(x)
    u_c, omega_c = ca.vertsplit(v)
    theta_1, theta_2, theta_3, theta_4, theta_5, theta_6, a = ca.vertsplit(p)
    return Model(
        name="pioneer_3dx",
        x=x,
        u=v,
        p=p,
        f_expl_expr=ca.vertcat(
            u * ca.cos(psi) - a * omega * ca.sin(psi),
            u * ca.sin(psi) + a * omega * ca.cos(psi),
            omega,
            theta_3 / theta_1 * omega**2 - theta_4 / theta_1 * u + u_c / theta_1,
            -theta_5 / theta_2 * u * omega - theta_6 / theta_2 * omega + omega_c / theta_2,
        ),
        y_expr=x[:3],
        states=(*POSE_SIGNALS, Signal("u", "m/s"), Signal("omega", "rad/s")),
        inputs=(Signal("u_c", "m/s", commands="u"), Signal("omega_c", "rad/s", commands="omega")),
        outputs=POSE_SIGNALS,
        parameters=(
            Signal("theta_1", "s"),
            Signal("theta_2", "s"),
            Signal("theta_3", "s m/rad^2"),
            Signal("theta_4", "1"),
            Signal("theta_5", "s/m"),
            Signal("theta_6", "1"),
            Signal("a", "m", role="axle_offset"),
        ),
        p_nominal=tuple(NOMINAL_PARAMETERS.values()),
    )
