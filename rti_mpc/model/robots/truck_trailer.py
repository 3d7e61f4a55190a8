# SPDX-License-Identifier: Apache-2.0
r"""
Truck with a trailer that is hitched behind its rear axle, driven forwards and backwards by its speed and its steering rate.

.. math::

    \dot x &= v_t \cos\psi, \quad \dot y = v_t \sin\psi, \quad \dot\psi = (v \sin\beta - l_h \omega \cos\beta) / l_t \\
    \dot\beta &= \omega - \dot\psi, \quad \dot\delta = \omega_\delta, \quad \omega = v \tan\delta / L, \quad
    v_t = v \cos\beta + l_h \omega \sin\beta

Position and heading are those of the trailer's axle; the truck's heading is :math:`\psi + \beta`, with the hitch angle :math:`\beta`, and `v` the
speed of its rear axle. Backwards the hitch angle is unstable: left alone, the trailer jackknifes. This is the general one-trailer of
[Altafini2001]_.

Lengths are round numbers of our own, such as a van and a two-axle trailer have.
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pose import POSE_SIGNALS

SOURCE = "our own"
REST = "holds"
PARAMETERS = {"L": (3.6, "m"), "l_h": (0.8, "m"), "l_t": (4.5, "m")}  # wheelbase, rear axle to hitch, hitch to the trailer's axle


def truck_trailer() -> Model:
    """Build the model; its outputs are the trailer's pose."""
    x, u, p = ca.SX.sym("x", 5), ca.SX.sym("u", 2), ca.SX.sym("p", 3)
    (_, _, psi, beta, delta), (v, omega_delta), (L, l_h, l_t) = ca.vertsplit(x), ca.vertsplit(u), ca.vertsplit(p)
    omega = v * ca.tan(delta) / L
    v_t, turning = v * ca.cos(beta) + l_h * omega * ca.sin(beta), (v * ca.sin(beta) - l_h * omega * ca.cos(beta)) / l_t
    states = (*POSE_SIGNALS, Signal("beta", "rad"), Signal("delta", "rad"))
    return Model(
        name="truck_trailer",
        x=x,
        u=u,
        p=p,
        f_expl_expr=ca.vertcat(v_t * ca.cos(psi), v_t * ca.sin(psi), turning, omega - turning, omega_delta),
        y_expr=x[:3],
        states=states,
        inputs=(Signal("v", "m/s"), Signal("omega_delta", "rad/s")),
        outputs=states[:3],
        parameters=tuple(Signal(name, unit) for name, (_, unit) in PARAMETERS.items()),
        p_nominal=tuple(value for value, _ in PARAMETERS.values()),
    )
