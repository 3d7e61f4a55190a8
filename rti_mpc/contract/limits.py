# SPDX-License-Identifier: Apache-2.0
"""
Limits of what a robot may be commanded, by which a guard judges the rows of a plan and of its way to rest.

They hold no model: whether rows bring a robot to rest they cannot tell, only that the last
of them is held, and from when on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.approach import TOLERANCE_SHARE, magnitudes
from rti_mpc.contract.message import Command
from rti_mpc.contract.schedule import UNKNOWN, end_ns
from rti_mpc.rotation import Rotations

MAX_VALID_NS = 300_000_000  # robot time: a command ends at the latest this long after its state and the delay, whatever its own validity
SETTLED_SHARE = 0.01  # of the range of an input: a way to rest that is this close to its last row counts as rest


@dataclass(frozen=True, eq=False)
class Limits:
    """
    Limits of the commands to a robot.

    Attributes:
        u_rest: Input at which the robot stands still, shape ``(nu,)``.
        lbu: Lower bound of the inputs, shape ``(nu,)``.
        ubu: Upper bound of the inputs.
        lbdu: Lower bound of an input's change over `dt_s`, shape ``(nu,)``, below 0.
        ubdu: Upper bound of an input's change, above 0.
        dt_s: Period of the controller, s.
        delay_s: Delay from a state to the time at which its command acts, s.
        stale_s: Age from which neither a state nor a command that answers it is used, s of the robot.
        rotations: Among the states, for ways to rest that need feedback; of size 0: none is known, and none of those may pass.
    """

    u_rest: Array
    lbu: Array
    ubu: Array
    lbdu: Array
    ubdu: Array
    dt_s: float
    delay_s: float = 0.0
    stale_s: float = 0.25
    rotations: Rotations = UNKNOWN

    @cached_property
    def slew(self) -> Array:
        """Rate of the ramp to rest, shape ``(nu,)``, per s."""
        return np.minimum(-self.lbdu, self.ubdu) / self.dt_s

    @cached_property
    def step(self) -> Array:
        """By how much an input changes in one period at the rate of the ramp to rest, shape ``(nu,)``."""
        return self.slew * self.dt_s

    @cached_property
    def settling_s(self) -> float:
        """Time in s for which a command without a way to rest may still move the robot after its state: to its end, and down the ramp."""
        return self.delay_s + 1e-9 * MAX_VALID_NS + self.ramp_s

    @cached_property
    def ramp_s(self) -> float:
        """Longest time of the ramp to rest, s."""
        way = np.maximum(np.abs(self.lbu - self.u_rest), np.abs(self.ubu - self.u_rest))
        limited = np.isfinite(self.slew)
        ramp = np.where(limited, way / np.where(limited, self.slew, 1.0), 0.0)
        return float(np.minimum(ramp, 10.0).max(initial=0.0))

    def outlasts_s(self, command: Command) -> float:
        """Return by how much the way to rest of a command lasts longer than the ramp, s; 0 if it has none."""
        return max(0.0, 1e-9 * len(command.u_rest) * command.rest_period_ns - self.ramp_s)

    @cached_property
    def tolerance(self) -> Array:
        """By how much an input may be beyond a limit, or differ, by rounding, shape ``(nu,)``."""
        return np.asarray(TOLERANCE_SHARE * magnitudes(self.lbu, self.ubu, self.lbdu, self.ubdu))

    @cached_property
    def settled(self) -> Array:
        """How far from its last row a way to rest counts as rest, shape ``(nu,)``."""
        span = self.ubu - self.lbu
        return np.where(np.isfinite(span), SETTLED_SHARE * span, self.tolerance)

    def objection(self, command: Command) -> str:
        """Return what is wrong with the rows of a command, as a code and a reason; empty if nothing is."""
        if len(command.K) and self.rotations.size != command.K.shape[1]:
            return f"wrong_shape: its way to rest feeds {command.K.shape[1]} states back, of {self.rotations.size} that are known"
        for u, period_ns, of in judged(command):
            if (u < self.lbu - self.tolerance).any() or (u > self.ubu + self.tolerance).any():
                return f"out_of_bounds: inputs{of} reach from {u.min(axis=0).tolist()} to {u.max(axis=0).tolist()}"
            change, share = np.diff(u, axis=0), min(1.0, 1e-9 * period_ns / self.dt_s)
            if (change < share * self.lbdu - self.tolerance).any() or (change > share * self.ubdu + self.tolerance).any():
                return f"out_of_slew: rows{of} change by up to {np.abs(change).max(axis=0).tolist()}"
        return ""

    def settles_ns(self, command: Command, from_ns: int) -> int:
        """Return from when on a command with a way to rest of its own stays at the last row of it; a time, if it does from then on or has none."""
        if not len(command.u_rest):
            return from_ns
        ends_ns = end_ns(command)
        times = [min(command.stamp_ns + (i + 1) * command.period_ns, ends_ns) for i in range(len(command.u))]
        times += [ends_ns + (i + 1) * command.rest_period_ns for i in range(len(command.u_rest))]
        away = (np.abs(np.vstack([command.u, command.u_rest]) - command.u_rest[-1]) > self.settled).any(axis=1)
        return max((until_ns for until_ns, moves in zip(times, away, strict=True) if moves), default=from_ns)


def judged(command: Command) -> Iterator[tuple[Array, int, str]]:
    """Yield the rows of a command that are judged together, shape ``(n, nu)``, with the time between them and what they are."""
    yield command.u, command.period_ns, ""
    if len(command.u_rest):
        last = min((end_ns(command) - 1 - command.stamp_ns) // command.period_ns, len(command.u) - 1)
        yield np.vstack([command.u[last], command.u_rest[0]]), command.period_ns, " from the plan to its way to rest"
        yield command.u_rest, command.rest_period_ns, " to rest"
