# SPDX-License-Identifier: Apache-2.0
"""
The robot's side of the command contract: which input acts when, and what is refused.

Row ``i`` of the newest accepted command acts from ``stamp_ns + i * period_ns``,
never before it arrived; a command ahead of its time waits while the previous one
plays on. Nothing acts from `valid_until_ns` on, nor past the last row: then the
inputs ramp to rest inside the slew limits, and stay there. No clock: time is told.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rti_mpc.array import Array
from rti_mpc.message import Command
from rti_mpc.wire.source import Source

BRAKE_STEP_NS = 10_000_000  # the ramp to rest is a staircase of such steps
STALE_NS = 250_000_000  # silence after which another controller may take over, even one of a lower epoch
WAITING = 64  # commands ahead of their time kept at most


@dataclass(slots=True)
class Counters:
    """
    What became of commands since start.

    Attributes:
        lost: Missing sequence numbers.
        late: Arrived when their first row was already over; the remaining rows act.
        expired: Arrived when nothing of them could act any more.
        refused: Malformed, repeated, from another source, for another life of the robot, or not a plan of finite inputs.
        starved: How often a plan ran out in motion and the robot braked on its own.
    """

    lost: int = 0
    late: int = 0
    expired: int = 0
    refused: int = 0
    starved: int = 0


@dataclass(slots=True)
class Plan:
    """An accepted command: what it does from `start_ns` until `end_ns`."""

    start_ns: int
    end_ns: int
    stamp_ns: int
    period_ns: int
    u: Array


class Actuator:
    """
    Plays plans.

    Attributes:
        u: Input demanded now, shape ``(nu,)``.
        counters: What became of commands.
        braking: Whether no plan acts.
    """

    def __init__(self, u_rest: Array, slew: Array, epoch: int, delay_ns: int = 0) -> None:
        self.u = np.array(u_rest, dtype=np.float64)
        self.counters = Counters()
        self.braking = True
        self._rest = np.array(u_rest, dtype=np.float64)
        self._brake_step = 1e-9 * BRAKE_STEP_NS * np.asarray(slew, dtype=np.float64)  # (nu,), per step
        self._brake_ns = 0  # when the next step of the ramp is due
        self._robot_epoch = epoch
        self._delay_ns = delay_ns
        self._plans: deque[Plan] = deque()  # the one that acts, then those that wait, by start
        self._source = Source(STALE_NS)
        self._off = False

    @property
    def at_rest(self) -> bool:
        """Whether the inputs have come to rest."""
        return self.braking and bool(np.array_equal(self.u, self._rest))

    def accept(self, command: Command, arrival_ns: int) -> str:
        """
        Take a command, or refuse it. It can act from its arrival on, plus the delay of the actuators.

        Returns:
            The reason for refusing it, empty if it was taken.
        """
        rows = command.u.shape[0] if command.u.ndim == 2 else 0
        end_ns = min(command.valid_until_ns, command.stamp_ns + rows * command.period_ns)
        arrival_ns += self._delay_ns
        verdict = self._source.accept(command.epoch, command.seq, arrival_ns)
        self.counters.lost = self._source.lost
        if self._off:
            reason = "switched_off"
        elif not verdict.accepted:
            reason = verdict.value
        elif command.state_epoch != self._robot_epoch:
            reason = "foreign_epoch"
        elif not rows or command.u.shape[1] != len(self.u) or command.period_ns <= 0:
            reason = "wrong_shape"
        elif not np.isfinite(command.u).all():
            reason = "not_finite"
        elif end_ns <= max(arrival_ns, command.stamp_ns):
            reason = "expired"
        else:
            reason = ""
        if reason:
            self.counters.expired += reason == "expired"
            self.counters.refused += reason != "expired"
            return reason
        self.counters.late += arrival_ns >= command.stamp_ns + command.period_ns
        self._line_up(Plan(max(command.stamp_ns, arrival_ns), end_ns, command.stamp_ns, command.period_ns, command.u.copy()))
        return ""

    def play(self, from_ns: int, to_ns: int) -> Iterator[tuple[int, Array]]:
        """
        Tell which inputs act in an interval; intervals must follow one another.

        Yields:
            Until when, in ns, and the input held until then, shape ``(nu,)``: valid until the next one.
        """
        t = from_ns
        while t < to_ns:
            t = min(self._step(t), to_ns)
            yield t, self.u

    def switch_off(self) -> None:
        """Drop every plan and take no other: the inputs ramp to rest."""
        self._off = True
        self._plans.clear()

    def _line_up(self, plan: Plan) -> None:
        """Put a plan in line; those that would start after it never act."""
        while self._plans and self._plans[-1].start_ns >= plan.start_ns:
            self._plans.pop()
        self._plans.append(plan)
        if len(self._plans) > WAITING:
            del self._plans[1]

    def _step(self, t: int) -> int:
        """Set the input that acts at `t`, and tell until when it does."""
        plans = self._plans
        while len(plans) > 1 and plans[1].start_ns <= t:
            plans.popleft()
        change_ns = next((plan.start_ns for plan in plans if plan.start_ns > t), 2**63)
        if plans and plans[0].start_ns <= t < plans[0].end_ns:
            plan = plans[0]
            row = min((t - plan.stamp_ns) // plan.period_ns, len(plan.u) - 1)
            self.u[:] = plan.u[row]
            self.braking = False
            return int(min(change_ns, plan.end_ns, plan.stamp_ns + (row + 1) * plan.period_ns))
        if not self.braking:
            self.braking = True
            self.counters.starved += not (self._off or self.at_rest)
            self._brake_ns = t
        if self.at_rest:
            return change_ns
        if t >= self._brake_ns:
            way = self._rest - self.u
            np.copyto(self.u, np.where(np.abs(way) <= self._brake_step, self._rest, self.u + np.clip(way, -self._brake_step, self._brake_step)))
            self._brake_ns = t + BRAKE_STEP_NS
        return min(change_ns, self._brake_ns)
