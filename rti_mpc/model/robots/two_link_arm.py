# SPDX-License-Identifier: Apache-2.0
r"""
Arm of two links in a vertical plane, driven by torques at its joints; what follows a reference is its tip.

.. math::

    M(q) \ddot q + C(q, \dot q) + g(q) = \tau, \quad
    (x, z) = (l \cos q_1 + l \cos(q_1 + q_2), \; l \sin q_1 + l \sin(q_1 + q_2))

Angles are zero where the arm is stretched out horizontally.

Links are uniform rods of our own, 0.5 m and 1 kg each, their inertia rounded.
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.model.model import Model, Signal

SOURCE = "our own"
REST = "falls"
LENGTH, CENTRE, MASS, INERTIA, GRAVITY = 0.5, 0.25, 1.0, 0.02, 9.81  # m, m, kg, kg m^2, m/s^2


def two_link_arm() -> Model:
    """Build the model; its outputs are the position of the tip."""
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 2)
    q_1, q_2, w_1, w_2 = ca.vertsplit(x)
    near, far, coupled = 2 * INERTIA + MASS * (2 * CENTRE**2 + LENGTH**2), INERTIA + MASS * CENTRE**2, MASS * LENGTH * CENTRE
    mass = near + 2 * coupled * ca.cos(q_2), far + coupled * ca.cos(q_2), far
    turning, weight = coupled * ca.sin(q_2), MASS * CENTRE * GRAVITY * ca.cos(q_1 + q_2)
    torque_1 = u[0] + turning * w_2 * (2 * w_1 + w_2) - MASS * (CENTRE + LENGTH) * GRAVITY * ca.cos(q_1) - weight
    torque_2 = u[1] - turning * w_1**2 - weight
    determinant = mass[0] * mass[2] - mass[1] ** 2
    return Model(
        name="two_link_arm",
        x=x,
        u=u,
        f_expl_expr=ca.vertcat(
            w_1, w_2, (mass[2] * torque_1 - mass[1] * torque_2) / determinant, (mass[0] * torque_2 - mass[1] * torque_1) / determinant
        ),
        y_expr=LENGTH * ca.vertcat(ca.cos(q_1) + ca.cos(q_1 + q_2), ca.sin(q_1) + ca.sin(q_1 + q_2)),
        states=(Signal("q_1", "rad", angle=True), Signal("q_2", "rad", angle=True), Signal("w_1", "rad/s"), Signal("w_2", "rad/s")),
        inputs=(Signal("t_1", "Nm"), Signal("t_2", "Nm")),
        outputs=(Signal("x_tip", "m"), Signal("z_tip", "m")),
    )
