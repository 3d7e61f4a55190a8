# SPDX-License-Identifier: Apache-2.0
r"""
Pole on a cart that is driven by a force: it swings up from hanging, and is balanced.

.. math::

    (M + m \sin^2\theta)\, \dot v &= F - b v - m l \omega^2 \sin\theta + (m g l \sin\theta - d \omega) \cos\theta / l \\
    \dot\omega &= (\dot v \cos\theta + g \sin\theta) / l - d \omega / (m l^2)

The pole is a point mass, upright at :math:`\theta = 0`. Friction of cart and pivot brings it to rest, hanging, when no force acts.

Masses and length are those of the pendulum in acados' examples (BSD-2-Clause); friction is of our own.
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.model.model import Model, Signal

SOURCE = "acados' examples, BSD-2-Clause; friction our own"
REST = "coasts"
CART, POLE, LENGTH, GRAVITY = 1.0, 0.1, 0.8, 9.81  # kg, kg, m, m/s^2
FRICTION = (1.0, 0.02)  # of the cart, N s/m; of the pivot, N m s


def cart_pole(friction: tuple[float, float] = FRICTION) -> Model:
    """Build the model, with friction of the cart in N s/m and of the pivot in N m s; its outputs are its states."""
    x, F = ca.SX.sym("x", 4), ca.SX.sym("u")
    _, theta, v, omega = ca.vertsplit(x)
    c, s = ca.cos(theta), ca.sin(theta)
    braked = friction[1] * omega
    pulled = F - friction[0] * v - POLE * LENGTH * s * omega**2
    accelerated = (pulled + (POLE * GRAVITY * LENGTH * s - braked) * c / LENGTH) / (CART + POLE * s**2)
    states = (Signal("x", "m"), Signal("theta", "rad", angle=True), Signal("v", "m/s"), Signal("omega", "rad/s"))
    return Model(
        name="cart_pole",
        x=x,
        u=F,
        f_expl_expr=ca.vertcat(v, omega, accelerated, (accelerated * c + GRAVITY * s) / LENGTH - braked / (POLE * LENGTH**2)),
        y_expr=x,
        states=states,
        inputs=(Signal("F", "N"),),
        outputs=states,
    )
