# SPDX-License-Identifier: Apache-2.0
r"""
Quadrotor whose attitude is a quaternion: the Hummingbird of `rti_mpc.model.robots.quadrotor`, with 13 states.

.. math::

    m \ddot r = R(q) e_z \sum_i f_i - m g e_z, \quad \dot q = \tfrac12 \, q \otimes (0, \omega), \quad I \dot\omega = \tau - \omega \times I \omega

with q = (w, x, y, z) of length 1, so that it may turn about its yaw as often as it likes, and nothing is singular. Outputs are position and attitude:
the cost weighs the small angles between the attitude and that of the reference.

Parameters and moments are those of the other model.
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.quadrotor import DRIVEN, PARAMETERS, POSITION, RATES, VELOCITY, accelerations

SOURCE = "rotors_simulator, Apache-2.0"
REST = "falls"
ATTITUDE = tuple(Signal(name, "1") for name in ("q_w", "q_x", "q_y", "q_z"))


def quadrotor_quaternion() -> Model:
    """Build the model; its outputs are position and attitude."""
    x, thrust, p = ca.SX.sym("x", 13), ca.SX.sym("u", 4), ca.SX.sym("p", len(PARAMETERS))
    (w, i, j, k), velocity, rate = ca.vertsplit(x[3:7]), x[7:10], x[10:13]
    up = ca.vertcat(2 * (i * k + w * j), 2 * (j * k - w * i), w**2 - i**2 - j**2 + k**2)
    turning = ca.blockcat([[-i, -j, -k], [w, -k, j], [k, w, -i], [-j, i, w]]) @ rate / 2
    return Model(
        name="quadrotor_quaternion",
        x=x,
        u=thrust,
        p=p,
        f_expl_expr=ca.vertcat(velocity, turning, accelerations(up, rate, thrust, p)),
        y_expr=x[:7],
        states=(*POSITION, *ATTITUDE, *VELOCITY, *RATES),
        outputs=(*POSITION, *ATTITUDE),
        quaternions=(("q_w", "q_x", "q_y", "q_z"),),
        **DRIVEN,
    )
