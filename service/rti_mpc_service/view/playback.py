# SPDX-License-Identifier: Apache-2.0
"""Playback of the inputs that a robot was sent, row by row, from the plans that its guard passed on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from rti_mpc.array import Array
from rti_mpc.contract.message import Command
from rti_mpc.contract.status import Mode
from rti_mpc_service.view.timeline import MAX_AHEAD_NS


@dataclass(frozen=True, slots=True)
class Actuation:
    """
    A guard's message to the robot: a plan that it passed on, or a part of its own ramp to rest.

    Attributes:
        command: The command, numbered by the guard.
    """

    command: Command

    @property
    def u(self) -> Array:
        """Inputs, shape ``(N, nu)``."""
        return self.command.u


class PlayedRow(NamedTuple):
    """
    Inputs that the robot was sent, and that act from a time on.

    Attributes:
        time_ns: When they begin to act, on the robot's timeline.
        u: Inputs, shape ``(nu,)``.
        mode: Mode of their plan.
    """

    time_ns: int
    u: Array
    mode: Mode


class Playback:
    """
    Plays plans as the robot does: each until the next one begins, or until it has expired.

    A plan is therefore played only when the next one has come. A ramp that was sent
    in time but not needed leaves no row.

    Its rows lie as far apart on the timeline as the times of both plans tell, which is not
    a period where several robots share the timeline and this one's clock runs slower or faster.
    """

    def __init__(self) -> None:
        self._last: list[tuple[int, Command]] = []  # the last plan and its time; empty before the first one
        self._played_ns = -1  # time of the last played row

    def add(self, times: Sequence[int], actuations: Sequence[Actuation]) -> list[PlayedRow]:
        """Add plans, and return the rows that were played before the last of them begins."""
        plans = [*self._last, *zip(times, (actuation.command for actuation in actuations), strict=True)]
        self._last = plans[-1:]
        return [row for plan, after in pairwise(plans) for row in self._play(*plan, after[0], _pace(plan, after))]

    def end(self) -> list[PlayedRow]:
        """Return the rows of the last plan, if no other one follows."""
        return [row for time_ns, command in self._last for row in self._play(time_ns, command, time_ns + MAX_AHEAD_NS)]

    def _play(self, time_ns: int, command: Command, end_ns: int, pace: float = 1.0) -> list[PlayedRow]:
        rows = []
        period_ns = max(round(pace * command.period_ns), 1)
        end_ns = min(end_ns, time_ns + round(pace * (command.valid_until_ns - command.stamp_ns)))
        for begin_ns, u in zip(range(time_ns, end_ns, period_ns), command.u, strict=False):
            if min(begin_ns + period_ns, end_ns) > self._played_ns:  # skip rows that ended before the plan came
                self._played_ns = max(begin_ns, self._played_ns + 1)
                rows.append(PlayedRow(self._played_ns, u, command.mode))
        return rows


def _pace(plan: tuple[int, Command], after: tuple[int, Command]) -> float:
    """Return how much the timeline advances per time of the robot's clock, between two plans for one life of the robot."""
    (time_ns, command), (after_ns, next_command) = plan, after
    span_ns = next_command.stamp_ns - command.stamp_ns
    return (after_ns - time_ns) / span_ns if span_ns > 0 and next_command.state_epoch == command.state_epoch else 1.0
