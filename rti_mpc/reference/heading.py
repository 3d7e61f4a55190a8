# SPDX-License-Identifier: Apache-2.0
r"""
Headings along the path of a point: the tangent, and the heading that a unicycle can follow.

The paper's reference point lies a distance `a` ahead of the axle. Exact tracking of its
path leaves no freedom: with :math:`\dot x = u \cos\psi - a \omega \sin\psi`
and :math:`\dot y = u \sin\psi + a \omega \cos\psi` the heading must obey

.. math::

    \dot\psi = (-\dot x_d \sin\psi + \dot y_d \cos\psi) / a ,

the *consistent* heading. On a curve it differs from the tangent, which the
point could only follow with an error.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from rti_mpc.array import Array
from rti_mpc.errors import OcpError

MAX_LAPS = 50  # until a heading must have repeated
RK4_STEP_S = 0.005  # of the consistent heading, whose rates are below a few 1/s
MIN_SPEED_M_S = 1e-9  # a slower motion has no direction

Curve = Callable[[Array], Array]


def tangent(velocity: Curve, t: Array) -> Array:
    """
    Direction of motion, unwrapped along `t`; constant where there is no motion.

    Args:
        velocity: Velocity of the path, ``(M,)`` to ``(M, 2)``, in m/s.
        t: Times, shape ``(M,)``, in s.

    Returns:
        Headings, shape ``(M,)``, in rad; zeros if nothing moves.
    """
    v = velocity(t)
    moving = np.hypot(v[:, 0], v[:, 1]) > MIN_SPEED_M_S
    if not moving.any():
        return np.zeros(len(t))
    last = np.maximum.accumulate(np.where(moving, np.arange(len(t)), np.argmax(moving)))
    return np.unwrap(np.arctan2(v[last, 1], v[last, 0]))


def consistent(velocity: Curve, t: Array, a: float, psi0: float) -> Array:
    """
    Heading with which a point `a` ahead of the axle follows its path exactly.

    Args:
        velocity: Velocity of the path, ``(n,)`` to ``(n, 2)``, in m/s.
        t: Increasing times, shape ``(M,)``, in s.
        a: Distance of the point ahead of the axle, in m.
        psi0: Heading at ``t[0]``, in rad.

    Returns:
        Headings, shape ``(M,)``, in rad, continuous from `psi0`.
    """
    if len(t) < 2:
        return np.full(len(t), psi0)
    n = max(1, math.ceil(float(np.max(np.diff(t))) / RK4_STEP_S))
    h = np.repeat(np.diff(t) / n, n)
    start = (t[:-1, None] + np.diff(t)[:, None] * (np.arange(n) / n)).ravel()
    v = np.stack([velocity(start), velocity(start + 0.5 * h), velocity(start + h)], axis=1).reshape(-1, 6) / a
    psi = psi0
    trace = [psi]
    for dt, (x0, y0, x1, y1, x2, y2) in zip(h.tolist(), v.tolist(), strict=True):
        k_1 = y0 * math.cos(psi) - x0 * math.sin(psi)
        mid = psi + 0.5 * dt * k_1
        k_2 = y1 * math.cos(mid) - x1 * math.sin(mid)
        mid = psi + 0.5 * dt * k_2
        k_3 = y1 * math.cos(mid) - x1 * math.sin(mid)
        end = psi + dt * k_3
        k_4 = y2 * math.cos(end) - x2 * math.sin(end)
        psi += dt * (k_1 + 2.0 * k_2 + 2.0 * k_3 + k_4) / 6.0
        trace.append(psi)
    return np.array(trace[::n])


def periodic(velocity: Curve, lap_s: float, a: float, psi0: float) -> float:
    """
    Initial value of the consistent heading that repeats in every lap of a closed path.

    A wrong initial heading decays when driving forward, so laps are integrated from
    `psi0` until one ends as it began.

    Raises:
        OcpError: No heading repeats: the path is too tight for a point so far ahead of the axle.
    """
    t = np.linspace(0.0, lap_s, max(2, math.ceil(lap_s / RK4_STEP_S) + 1))
    for _ in range(MAX_LAPS):
        end = float(consistent(velocity, t, a, psi0)[-1])
        change = math.remainder(end - psi0, math.tau)
        psi0 = math.remainder(end, math.tau)
        if abs(change) < 1e-12:
            return psi0
    raise OcpError(
        f"the path must be wide enough for a consistent heading to repeat every lap, a point {a} m ahead of the axle still turns by {change:.3g} rad"
    )
