# SPDX-License-Identifier: Apache-2.0
"""
Schedule of inputs as the sender of commands believes it, corrected by what the robot reports.

The state of a robot that reports says which input acts at its stamp, and which command
that input comes from. A command that should act by then and does not is still expected
for one period. After that it counts as lost: the plan before it acts, or the robot's own
ramp. If it arrives later after all, it is put back. If the report names an unknown
command (a guard numbers its commands itself), the input shows how many of the last
commands are missing. An input that no plan explains is believed as it is reported.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.approach import TOLERANCE_SHARE, Increments, magnitudes
from rti_mpc.contract.schedule import BEFORE_ALL_NS, UNKNOWN, Plan, Schedule
from rti_mpc.contract.way import Way
from rti_mpc.rotation import Rotations

START_TOLERANCE_PERIODS = 0.1  # a command may begin to act this much sooner or later than believed
OVERDUE_PERIODS = 1.0  # a command that does not act this long after its time is missing; until then it is still expected
MAX_MISSING_PLANS = 8  # missing plans that are remembered, since each may still arrive


class Belief(Schedule):
    """
    The plans of one robot, as their sender believes them to act.

    Attributes:
        confirmed: Consecutive reports that have named the expected command.
    """

    def __init__(
        self,
        u_rest: Array,
        slew: Array,
        increments: Increments,
        bounds: tuple[float | Array, float | Array] = (-np.inf, np.inf),
        rotations: Rotations = UNKNOWN,
    ) -> None:
        """Begin at rest; the arguments are those of `Schedule`."""
        self._missing: deque[Plan] = deque(maxlen=MAX_MISSING_PLANS)
        self.confirmed = 0
        self._magnitudes: list[float] = magnitudes(*bounds, increments.lbdu, increments.ubdu).tolist()
        self._reported_ns = BEFORE_ALL_NS  # stamp of the last report
        self._period_ns = increments.dt_ns
        self._overdue_ns = round(OVERDUE_PERIODS * increments.dt_ns)
        self._tolerance_ns = round(START_TOLERANCE_PERIODS * increments.dt_ns)
        super().__init__(u_rest, slew, increments, bounds, rotations)

    def brake(self, u: Array, t_ns: int) -> None:
        """Drop every plan: the inputs ramp to rest from `u`, shape ``(nu,)``, beginning at a time."""
        super().brake(u, t_ns)
        self._missing.clear()
        self._reported_ns = BEFORE_ALL_NS

    def cut(self, t_ns: int, now_ns: int) -> None:
        """End the plan that acts at a time there, and drop later ones; the robot's clock has jumped since, and that time is now `now_ns`."""
        super().cut(t_ns, now_ns)
        self._missing.clear()
        self._reported_ns = BEFORE_ALL_NS

    def correct(self, t_ns: int, u: Array, source: tuple[int, int]) -> bool:
        """
        Correct the belief by a report; reports must come in the order of their times.

        Args:
            t_ns: Time of the report.
            u: Input that acts, shape ``(nu,)``, finite and inside the bounds.
            source: Epoch and sequence number of the command it comes from, as `Schedule.add` was given it; number 0 is the robot's own ramp.

        Returns:
            Whether the belief was another.
        """
        before_ns, self._reported_ns = max(self._reported_ns, t_ns - self._period_ns), t_ns
        self.forget(before_ns - self._period_ns)
        if self.expects(t_ns, u, source):
            self.confirmed += source[1] > 0
            return False
        plans, coming = self._plans, deque[Plan]()
        while plans and plans[-1].start_ns > t_ns - self._overdue_ns:
            coming.appendleft(plans.pop())
        held = len(plans)
        self._find(source, u, t_ns, before_ns, coming)
        known = len(plans) > 0 and self._plays(u, t_ns, or_after=not coming)
        if not known:
            another = next((plan.way for plan in (*coming, *reversed(self._missing)) if plan.way is not None), None)
            self._take(source, u, t_ns, before_ns, another)
        if not known or len(plans) < held:
            self.confirmed = 0
        for plan in coming:
            if (start_ns := max(plan.start_ns, t_ns)) < plan.end_ns:
                self._put(replace(plan, start_ns=start_ns), self._increments)
        return True

    def expects(self, t_ns: int, u: Array, source: tuple[int, int]) -> bool:
        """Whether a report is what is believed; the arguments are those of `correct`."""
        return self._expects(source, t_ns) and self._plays(u, t_ns)

    def _expects(self, source: tuple[int, int], t_ns: int) -> bool:
        """Whether a command, or the robot's ramp, is believed to act at a time; true for a command of an unknown epoch, whose number says nothing."""
        for plan in reversed(self._plans):
            if plan.source == source and source[1] and plan.start_ns <= t_ns + self._tolerance_ns:
                return True
            if plan.start_ns <= t_ns - self._tolerance_ns:
                return plan.end_ns <= t_ns + self._tolerance_ns if not source[1] else all(plan.source[0] != source[0] for plan in self._plans)
        return False

    def _plays(self, u: Array, t_ns: int, *, or_after: bool = True) -> bool:
        """Whether an input is believed to act at a time or shortly before it; with `or_after`, shortly after it as well."""
        times = (t_ns - 1, t_ns, t_ns - self._tolerance_ns, t_ns + self._tolerance_ns) if or_after else (t_ns - 1, t_ns - self._tolerance_ns)
        reported = u.tolist()
        for t in times:
            believed = self.at(t)[0].tolist()
            if believed == reported or alike(believed, reported, self._magnitudes):
                return True
        return False

    def _find(self, source: tuple[int, int], u: Array, t_ns: int, before_ns: int, coming: deque[Plan]) -> None:
        """Remove the plans that are due after the one that acts: they are missing."""
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
            plans.append(replace(late, start_ns=max(before_ns + 1, late.stamp_ns), u=late.asked, pause_ns=None, following=None))
        else:
            known = list(plans)
            while plans and not self._plays(u, t_ns):
                plans.pop()
            missing.extend(known[len(plans) :] if plans else ())
            if not plans:
                plans.extend(known)

    def _take(self, source: tuple[int, int], u: Array, t_ns: int, before_ns: int, another: Way | None) -> None:
        """
        Believe that an input has acted since the last report; from now on the newest plan continues, or its way to rest, or the ramp.

        Where all that was to act by then is forgotten, the robot goes `another` way to rest that is known: one that needs a way is never without.
        """
        plans = self._plans
        newest = plans[-1] if plans else None
        while plans and plans[-1].start_ns > before_ns:
            plans.pop()
        u = u.copy()
        way = another if newest is None else newest.way if newest.end_ns <= t_ns else None
        plans.append(Plan(before_ns + 1, t_ns, before_ns + 1, self._period_ns, u[None], u[None], u, way=way))
        if newest is not None and source[1] and newest.end_ns > t_ns:
            self._put(replace(newest, start_ns=t_ns), self._increments)


def alike(believed: list[float], reported: list[float], largest: list[float]) -> bool:
    """Return whether two inputs are equal but for rounding, which is relative to the largest value of each, and to its own."""
    for one, other, most in zip(believed, reported, largest, strict=True):  # a loop: a generator takes twice as long for a few numbers
        if not abs(one - other) <= TOLERANCE_SHARE * (most + abs(other)):  # false for NaN, too
            return False
    return True
