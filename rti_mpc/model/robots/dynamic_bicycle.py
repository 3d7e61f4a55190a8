# SPDX-License-Identifier: Apache-2.0
r"""
Dynamic bicycle: a model car of 1:10 whose tyres slip and saturate, driven by an acceleration and a steering rate.

.. math::

    \dot x &= v_x \cos\psi - v_y \sin\psi, \quad \dot y = v_x \sin\psi + v_y \cos\psi, \quad \dot\psi = r \\
    \dot v_x &= a - F_f \sin\delta / m + v_y r \\
    \dot v_y &= (F_f \cos\delta + F_r) / m - v_x r \\
    \dot r &= (l_f F_f \cos\delta - l_r F_r) / I_z, \quad \dot\delta = \omega_\delta

The position is that of the centre of mass. Lateral forces follow the magic formula of [Pacejka2012]_ without its curvature,

.. math::

    F_i = \mu F_{z,i} \sin(c \arctan(C_i \alpha_i / c)), \quad \alpha_i = -\arctan(v_{lat,i} / \sqrt{v_{long,i}^2 + v_0^2}),

with the velocities of each wheel along and across itself, and static loads. A slip angle divides by the speed, which is singular at standstill:
below :math:`v_0` a tyre becomes a viscous damper instead, so that the car comes to rest in the model, too. At 3 m/s that makes slip angles 5 %
smaller. A stop brakes in proportion to the speed and holds the steering.

Mass, inertia, distances, friction and cornering stiffnesses are those of an F1TENTH car in f1tenth_gym (MIT), whose single-track model is that of
CommonRoad. Shape `c` is the usual one of a lateral force [Pacejka2012]_, `v_0` a choice of ours: tyres at rest settle within 10 ms.
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pose import POSE_SIGNALS

SOURCE = "f1tenth_gym, MIT"
REST = "drifts"
PARAMETERS = {  # name: nominal value, unit
    "m": (3.74, "kg"),
    "I_z": (0.04712, "kg m^2"),
    "l_f": (0.15875, "m"),  # from the centre of mass to the front axle
    "l_r": (0.17145, "m"),
    "mu": (1.0489, "1"),
    "C_f": (4.718, "1/rad"),  # cornering stiffness, in shares of mu F_z
    "C_r": (5.4562, "1/rad"),
    "c": (1.3, "1"),
    "v_0": (1.0, "m/s"),
}
GRAVITY = 9.81  # m/s^2
STOP_GAIN = 4.0  # 1/s, deceleration per speed of a stop


def dynamic_bicycle() -> Model:
    """Build the model; its slip angles are constraints, which may be bounded."""
    x, u, p = ca.SX.sym("x", 7), ca.SX.sym("u", 2), ca.SX.sym("p", len(PARAMETERS))
    _, _, psi, v_x, v_y, r, delta = ca.vertsplit(x)
    a, omega_delta = ca.vertsplit(u)
    m, I_z, l_f, l_r, mu, C_f, C_r, c, v_0 = ca.vertsplit(p)

    def slip_angle(along: ca.SX, across: ca.SX) -> ca.SX:
        return -ca.atan(across / ca.sqrt(along**2 + v_0**2))

    def lateral_force(share: ca.SX, stiffness: ca.SX, alpha: ca.SX) -> ca.SX:
        return mu * m * GRAVITY * share * ca.sin(c * ca.atan(stiffness / c * alpha))

    front, cos, sin = v_y + l_f * r, ca.cos(delta), ca.sin(delta)
    alpha_f, alpha_r = slip_angle(v_x * cos + front * sin, front * cos - v_x * sin), slip_angle(v_x, v_y - l_r * r)
    F_f, F_r = lateral_force(l_r / (l_f + l_r), C_f, alpha_f), lateral_force(l_f / (l_f + l_r), C_r, alpha_r)
    return Model(
        name="dynamic_bicycle",
        x=x,
        u=u,
        p=p,
        f_expl_expr=ca.vertcat(
            v_x * ca.cos(psi) - v_y * ca.sin(psi),
            v_x * ca.sin(psi) + v_y * ca.cos(psi),
            r,
            a - F_f * sin / m + v_y * r,
            (F_f * cos + F_r) / m - v_x * r,
            (l_f * F_f * cos - l_r * F_r) / I_z,
            omega_delta,
        ),
        y_expr=x[:3],
        h_expr=ca.vertcat(alpha_f, alpha_r),
        stop_expr=ca.vertcat(-STOP_GAIN * v_x, 0),
        states=(*POSE_SIGNALS, Signal("v_x", "m/s"), Signal("v_y", "m/s"), Signal("r", "rad/s"), Signal("delta", "rad")),
        inputs=(Signal("a", "m/s^2"), Signal("omega_delta", "rad/s")),
        outputs=POSE_SIGNALS,
        parameters=tuple(Signal(name, unit) for name, (_, unit) in PARAMETERS.items()),
        constraints=(Signal("alpha_f", "rad"), Signal("alpha_r", "rad")),
        p_nominal=tuple(value for value, _ in PARAMETERS.values()),
    )
