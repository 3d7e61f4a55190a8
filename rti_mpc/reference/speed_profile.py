# SPDX-License-Identifier: Apache-2.0
r"""
Speed profile of a path: the fastest one inside limits of acceleration, along its curvature.

Where the path bends by :math:`\kappa`, the speed is at most :math:`\sqrt{a_{lat} / |\kappa|}`. A pass forwards limits how fast it rises, one
backwards how fast it falls, both by what the lateral acceleration leaves of the tyres' grip [Kapania2016]_:

.. math::

    v_{k+1}^2 \le v_k^2 + 2 a \, \Delta s \sqrt{1 - (\kappa_k v_k^2 / a_{lat})^2} .
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.errors import ConfigError


@dataclass(frozen=True)
class SpeedLimits:
    """
    Limits of a speed profile.

    Attributes:
        speed: Largest speed, in m/s.
        lateral: Largest lateral acceleration, in m/s^2.
        acceleration: Largest acceleration along the path, in m/s^2.
        braking: Largest deceleration along the path, in m/s^2.

    Raises:
        ConfigError: One of them is not positive.
        OcpError: One of them is no number.
    """

    speed: float
    lateral: float
    acceleration: float
    braking: float

    def __post_init__(self) -> None:
        """Check that all are positive."""
        for name, value in vars(self).items():
            if not (math.isfinite(given.number(name, value)) and value > 0.0):
                raise ConfigError(f"{name} of the limits of a speed profile must be finite and above 0, got {value}")


def speed_profile(curvature: Array, step_m: float, limits: SpeedLimits, *, closed: bool, most: Array | None = None) -> Array:
    """
    Return the fastest profile inside limits.

    An open path ends at rest, and begins with the speed that a robot at rest reaches within one step, or it would never start.

    Args:
        curvature: At equal steps along the path, shape ``(n,)``, in 1/m; one step leads from the last of a closed path to its first.
        step_m: Distance between these, in m.
        limits: Limits.
        closed: Whether the path is closed.
        most: Further limit of the speeds, shape ``(n,)``, in m/s.

    Returns:
        Speeds, shape ``(n,)``, in m/s.
    """
    bend = np.abs(curvature)
    v2 = np.minimum(limits.speed**2, limits.lateral / np.maximum(bend, 1e-12))
    if most is not None:
        v2 = np.minimum(v2, np.square(most))
    if not closed:
        v2[0], v2[-1] = min(v2[0], 2.0 * limits.acceleration * step_m), 0.0
    share = bend / limits.lateral
    n = len(v2)
    start = int(np.argmin(v2))  # no pass lowers the slowest point, so that one lap from there is enough
    forwards = [(start + k) % n for k in range(n + 1)] if closed else list(range(n))
    for along, acceleration in ((forwards, limits.acceleration), (forwards[::-1], limits.braking)):
        for i, j in pairwise(along):
            v2[j] = min(v2[j], v2[i] + 2.0 * acceleration * step_m * math.sqrt(max(0.0, 1.0 - (share[i] * v2[i]) ** 2)))
    return np.sqrt(v2)


def profile_time_s(speed: Array, step_m: float, *, closed: bool) -> float:
    """Return how long a profile takes, in s, with constant acceleration within each step; arguments as of `speed_profile`."""
    following = np.append(speed[1:], speed[0]) if closed else speed[1:]
    return float(np.sum(2.0 * step_m / (speed[: len(following)] + following)))
