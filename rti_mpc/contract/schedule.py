# SPDX-License-Identifier: Apache-2.0
"""
Schedule of inputs: the command contract as a function of time.

Row ``i`` of the newest plan whose time has come acts from ``stamp_ns + i * period_ns``,
but never before the plan has arrived. A plan ahead of its time waits while the previous
one continues. A plan that does not begin at the present input is approached inside the
slew limits (`rti_mpc.contract.approach`). When a plan has ended, its own way to rest acts
(`rti_mpc.contract.way`), approached likewise, and the last row of that is held. If the plan
came with none, the inputs ramp to rest inside the slew limits, and stay there. The robot
plays the schedule; guard and controller compute from it what the robot does.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.approach import Increments, approach, segments, within
from rti_mpc.contract.message import Command
from rti_mpc.contract.way import Way
from rti_mpc.rotation import Rotations

RAMP_STEP_NS = 10_000_000  # the ramp to rest is a staircase of steps of this duration
NEVER_NS = 2**63  # later than every time
BEFORE_ALL_NS = -(2**62)  # earlier than every time
MAX_PLANS = 64  # plans that are kept, those ahead of their time included
MAX_ROWS = 1000  # rows of a plan, the longest horizon a configuration may have, and of a way to rest
ROWS_AT_ONCE = 32  # rows of a way to rest that are approached at once; later ones wait until they are asked for
MAX_CORRECTIONS = 16  # per period, of a way to rest by states: each is a plan that is kept
WAY_ROUNDING = 1e-9  # relative: so that a way to rest of a whole number of steps takes no further one
NO_COMMAND = (0, 0)  # epoch and sequence number of inputs that come from no command
UNKNOWN = Rotations()  # of a robot whose states are not known


def unfit(command: Command, nu: int, robot_epoch: int, nx: int | None = None) -> str:
    """Return why a command cannot be a plan for this life of a robot with `nu` inputs and `nx` states, if those are known; empty if it can."""
    if command.state_epoch != robot_epoch:
        return "foreign_epoch"
    if command.u.ndim != 2 or not 1 <= len(command.u) <= MAX_ROWS or command.u.shape[1] != nu or command.period_ns <= 0:
        return "wrong_shape"
    rows, states, gain = command.u_rest, command.x_rest, command.K
    if any(array.ndim != 2 for array in (rows, states, gain)) or not _fits(rows.shape, states, gain, nu, nx):
        return "wrong_shape"
    if len(rows) and command.rest_period_ns <= 0:
        return "wrong_shape"
    return "" if all(np.isfinite(array).all() for array in (command.u, rows, states, gain)) else "not_finite"


def _fits(rows: tuple[int, ...], states: Array, gain: Array, nu: int, nx: int | None) -> bool:
    """Whether the arrays of a way to rest belong together: none, rows alone, or rows with a state each and a gain."""
    if not rows[0]:
        return not len(states) and not len(gain)
    if rows[0] > MAX_ROWS or rows[1] != nu:
        return False
    if not len(states) and not len(gain):
        return True
    width = states.shape[1]
    return len(states) == rows[0] and width > 0 and nx in (None, width) and gain.shape == (nu, width)


def end_ns(command: Command) -> int:
    """Return when the last row of a command ends, or its validity if that is earlier."""
    return min(command.valid_until_ns, command.stamp_ns + len(command.u) * command.period_ns)


@dataclass(slots=True)
class Plan:
    """
    Rows of inputs that act from `start_ns` until `end_ns`.

    Attributes:
        stamp_ns: When row 0 would act.
        period_ns: Time between rows.
        asked: Rows as they were commanded, shape ``(n, nu)``.
        u: Rows as they act, shape ``(n, nu)``.
        before: Input that acted before the plan, shape ``(nu,)``.
        source: Epoch and sequence number of the command it comes from; zeros for inputs that come from no command.
        way: Way to rest after its end; None for the ramp.
        rest: Input to which the ramp after its end leads, shape ``(nu,)``; None for the model's rest.
        pause_ns: Time from its end until the ramp to rest begins, shape ``(nu,)``; None until it is computed.
        following: Next rows of its way to rest, as they act; None until they are computed.
    """

    start_ns: int
    end_ns: int
    stamp_ns: int
    period_ns: int
    asked: Array
    u: Array
    before: Array
    source: tuple[int, int] = NO_COMMAND
    way: Way | None = None
    rest: Array | None = None
    pause_ns: Array | None = None
    following: Plan | None = None

    def row(self, t_ns: int) -> int:
        """Return the row of a time."""
        return max(0, min((t_ns - self.stamp_ns) // self.period_ns, len(self.u) - 1))

    def shift(self, by_ns: int) -> None:
        """Move it in time, with what acts after its end as it was found: what that was found from may be forgotten."""
        self.start_ns += by_ns
        self.end_ns += by_ns
        self.stamp_ns += by_ns
        if self.way is not None:
            self.way = self.way.moved(self.way.stamp_ns + by_ns)
        if self.following is not None:
            self.following = replace(self.following)
            self.following.shift(by_ns)

    def forget_end(self) -> None:
        """Have what acts after its end found anew."""
        self.pause_ns = self.following = None


class Schedule:
    """
    The plans of one robot.

    The ramp to rest goes at the rate of the slew limits, and begins later where the last
    rows have just used them: over any duration the change stays inside the limits.
    """

    def __init__(
        self,
        u_rest: Array,
        slew: Array,
        increments: Increments | None = None,
        bounds: tuple[float | Array, float | Array] = (-np.inf, np.inf),
        rotations: Rotations = UNKNOWN,
    ) -> None:
        """
        Begin at rest.

        Args:
            u_rest: Input at rest, shape ``(nu,)``.
            slew: Largest rate of the ramp to rest, shape ``(nu,)``, in the input's unit per s; infinite where there is no limit.
            increments: Slew limits inside which plans are approached; None: their rows act as they are.
            bounds: Of the inputs on a way to rest, with what feedback adds to them, shape ``(nu,)``.
            rotations: Among the states that are fed back.
        """
        self.u_rest: Array = np.array(u_rest, dtype=np.float64)
        self._slew = 1e-9 * np.asarray(slew, dtype=np.float64)  # per ns
        self._increments = increments
        self._bounds = bounds
        self._rotations = rotations
        self._kept_ns = 0 if increments is None else increments.dt_ns  # for how long what has acted counts against slew limits
        self._spacing_ns = self._kept_ns // MAX_CORRECTIONS
        self._plans: deque[Plan] = deque()  # by start; those of the past as far as `forget` has left them
        self.brake(self.u_rest, BEFORE_ALL_NS)

    def __len__(self) -> int:
        """Return how many plans are kept."""
        return len(self._plans)

    def brake(self, u: Array, t_ns: int) -> None:
        """Drop every plan: the inputs ramp to rest from `u`, shape ``(nu,)``, beginning at a time."""
        self._plans.clear()
        u = np.array(u, dtype=np.float64)
        rows = np.vstack([u])  # no view: snapshots take memory that others own for what compiled code is bound to
        self._plans.append(Plan(t_ns, t_ns, t_ns, 1, rows, rows, u))

    def cut(self, t_ns: int, now_ns: int) -> None:
        """End the plan that acts at a time there, and drop later ones; the robot's clock has jumped since, and that time is now `now_ns`."""
        plans, shift_ns = self._plans, now_ns - t_ns
        while plans and plans[-1].start_ns > t_ns:
            first = plans.pop()
        if not plans:  # a time that is forgotten
            self.brake(first.before, now_ns)
            self._plans[-1].way = None if first.way is None else first.way.moved(now_ns)
            return
        last = plans[-1]
        last.pause_ns = None
        if last.end_ns > t_ns:
            last.end_ns, last.way = t_ns, None if last.way is None else last.way.moved(t_ns)
            last.forget_end()
        for plan in plans:
            plan.shift(shift_ns)

    def add(self, command: Command, start_ns: int, end_ns: int, *, approached: bool = True) -> Array:
        """
        Add the plan of a command; plans that would start after it never act.

        Args:
            command: The command.
            start_ns: When it begins to act.
            end_ns: When it ends.
            approached: Whether its rows are brought inside the slew limits of what acts before, if this schedule has any.

        Returns:
            Its rows as they will act, shape ``(n, nu)``.
        """
        u = command.u.copy()
        source, way = (command.epoch, command.seq), Way.of(command, end_ns)
        plan = Plan(start_ns, end_ns, command.stamp_ns, command.period_ns, u, u, u[0], source, way)
        return self._put(plan, self._increments) if approached else self._insert(plan)

    def _put(self, plan: Plan, limits: Increments | None) -> Array:
        """Add a plan, approached inside the limits from the inputs that act before it."""
        plan.forget_end()
        plan.u = self._approach(plan.asked, plan.stamp_ns, plan.period_ns, plan.start_ns, limits)
        return self._insert(plan)

    def _insert(self, plan: Plan) -> Array:
        """Add a plan as it is, and return its rows."""
        plans, start_ns = self._plans, plan.start_ns
        plan.before = self.at(start_ns - 1)[0].copy()
        while plans and plans[-1].start_ns >= start_ns:
            plans.pop()
        plans.append(plan)
        if len(plans) > MAX_PLANS:
            del plans[1]
        return plan.u

    def copy(self, other: Schedule) -> None:
        """Take the plans of another schedule."""
        self._plans = deque(replace(plan) for plan in other._plans)

    def forget(self, t_ns: int) -> None:
        """Drop plans that are over before a time, and count against no slew limit any more."""
        plans = self._plans
        t_ns -= self._kept_ns
        while len(plans) > 1 and plans[1].start_ns <= t_ns:
            plans.popleft()

    def approached(self, command: Command, start_ns: int) -> Array:
        """Return the rows of a command, shape ``(n, nu)``, as they would act from a time on."""
        return self._approach(command.u, command.stamp_ns, command.period_ns, start_ns, self._increments)

    def nearest(self, u: Array, t_ns: int) -> Array:
        """Return the input nearest to `u`, shape ``(nu,)``, that may begin to act at a time inside the slew limits."""
        limits = self._increments
        return u if limits is None else within(u, segments(self.at, t_ns - limits.dt_ns, t_ns), t_ns - limits.dt_ns, limits)

    def feed_back(self, x: Array | None, stamp_ns: int, t_ns: int) -> bool:
        """
        Correct the way to rest that acts at a time, from then on, by a state; plans that come later are approached anew.

        Args:
            x: State, shape ``(nx,)``; None: none is known any more, and the way's rows act as they are.
            stamp_ns: Its time.
            t_ns: From when on the correction acts.

        Returns:
            Whether it changes what acts.
        """
        plan, plans = self.acting(t_ns), self._plans
        if plan is None or plan.way is None or t_ns < plan.end_ns:
            return False
        way = plan.way.corrected(x, stamp_ns, self._rotations)
        if way is plan.way or (plan.start_ns == plan.end_ns > t_ns - self._spacing_ns and x is not None):
            return False
        u = self.at(t_ns - 1)[0]
        later: list[Plan] = []
        while plans[-1].start_ns > t_ns:
            later.append(plans.pop())
        self._put(Plan(t_ns, t_ns, t_ns, 1, u[None], u[None], u, plan.source, way), None)
        for coming in reversed(later):
            self._put(coming, self._increments)
        return True

    def way(self, t_ns: int) -> Way | None:
        """Return the way to rest that acts at a time, or that will after the plan which does; None for the ramp."""
        plan = self.acting(t_ns)
        return None if plan is None else plan.way

    def rest(self, t_ns: int) -> Array:
        """Return what the inputs come to, shape ``(nu,)``, after what acts at a time."""
        way = self.way(t_ns)
        return self.u_rest if way is None else self._demanded(way)[-1]

    def rests(self, t_ns: int, tolerance: float | Array = 0.0) -> bool:
        """Return whether the inputs have come to their rest at a time, but for a tolerance, shape ``(nu,)``, and stay there after what acts."""
        plan, rest = self.acting(t_ns), self.rest(t_ns)
        rows = [self.at(t_ns)[0][None]]
        while plan is not None and plan.way is not None:
            if t_ns < plan.end_ns:
                rows.append(plan.u[plan.row(t_ns) : plan.row(plan.end_ns - 1) + 1])
            plan = self._following(plan)
        if plan is not None and plan.rest is not None and t_ns < plan.end_ns:
            rows.append(plan.u[plan.row(t_ns) :])
        return bool((np.abs(np.vstack(rows) - rest) <= tolerance).all())

    def pending(self, t_ns: int) -> bool:
        """Return whether a plan is to begin after a time."""
        return self._plans[-1].start_ns > t_ns

    def acting(self, t_ns: int) -> Plan | None:
        """Return the plan whose rows, or way to rest, act at a time; None for a time that is forgotten."""
        for plan in reversed(self._plans):
            if plan.start_ns <= t_ns:
                return plan
        return None

    def source(self, t_ns: int) -> tuple[int, int]:
        """Return epoch and sequence number of the command whose plan acts at a time; zeros where none does."""
        plan = self.acting(t_ns)
        return NO_COMMAND if plan is None or t_ns >= plan.end_ns else plan.source

    def at(self, t_ns: int) -> tuple[Array, int, bool]:
        """Return the input that acts at a time, shape ``(nu,)``, the time until which it acts, and whether no plan acts."""
        change_ns = NEVER_NS
        for plan in reversed(self._plans):
            if plan.start_ns <= t_ns:
                break
            change_ns = plan.start_ns
        else:
            return plan.before, change_ns, True  # a time that is forgotten
        u, step_ns = self.after(plan, t_ns)
        return u, step_ns if step_ns < change_ns else change_ns, t_ns >= plan.end_ns

    def acted(self, from_ns: int, to_ns: int) -> list[list[float]]:
        """Return the inputs that act in an interval, oldest first, each as a list: for a few numbers, plain floats are faster than arrays."""
        rows: list[list[float]] = []
        until_ns = to_ns
        for plan in reversed(self._plans):
            begins_ns, stamp_ns, period_ns = plan.start_ns, plan.stamp_ns, plan.period_ns
            if begins_ns < from_ns:
                begins_ns = from_ns
            if begins_ns >= until_ns:
                continue
            row, last = (begins_ns - stamp_ns) // period_ns, (until_ns - 1 - stamp_ns) // period_ns
            if row < 0 or last >= len(plan.u) or until_ns > plan.end_ns:
                break
            rows = plan.u[row : last + 1].tolist() + rows
            if begins_ns == from_ns:
                return rows
            until_ns = begins_ns
        return [u.tolist() for _, u in segments(self.at, from_ns, to_ns)]  # a row is held, a ramp or a way to rest acts, or a time is forgotten

    def after(self, plan: Plan, t_ns: int) -> tuple[Array, int]:
        """Return the input that acts at a time of a plan, or after it, if no other plan comes, and until when it does."""
        while t_ns >= plan.end_ns:
            if plan.way is None:
                return self._ramp(plan, t_ns)
            plan = self._following(plan)
        row, last = (t_ns - plan.stamp_ns) // plan.period_ns, len(plan.u) - 1
        if row >= last:
            return plan.u[last], plan.end_ns
        if row < 0:
            row = 0
        row_end_ns = plan.stamp_ns + (row + 1) * plan.period_ns
        return plan.u[row], row_end_ns if row_end_ns < plan.end_ns else plan.end_ns

    def _following(self, plan: Plan) -> Plan:
        """Return the next rows of a plan's way to rest, as they act; where slew limits do not let them come to the last one, the ramp does."""
        if plan.following is None:
            assert plan.way is not None
            left, start_ns = plan.way.ahead(plan.end_ns), plan.end_ns
            asked = self._demanded(left)[:ROWS_AT_ONCE]
            u = self._approach(asked, left.stamp_ns, left.period_ns, start_ns, self._increments, late=False)
            end_ns = left.stamp_ns + len(u) * left.period_ns
            last = len(u) == len(left.u)
            way, rest = (None, asked[-1]) if last else (left, None)
            plan.following = Plan(start_ns, end_ns, left.stamp_ns, left.period_ns, asked, u, plan.before, NO_COMMAND, way, rest)
        return plan.following

    def _demanded(self, way: Way) -> Array:
        """Return the rows of a way to rest with what feedback adds to them, inside the bounds, shape ``(M, nu)``."""
        rows: Array = np.clip(way.u + way.correction, *self._bounds)
        return rows

    def _approach(self, u: Array, stamp_ns: int, period_ns: int, start_ns: int, limits: Increments | None, *, late: bool = True) -> Array:
        """Return rows as they act from a time on, inside limits, if there are any, of what acts before it."""
        if limits is None:
            return u
        return approach(u, stamp_ns, period_ns, start_ns, segments(self.at, start_ns - limits.dt_ns, start_ns), limits, late=late)

    def _ramp(self, plan: Plan, t_ns: int) -> tuple[Array, int]:
        """Return the input at a time after the end of a plan, and when the ramp steps next."""
        last = plan.u[plan.row(plan.end_ns - 1)]
        rest = self.u_rest if plan.rest is None else plan.rest
        way = rest - last
        if plan.pause_ns is None:
            plan.pause_ns = self._pause_ns(plan, last, way)
        steps = np.floor((t_ns - plan.end_ns - plan.pause_ns) / RAMP_STEP_NS) + 1.0
        with np.errstate(invalid="ignore"):  # no slew limit, no step: 0 * inf is no way at all
            reach = np.where(steps > 0.0, steps * (RAMP_STEP_NS * self._slew), 0.0)
        rests = np.abs(way) <= reach * (1.0 + WAY_ROUNDING)
        if rests.all():
            return rest, NEVER_NS
        next_ns = plan.pause_ns + RAMP_STEP_NS * np.maximum(steps, 0.0)
        return np.where(rests, rest, last + np.clip(way, -reach, reach)), plan.end_ns + int(np.ceil(next_ns[~rests].min()))

    def _pause_ns(self, plan: Plan, last: Array, way: Array) -> Array:
        """
        Return how long the ramp waits after the end of a plan, because earlier jumps to the same side have used the slew limits, shape ``(nu,)``.

        An input that acted until some time counts until a ramp from it, begun at that time, would have reached the last row.
        """
        window_ns = plan.period_ns if self._increments is None else self._increments.dt_ns
        pause_ns: Array = np.zeros(len(last))
        for until_ns, u in segments(self.at, plan.end_ns - window_ns, plan.end_ns):
            jump = last - u
            with np.errstate(invalid="ignore"):
                paid_ns = np.where(jump * way > 0.0, np.minimum(np.abs(jump) / self._slew, window_ns), -np.inf)
            pause_ns = np.maximum(pause_ns, until_ns + RAMP_STEP_NS - plan.end_ns + paid_ns)
        return np.ceil(pause_ns)  # whole ns, so that a step has begun at the time that is returned for it
