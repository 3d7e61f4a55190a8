# SPDX-License-Identifier: Apache-2.0
r"""
Chain of masses between a fixed point and one whose velocity is commanded, hanging from springs [Wirsching2006]_.

.. math::

    m \ddot p_i = F_{i,i+1} - F_{i-1,i} - d \dot p_i - m g e_z, \quad F_{i,j} = D (1 - L / \|p_j - p_i\|) (p_j - p_i), \quad \dot p_M = u

States are the positions of all masses but the fixed one, then the velocities of those in between. Where the chain hangs at rest, its end held 1 m
from the fixed point, is found by Newton's method.

Mass, stiffness and length of a spring are those of [Wirsching2006]_; the drag of the air, which lets a chain come to rest, is of our own.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.model.model import Model, Signal

SOURCE = "Wirsching et al. 2006; drag our own"
REST = "holds"
MASS, STIFFNESS, LENGTH, GRAVITY = 0.033, 1.0, 0.033, 9.81  # kg, N/m, m, m/s^2
END = (1.0, 0.0, 0.0)  # m, where the end is held at rest
DRAG = 0.06  # N s/m


def chain(masses: int = 4, drag: float = DRAG) -> Model:
    """
    Build the model; its outputs are the position of the end and the velocity of the middle.

    Args:
        masses: Number of them, both ends included.
        drag: Of the air, in N s/m.
    """
    free = masses - 2
    at, velocity, u = ca.SX.sym("p", 3 * (free + 1)), ca.SX.sym("v", 3 * free), ca.SX.sym("u", 3)
    acceleration = ca.SX(ca.repmat(ca.DM([0.0, 0.0, -GRAVITY]), free)) - drag / MASS * velocity
    for link in range(free + 1):
        stretched = at[3 * link : 3 * link + 3] - (at[3 * link - 3 : 3 * link] if link else 0.0)
        pull = STIFFNESS / MASS * (1.0 - LENGTH / ca.norm_2(stretched)) * stretched
        if link < free:
            acceleration[3 * link : 3 * link + 3] -= pull
        if link:
            acceleration[3 * link - 3 : 3 * link] += pull
    position = [Signal(f"{axis}_{i + 1}", "m") for i in range(free + 1) for axis in "xyz"]
    speed = [Signal(f"v{axis}_{i + 1}", "m/s") for i in range(free) for axis in "xyz"]
    middle = slice(3 * (free // 2), 3 * (free // 2) + 3)
    return Model(
        name="chain",
        x=ca.vertcat(at, velocity),
        u=u,
        f_expl_expr=ca.vertcat(velocity, u, acceleration),
        y_expr=ca.vertcat(at[3 * free :], velocity[middle]),
        states=(*position, *speed),
        inputs=tuple(Signal(f"u_{axis}", "m/s") for axis in "xyz"),
        outputs=(*position[3 * free :], *speed[middle]),
        x_nominal=tuple(hanging(at, velocity, acceleration)),
        stop_expr=ca.SX(3, 1),  # its end stands, and the air does the rest
    )


def hanging(at: ca.SX, velocity: ca.SX, acceleration: ca.SX) -> Array:
    """Return the state at rest, its end held at `END`, shape ``(nx,)``."""
    between = ca.SX.sym("between", velocity.numel())
    forces = ca.substitute(acceleration, ca.vertcat(at, velocity), ca.vertcat(between, ca.DM(END), ca.DM.zeros(velocity.numel())))
    share = np.linspace(0.0, 1.0, velocity.numel() // 3 + 2)[1:-1, None]
    guess = share * END + np.array([0.0, 0.0, -0.3])
    found = ca.rootfinder("rest", "newton", {"x": between, "g": forces})(x0=guess.ravel())["x"]
    return np.concatenate([np.array(found).ravel(), END, np.zeros(velocity.numel())])
