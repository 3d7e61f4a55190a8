# SPDX-License-Identifier: Apache-2.0
"""
The inputs already sent, which the robot plays until the next command acts.

Commands are believed to act as soon as they can, unless a robot that reports its inputs
shows something else (`rti_mpc.contract.belief`).
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from struct import Struct

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.approach import SLEW_WINDOW_PERIODS, Increments
from rti_mpc.contract.belief import Belief
from rti_mpc.contract.message import Command
from rti_mpc.contract.schedule import BEFORE_ALL_NS, UNKNOWN, Plan, Schedule, end_ns
from rti_mpc.rotation import Rotations

TRANSIT_PERIODS = 0.1  # a command may take this long to arrive; the plan before it acts until then


class Sent:
    """
    The last commands, as the robot plays them if none arrives later than expected.

    Attributes:
        delay_ns: A command acts no earlier than this long after the state that it answers, even if its own time is earlier.
        u_prev: Input that acts before the time of the last `reach`, shape ``(nu,)``; overwritten by the next one.
    """

    def __init__(
        self,
        u_rest: Array,
        lbdu: Array,
        ubdu: Array,
        dt_ns: int,
        bounds: tuple[float | Array, float | Array] = (-inf, inf),
        rotations: Rotations = UNKNOWN,
    ) -> None:
        self.delay_ns = 0
        self._left_ns = BEFORE_ALL_NS  # when the last command left at the earliest
        self._alone: tuple[int, Array] = (BEFORE_ALL_NS, u_rest)  # when the robot last stopped braking on its own, and from which input
        self._went: Plan | None = None  # the plan whose way to rest it went until then, if it had one
        self._feeds_back = False  # whether any command had a way to rest that states correct
        # Per dt. Lists: for a few numbers, plain floats are several times faster than arrays.
        self._falling, self._rising = lbdu.tolist(), ubdu.tolist()
        rows: Array = np.zeros((5, len(u_rest)))
        self._reach, self.u_prev = (rows[:2], rows[2:4]), rows[4]
        self._rows, self._write = rows.data, Struct(f"{rows.size}d").pack_into  # by one call
        self._dt_ns = dt_ns
        self._transit_ns, self._window_ns = round(TRANSIT_PERIODS * dt_ns), round(SLEW_WINDOW_PERIODS * dt_ns)
        slew = 1e9 * np.minimum(-lbdu, ubdu) / dt_ns
        increments = Increments(lbdu, ubdu, dt_ns)
        self._schedule = Belief(u_rest, slew, increments, bounds, rotations)
        self._slowest = Schedule(u_rest, slew, increments, bounds, rotations)  # the same if each command took the longest transit time

    def append(self, command: Command, left_ns: int = BEFORE_ALL_NS) -> None:
        """
        Remember a command that has left, unless it expires before it can act: then the robot refuses it.

        Args:
            command: The command.
            left_ns: Earliest robot time at which it left, if that is known: the command before acts at least until then.
        """
        self._feeds_back |= len(command.K) > 0
        self._left_ns = left_ns = max(self._left_ns + 1, left_ns)  # commands leave one after the other, whatever our idea of the robot's clock
        start_ns, over_ns = max(command.stamp_ns, command.state_stamp_ns + self.delay_ns, left_ns), end_ns(command)
        if start_ns < over_ns:
            acting = self._schedule.acting(start_ns - 1)
            if acting is None or acting.end_ns < start_ns:
                self._alone, self._went = (start_ns, self._schedule.at(start_ns - 1)[0].copy()), acting
            self._schedule.add(command, start_ns, over_ns, approached=False)
        start_ns = max(start_ns, left_ns + self._transit_ns)
        if start_ns < over_ns:
            self._slowest.add(command, start_ns, over_ns, approached=False)
        self._slowest.forget(command.state_stamp_ns - self._dt_ns)  # `reach` looks back by less, from the time of a later command

    def expects(self, t_ns: int, u: Array, source: tuple[int, int]) -> bool:
        """Whether `correct` would find what is believed."""
        return self._schedule.expects(t_ns, u, source)

    def correct(self, t_ns: int, u: Array, source: tuple[int, int]) -> bool:
        """Correct the belief by the input that the robot reports, see `Belief.correct`; return whether it was another than believed."""
        changed = self._schedule.correct(t_ns, u, source)
        if changed:
            self._slowest.copy(self._schedule)
            self._alone = BEFORE_ALL_NS, self._schedule.u_rest
        return changed

    def feed_back(self, x: Array, t_ns: int) -> None:
        """Take note of a state, shape ``(nx,)``: it corrects a way to rest that needs feedback, as whoever plays it does, from its time on."""
        if self._feeds_back:
            for schedule in (self._schedule, self._slowest):
                schedule.feed_back(x, t_ns, t_ns)

    @property
    def confirmed(self) -> int:
        """Consecutive reports of the robot that have named the expected command."""
        return self._schedule.confirmed

    def brake(self, before_ns: int, now_ns: int) -> None:
        """
        Assume that the robot, whose clock has jumped from one time to another, brakes from the input that acted.

        If it was no jump, but a clock that is faster than known yet, the commands went on to act: the next plan is near to either input.
        """
        self._left_ns = BEFORE_ALL_NS
        if now_ns > before_ns:
            self._alone, self._went = (now_ns, self._schedule.at(now_ns)[0].copy()), None
        for schedule in (self._schedule, self._slowest):
            schedule.cut(before_ns, now_ns)

    def clear(self) -> None:
        """Forget everything: the robot was restarted, and is at rest."""
        self._left_ns = BEFORE_ALL_NS
        self._alone, self._went = (BEFORE_ALL_NS, self._schedule.u_rest), None
        for schedule in (self._schedule, self._slowest):
            schedule.brake(schedule.u_rest, BEFORE_ALL_NS)

    def spans(self, from_ns: int, to_ns: int) -> Iterator[tuple[Array, float]]:
        """Yield the inputs that act between two times, shape ``(nu,)``, each with its duration in s; backward, the one that acts at `to_ns`."""
        if to_ns < from_ns:
            yield self.at(to_ns)[0], 1e-9 * (to_ns - from_ns)
        while from_ns < to_ns:
            u, change_ns = self.at(from_ns)
            until_ns = min(change_ns, to_ns)
            yield u, 1e-9 * (until_ns - from_ns)
            from_ns = until_ns

    def at(self, t_ns: int) -> tuple[Array, int]:
        """Return the input that acts at a time, shape ``(nu,)``, and when it next changes."""
        u, change_ns, _ = self._schedule.at(t_ns)
        return u, change_ns

    def reach(self, t_ns: int) -> tuple[Array, Array]:
        """
        Return the lowest and the highest first two rows of a plan, each of shape ``(2, nu)``; the next call overwrites them.

        Row 0 takes over at `t_ns`, or up to one period later. It must be within the slew
        limits of every input that acts in the period before, and of those that act until
        it arrives; row 1 must be within the limits of the latter. Then the inputs change
        by no more than the limits within any period, whenever the plan arrives, and
        within three quarters of a period, however long commands are on their way.
        Where the robot brakes on its own, this leaves it the speed that it has. The plan
        that ended the braking may itself be late, and the robot have braked further.
        """
        acted = self._schedule.acted(t_ns, t_ns + self._dt_ns)
        ended_ns, u = self._alone
        if abs(t_ns - ended_ns) < self._dt_ns:
            way, share = self._schedule.u_rest - u, (t_ns + self._dt_ns - ended_ns) / self._dt_ns
            further = u + np.clip(way, share * np.array(self._falling), share * np.array(self._rising))
            if self._went is not None and self._went.way is not None:
                further = self._schedule.after(self._went, t_ns + self._dt_ns)[0]
            acted.append(further.tolist())
        later = len(acted)
        lowest = [value + fall for value, fall in zip(acted[0], self._falling, strict=True)]
        highest = [value + rise for value, rise in zip(acted[0], self._rising, strict=True)]
        if later > 1:
            self._narrow(lowest, highest, acted[1:])
        second = lowest.copy(), highest.copy()
        before = self._schedule.acted(t_ns - self._dt_ns + 1, t_ns)  # the input of `t_ns` has narrowed them already
        for values in before + self._slowest.acted(t_ns - self._window_ns, t_ns + self._transit_ns + 1):
            if values not in acted:  # a second time it would narrow no interval
                acted.append(values)
        if len(acted) > later:
            self._narrow(lowest, highest, acted[later:])
        self._write(self._rows, 0, *lowest, *second[0], *highest, *second[1], *before[-1])
        return self._reach

    def _narrow(self, lowest: list[float], highest: list[float], acted: list[list[float]]) -> None:
        """Narrow intervals to what is within the slew limits of all inputs; where that leaves nothing, to the nearest value."""
        falling, rising = self._falling, self._rising
        for values in acted:
            for j, value in enumerate(values):
                least, most = lowest[j], highest[j]
                if (low := value + falling[j]) > least:
                    lowest[j] = least = most if most < low else low
                if (high := value + rising[j]) < most:
                    highest[j] = least if least > high else high
