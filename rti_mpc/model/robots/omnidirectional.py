# SPDX-License-Identifier: Apache-2.0
r"""
Omnidirectional base on four mecanum wheels, a KUKA youBot, driven by the velocity of its body.

.. math::

    \dot x = v_x \cos\psi - v_y \sin\psi, \quad \dot y = v_x \sin\psi + v_y \cos\psi, \quad \dot\psi = \omega

Its constraints are the speeds of the wheels, :math:`(v_x \pm v_y \pm (l_x + l_y) \omega) / r`: what its motors can do limits the combination.

Radius of the wheels and half their distances are those of KUKA's youbot_driver (BSD-3-Clause and LGPL-2.1).
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pose import POSE_SIGNALS

SOURCE = "youbot_driver, BSD"
REST = "holds"
WHEELS = {"front_left": (-1, -1), "front_right": (1, 1), "rear_left": (1, -1), "rear_right": (-1, 1)}  # signs of v_y and omega


def omnidirectional() -> Model:
    """Build the model."""
    x, u, p = ca.SX.sym("x", 3), ca.SX.sym("u", 3), ca.SX.sym("p", 3)
    (v_x, v_y, omega), (r, l_x, l_y), (c, s) = ca.vertsplit(u), ca.vertsplit(p), (ca.cos(x[2]), ca.sin(x[2]))
    return Model(
        name="omnidirectional",
        x=x,
        u=u,
        p=p,
        f_expl_expr=ca.vertcat(v_x * c - v_y * s, v_x * s + v_y * c, omega),
        y_expr=x,
        h_expr=ca.vertcat(*((v_x + sideways * v_y + turning * (l_x + l_y) * omega) / r for sideways, turning in WHEELS.values())),
        states=POSE_SIGNALS,
        inputs=(Signal("v_x", "m/s"), Signal("v_y", "m/s"), Signal("omega", "rad/s")),
        outputs=POSE_SIGNALS,
        parameters=(Signal("r", "m"), Signal("l_x", "m"), Signal("l_y", "m")),
        constraints=tuple(Signal(wheel, "rad/s") for wheel in WHEELS),
        p_nominal=(0.0475, 0.235, 0.15),
    )
