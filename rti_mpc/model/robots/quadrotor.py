# SPDX-License-Identifier: Apache-2.0
r"""
Quadrotor: an AscTec Hummingbird, a rigid body in space, driven by the thrusts of its four rotors.

.. math::

    m \ddot r = R(\phi, \theta, \psi) e_z \sum_i f_i - m g e_z, \quad
    (\dot\phi, \dot\theta, \dot\psi) = W(\phi, \theta)\, \omega, \quad
    I \dot\omega = \tau - \omega \times I \omega

with roll, pitch and yaw in the order z, y, x, the moments :math:`\tau = (l (f_l - f_r), l (f_b - f_f), k (f_f - f_l + f_b - f_r))` of the rotors in
front, left, back and right, and :math:`\omega` in the body. Angles are simpler to command than a quaternion and singular at a pitch of 90 degrees,
from which bounds keep them: `rti_mpc.model.robots.quadrotor_quaternion` has the quaternion.

Mass, arm, inertia of the body and moment per thrust are those of rotors_simulator (ETH Zurich, Apache-2.0); a rotor's largest thrust of 6 N, in its
TOML file, is its motor constant times its largest speed squared.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from rti_mpc.model.model import Model, Signal

SOURCE = "rotors_simulator, Apache-2.0"
REST = "falls"
PARAMETERS = {"m": (0.716, "kg"), "l": (0.17, "m"), "k": (0.016, "m"), "I_x": (0.007, "kg m^2"), "I_y": (0.007, "kg m^2"), "I_z": (0.012, "kg m^2")}
GRAVITY = 9.81  # m/s^2
POSITION = (Signal("x", "m", role="x"), Signal("y", "m", role="y"), Signal("z", "m"))
VELOCITY, RATES = tuple(Signal(name, "m/s") for name in ("v_x", "v_y", "v_z")), tuple(Signal(name, "rad/s") for name in ("w_x", "w_y", "w_z"))
DRIVEN: dict[str, Any] = {  # what the model has whatever its attitude is told by
    "inputs": tuple(Signal(f"f_{rotor}", "N") for rotor in ("front", "left", "back", "right")),
    "parameters": tuple(Signal(name, unit) for name, (_, unit) in PARAMETERS.items()),
    "p_nominal": tuple(value for value, _ in PARAMETERS.values()),
    "u_rest": (PARAMETERS["m"][0] * GRAVITY / 4,) * 4,
}


def accelerations(up: ca.SX, rate: ca.SX, thrust: ca.SX, p: ca.SX) -> ca.SX:
    """Return the acceleration and, in the body, that of the rates, of a body whose thrust acts along `up`; shape ``(6, 1)``."""
    (front, left, back, right), (m, arm, k), inertia = ca.vertsplit(thrust), ca.vertsplit(p[:3]), p[3:]
    torque = ca.vertcat(arm * (left - right), arm * (back - front), k * (front - left + back - right))
    acceleration = up * ca.sum1(thrust) / m - ca.DM([0.0, 0.0, GRAVITY])
    return ca.vertcat(acceleration, (torque - ca.cross(rate, inertia * rate)) / inertia)


def quadrotor() -> Model:
    """Build the model; its outputs are position and yaw."""
    x, thrust, p = ca.SX.sym("x", 12), ca.SX.sym("u", 4), ca.SX.sym("p", len(PARAMETERS))
    (phi, theta, psi), velocity, rate = ca.vertsplit(x[3:6]), x[6:9], x[9:12]
    up = ca.vertcat(
        ca.cos(phi) * ca.sin(theta) * ca.cos(psi) + ca.sin(phi) * ca.sin(psi),
        ca.cos(phi) * ca.sin(theta) * ca.sin(psi) - ca.sin(phi) * ca.cos(psi),
        ca.cos(phi) * ca.cos(theta),
    )
    about = ca.sin(phi) * rate[1] + ca.cos(phi) * rate[2]
    turning = ca.vertcat(rate[0] + about * ca.tan(theta), ca.cos(phi) * rate[1] - ca.sin(phi) * rate[2], about / ca.cos(theta))
    yaw = Signal("psi", "rad", angle=True, role="heading")
    return Model(
        name="quadrotor",
        x=x,
        u=thrust,
        p=p,
        f_expl_expr=ca.vertcat(velocity, turning, accelerations(up, rate, thrust, p)),
        y_expr=ca.vertcat(x[:3], psi),
        states=(*POSITION, Signal("phi", "rad"), Signal("theta", "rad"), yaw, *VELOCITY, *RATES),
        outputs=(*POSITION, yaw),
        **DRIVEN,
    )
