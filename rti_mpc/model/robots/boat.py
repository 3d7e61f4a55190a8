# SPDX-License-Identifier: Apache-2.0
r"""
Boat in a current, driven by a force along it and a moment; nothing moves it sideways.

.. math::

    \dot x &= u \cos\psi - v \sin\psi + c_x, \quad \dot y = u \sin\psi + v \cos\psi + c_y, \quad \dot\psi = r \\
    \dot u &= (X - 40 u) / 50, \quad \dot v = -v, \quad \dot r = (N - 8 r) / 8

Speeds are through the water, which moves with the current, a parameter that nobody measures: an observer estimates it, and a stop turns the boat into
it. Coupling of its motions and quadratic drag are left out.

Mass, inertia and drag are round numbers of our own, for a catamaran of 50 kg.
"""

from __future__ import annotations

import casadi as ca

from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pose import POSE_SIGNALS

SOURCE = "our own"
REST = "drifts"


def boat() -> Model:
    """Build the model; its outputs are the position."""
    x, u, current = ca.SX.sym("x", 6), ca.SX.sym("u", 2), ca.SX.sym("c", 2)
    _, _, psi, ahead, across, r = ca.vertsplit(x)
    c, s = ca.cos(psi), ca.sin(psi)
    return Model(
        name="boat",
        x=x,
        u=u,
        p=current,
        f_expl_expr=ca.vertcat(
            ahead * c - across * s + current[0],
            ahead * s + across * c + current[1],
            r,
            (u[0] - 40 * ahead) / 50,
            -across,
            (u[1] - 8 * r) / 8,
        ),
        y_expr=x[:2],
        states=(*POSE_SIGNALS, Signal("v_x", "m/s"), Signal("v_y", "m/s"), Signal("r", "rad/s")),
        inputs=(Signal("X", "N"), Signal("N", "Nm")),
        outputs=POSE_SIGNALS[:2],
        parameters=(Signal("c_x", "m/s"), Signal("c_y", "m/s")),
        p_nominal=(0.0, 0.0),
    )
