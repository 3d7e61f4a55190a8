# SPDX-License-Identifier: Apache-2.0
"""Levels of the inputs between which a conformance test moves a robot, and healthy rows to them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.approach import SLEW_WINDOW_PERIODS
from rti_mpc.contract.limits import Limits
from rti_mpc.errors import ConfigError

ROWS = 20  # of a plan
MOST_STEPS = 2.0  # increments of a period between rest and a level: a robot moves no more than it must to be judged
MOST_SHARE = 0.9  # of the way from rest to a bound


@dataclass(frozen=True, eq=False)
class Levels:
    """
    Levels of the inputs of a robot.

    Attributes:
        rest: Inputs at rest, shape ``(nu,)``.
        step: How far each may move in a period, shape ``(nu,)``; infinite where there is no limit.
        high: Inputs as far above rest as a case moves them, below rest where it is a bound.
        low: Inputs as far on the other side, if the bounds allow it.
        near: How far from a level an input is on it.
    """

    rest: Array
    step: Array
    high: Array
    low: Array
    near: Array

    @classmethod
    def of(cls, limits: Limits) -> Levels:
        """
        Return those inside the limits of a robot.

        Raises:
            ConfigError: An input has no bound, or cannot move.
        """
        rest, step = limits.u_rest, limits.step
        up, down = (np.minimum(MOST_SHARE * way, MOST_STEPS * step) for way in (limits.ubu - rest, rest - limits.lbu))
        if not (np.isfinite(up) & np.isfinite(down)).all():
            raise ConfigError("ocp.bounds.inputs must bound every input: how far a test may move it is not known otherwise")
        if not (up + down > 0.0).any():
            raise ConfigError("ocp.bounds.inputs must leave an input room to move, got none")
        high, low = np.where(up > 0.0, rest + up, rest - down), np.where(up > 0.0, rest - down, rest)
        return cls(rest, step, high, low, limits.settled)

    def at(self, u: Array, level: Array) -> bool:
        """Whether inputs are on a level."""
        return bool((np.abs(u - level) <= self.near).all())

    def towards(self, u: Array, level: Array) -> Array:
        """Return the rows of a healthy plan from the inputs that act to a level, shape ``(ROWS, nu)``."""
        rows = [u + np.clip(level - u, -self.step, self.step)]
        while len(rows) < ROWS:
            rows.append(rows[-1] + np.clip(level - rows[-1], -self.step, self.step))
        return np.array(rows)

    def way(self, level: Array, held: int) -> Array:
        """Return the rows of a way to rest, shape ``(M, nu)``, that holds a level for some rows first."""
        count = max(1, math.ceil(np.max(np.abs(self.rest - level) / self.step)))
        down = [level + k / count * (self.rest - level) for k in range(1, count)]
        return np.array([level] * held + down + [self.rest])


def slew_share(times_ns: list[int], inputs: Array, levels: Levels, dt_ns: int) -> float:
    """
    Return the largest change of an input as a share of what slew limits allow in the time between two samples of it.

    No two inputs within three quarters of a period may differ by more than one increment: two samples that are further
    apart by as many more as such windows fit in between.

    Args:
        times_ns: Times of the samples.
        inputs: The samples, shape ``(M, nu)``.
        levels: Those of the robot.
        dt_ns: The period.
    """
    window_ns, share = SLEW_WINDOW_PERIODS * dt_ns, 0.0
    for i, since_ns in enumerate(times_ns):
        for k in range(i + 1, len(times_ns)):
            apart_ns = times_ns[k] - since_ns
            if k > i + 1 and apart_ns > window_ns:
                break
            share = max(share, float((np.abs(inputs[k] - inputs[i]) / ((apart_ns // window_ns + 1) * levels.step)).max()))
    return share


def shown(u: Array) -> str:
    """Return inputs as text."""
    return "[" + ", ".join(f"{value:.3g}" for value in u) + "]"
