# SPDX-License-Identifier: Apache-2.0
"""
Schedule of inputs as the sender of commands believes it, corrected by what the robot reports.

A state of a robot that reports tells which input acts at its stamp, and the command
that it comes from. Commands that should have acted by then and do not are believed to
come next, and taken out a period later: they are lost, and what acts instead is the plan before, or the robot's own
ramp. One that comes late after all is put back. Where the report names a command that
is not known (a guard has numbers of its own), the input itself tells how many of the
last commands are missing; an input that no plan explains is taken as it is.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.approach import Increments
from rti_mpc.contract.schedule import BEFORE_ALL_NS, Plan, Schedule

START_TOLERANCE_PERIODS = 0.1  # a command may begin to act this much sooner or later than believed
OVERDUE_PERIODS = 1.0  # a command that does not act this long after its time is missing; until then it is still expected
INPUT_TOLERANCE = 1e-6  # in the unit of the input, and relative to it: above the rounding of single precision
MAX_MISSING_PLANS = 8  # missing plans that are remembered, since each may still arrive


class Belief(Schedule):
    """
    The plans of one robot, as far as anybody knows who has sent them.

    Attributes:
        confirmed: Reports in a row that have named the command which was to act.
    """

    def __init__(self, u_rest: Array, slew: Array, increments: Increments) -> None:
        """Begin at rest; the arguments are those of `Schedule`."""
        self._missing: deque[Plan] = deque(maxlen=MAX_MISSING_PLANS)
        self.confirmed = 0
        self._reported_ns = BEFORE_ALL_NS  # stamp of the last report
        self._period_ns = increments.dt_ns
        self._overdue_ns = round(OVERDUE_PERIODS * increments.dt_ns)
        self._tolerance_ns = round(START_TOLERANCE_PERIODS * increments.dt_ns)
        super().__init__(u_rest, slew, increments)

    def brake(self, u: Array, t_ns: int) -> None:
        """Drop every plan: the inputs ramp to rest from `u`, shape ``(nu,)``, beginning at a time."""
        super().brake(u, t_ns)
        self._missing.clear()
        self._reported_ns = BEFORE_ALL_NS

    def cut(self, t_ns: int, now_ns: int) -> None:
        """Let what acts at a time end there, and drop what would follow; the clock has jumped since, and shows another time."""
        super().cut(t_ns, now_ns)
        self._missing.clear()
        self._reported_ns = BEFORE_ALL_NS

    def correct(self, t_ns: int, u: Array, source: tuple[int, int]) -> bool:
        """
        Take note of what acts; reports must come in the order of their times.

        Args:
            t_ns: When.
            u: Input that acts, shape ``(nu,)``, finite and inside the bounds.
            source: Epoch and sequence number of the command it comes from, as `Schedule.add` was given it; a number of 0: the robot's own ramp.

        Returns:
            Whether that was not known.
        """
        before_ns, self._reported_ns = max(self._reported_ns, t_ns - self._period_ns), t_ns
        self.forget(before_ns - self._period_ns)
        if self._expects(source, t_ns) and self._plays(u, t_ns):
            self.confirmed += source[1] > 0
            return False
        plans, coming = self._plans, deque[Plan]()
        while plans and plans[-1].start_ns > t_ns - self._overdue_ns:
            coming.appendleft(plans.pop())
        held = len(plans)
        self._find(source, u, t_ns, before_ns, coming)
        known = len(plans) > 0 and self._plays(u, t_ns, or_after=not coming)
        if not known:
            self._take(source, u, t_ns, before_ns)
        if not known or len(plans) < held:
            self.confirmed = 0
        for plan in coming:
            if (start_ns := max(plan.start_ns, t_ns)) < plan.end_ns:
                self._put(replace(plan, start_ns=start_ns), self._increments)
        return True

    def _expects(self, source: tuple[int, int], t_ns: int) -> bool:
        """Whether a command is believed to act at a time; also if it is of somebody who has numbers of his own."""
        for plan in reversed(self._plans):
            if plan.source == source and source[1] and plan.start_ns <= t_ns + self._tolerance_ns:
                return True
            if plan.start_ns <= t_ns - self._tolerance_ns:
                return plan.end_ns <= t_ns + self._tolerance_ns if not source[1] else all(plan.source[0] != source[0] for plan in self._plans)
        return False

    def _plays(self, u: Array, t_ns: int, *, or_after: bool = True) -> bool:
        """Whether an input is believed to act at a time, or nearly then; shortly before it only, unless `or_after`."""
        most = INPUT_TOLERANCE * (1.0 + np.abs(u))
        times = (t_ns - 1, t_ns, t_ns - self._tolerance_ns, t_ns + self._tolerance_ns) if or_after else (t_ns - 1, t_ns - self._tolerance_ns)
        return any((np.abs(self.at(t)[0] - u) <= most).all() for t in times)

    def _find(self, source: tuple[int, int], u: Array, t_ns: int, before_ns: int, coming: deque[Plan]) -> None:
        """Leave of the plans whose time has come those up to the one that acts."""
        plans, missing = self._plans, self._missing
        if not source[1]:
            while plans and plans[-1].end_ns > t_ns:
                missing.append(plans.pop())
        elif any(plan.source == source for plan in coming):  # sooner than believed
            while coming[0].source != source:
                missing.append(coming.popleft())
            plans.append(coming.popleft())
            plans[-1].start_ns = min(plans[-1].start_ns, t_ns)
        elif any(plan.source == source for plan in plans):
            while plans[-1].source != source:
                missing.append(plans.pop())
        elif (late := next((plan for plan in missing if plan.source == source), None)) is not None:
            missing.remove(late)
            while plans and plans[-1].start_ns > before_ns:
                plans.pop()
            plans.append(replace(late, start_ns=max(before_ns + 1, late.stamp_ns), u=late.asked, pause_ns=None))
        else:
            known = list(plans)
            while plans and not self._plays(u, t_ns):
                plans.pop()
            missing.extend(known[len(plans) :] if plans else ())
            if not plans:
                plans.extend(known)

    def _take(self, source: tuple[int, int], u: Array, t_ns: int, before_ns: int) -> None:
        """Believe that an input has acted since the last report; from here on the newest plan goes on, or the robot's own ramp."""
        plans = self._plans
        newest = plans[-1] if plans else None
        while plans and plans[-1].start_ns > before_ns:
            plans.pop()
        u = u.copy()
        plans.append(Plan(before_ns + 1, t_ns, before_ns + 1, self._period_ns, u[None], u[None], u))
        if newest is not None and source[1] and newest.end_ns > t_ns:
            self._put(replace(newest, start_ns=t_ns), self._increments)
