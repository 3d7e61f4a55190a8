# SPDX-License-Identifier: Apache-2.0
"""
Commands without a plan of their own: the previous plan, continued, or the brake law.

The ladder (`rti_mpc.control.ladder`) says which of them it is, and counts them; the mode
says why.
"""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, Severity, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.assembly import Assembly
from rti_mpc.control.issued import ENDING, NO_ENDING
from rti_mpc.control.planner import Planner


class Fallback:
    """Fallbacks of one controller."""

    def __init__(self, parts: Assembly, planner: Planner) -> None:
        self._planner, self._modes, self._states, self._grid = planner, parts.modes, parts.states, parts.grid
        self._ladder, self._envelope, self._sent, self._issued, self._ways = parts.ladder, parts.envelope, parts.sent, parts.issued, parts.ways
        self._u_rest: Array = np.array(parts.rti.ocp.model.u_rest)
        self._valid_ns = parts.valid_ns

    @property
    def at_rest(self) -> bool:
        """Whether the last command that was sent is rest from its first row on, or none was ever sent."""
        last = self._issued.last
        return last is None or (np.array_equal(last.u[0], self._u_rest) if self._ways is None else self._ways.at_rest)

    def replace(self, state: State, status: QpStatus) -> Command:
        """Replace a plan that could not be computed."""
        act_ns, failure = self._grid.act_ns, f"the QP is {status.name.lower()}"
        if self._ladder.fall(plan_left=self._plan_lasts(act_ns)):
            self._modes.enter(Mode.FALLBACK, f"{failure}: the previous plan is continued", Severity.WARNING, "qp_failed")
            return self._play_on(state, act_ns, status)
        self._modes.enter(Mode.BRAKING, f"{failure} and no plan is left", Severity.ERROR, "no_plan")
        return self.brake(state, act_ns, status)

    def silence(self, state: State, now_ns: int) -> Command:
        """Replace the plans that no state asks for any more, at a robot time."""
        self._grid.running = False
        mode = Mode.STOPPED if self._modes.stopped else Mode.BRAKING
        self._modes.enter(mode, f"no state for {1e-9 * (now_ns - state.stamp_ns):.3f} s", Severity.ERROR, "state_stale")
        return self.brake(state, now_ns + self._grid.delay_ns, QpStatus.NONE)

    def overrun(self, command: Command, state: State, now_ns: int) -> Command | None:
        """
        Replace a proposal that was ready too late to be sent.

        Args:
            command: The proposal.
            state: The last state.
            now_ns: Robot time.

        Returns:
            What to publish; None if the robot goes on with the previous plan, or with the way to rest that it corrects by its states.
        """
        self._issued.overran = True
        failure = f"a command was ready {1e-9 * (now_ns - command.stamp_ns):.3f} s late"
        left = self._plan_lasts(now_ns)
        if left if command.mode is Mode.FALLBACK else self._ladder.fall(plan_left=left):  # a fallback is counted already
            self._modes.enter(Mode.FALLBACK, f"{failure}: the previous plan is continued", Severity.WARNING, "over_budget")
            return None
        if not self._modes.stopped:
            self._modes.enter(Mode.BRAKING, f"{failure} and no plan is left", Severity.ERROR, "over_budget")
        self._issued.late = command if command.mode.planned and now_ns < command.valid_until_ns else None
        counted = command.mode in (Mode.BRAKING, Mode.STOPPED)
        if self._ways is not None and self._ways.feeds_back:  # the last command carries its way, which newer states correct than this sample's
            if not counted:
                self._ladder.brake(at_rest=False)
            self._issued.plan, self._planner.loaded = None, False
            return None
        return self.brake(state, now_ns + self._grid.delay_ns, command.status, wanted=counted)

    def brake(self, state: State, act_ns: int, status: QpStatus, *, wanted: bool = False) -> Command:
        """
        Propose the brake law, because a stop is `wanted` or because there is no plan; the next sample starts cold.

        Its validity counts from its own time, not from its state's: a ramp depends on past
        commands only, and never leads further from rest than they do; a way to rest goes
        on from the state predicted with them.

        Args:
            state: The last state.
            act_ns: When the command acts.
            status: Outcome of the QP.
            wanted: Whether this is no failure.
        """
        self._planner.loaded = False
        reach, valid_ns, ending = self._sent.reach(act_ns), self._valid_ns, NO_ENDING
        if self._ways is None:
            rows = self._envelope.ramp(reach)
            at_rest = bool((rows[0] == self._u_rest).all())
        else:
            rows, valid_ns, ending = self._ways.stop(self._states.x, state.stamp_ns, act_ns, self._sent.u_prev, reach)
            at_rest = self._ways.at_rest
        if not wanted:
            self._ladder.brake(at_rest=at_rest)
        self._issued.plan = None
        return self._issued.propose(state, act_ns, act_ns + valid_ns, self._modes.mode, status, rows, ending=ending)

    def give_up(self, state: State) -> Command | None:
        """
        Stop commanding a robot whose stamps are no clock: send one last command, each of whose rows is the next step to rest.

        Whichever of its rows acts, and for however long, the inputs stay inside the slew limits.
        """
        modes, cadence = self._modes, self._states.cadence
        if modes.mode is Mode.IDLE:
            return None
        command = None
        ramps = self._ways is None  # the way to rest of the last command is better than anything that is made without a clock
        if ramps and self._issued.last is not None and (self._sent.at(state.stamp_ns)[0] != self._u_rest).any():
            modes.enter(Mode.STOPPED if modes.stopped else Mode.BRAKING, cadence.fault)
            act_ns = state.stamp_ns + self._grid.delay_ns
            valid_ns = max(1, round(self._valid_ns * min(1.0, cadence.rate)))  # as long as it should act, in the unit of the stamps
            rows = self._envelope.ramp(self._sent.reach(act_ns))
            rows = np.tile(rows[0], (len(rows), 1))
            command = self._issued.propose(state, act_ns, act_ns + valid_ns, modes.mode, QpStatus.NONE, rows)
        self._issued.plan = None
        self._issued.overran = self._planner.loaded = self._grid.running = False
        modes.enter(Mode.IDLE, cadence.fault)
        return command

    def _plan_lasts(self, now_ns: int) -> bool:
        """Whether there is a previous plan, and it is valid at a time."""
        plan = self._issued.plan
        return plan is not None and now_ns < plan.valid_until_ns

    def _play_on(self, state: State, act_ns: int, status: QpStatus) -> Command:
        """Propose the rest of the previous plan, which must be there."""
        plan = self._issued.plan
        assert plan is not None
        rows = self._envelope.refit(plan.u, round((act_ns - plan.stamp_ns) / plan.period_ns), self._planner.reach)
        ending = {name: getattr(plan, name) for name in ENDING}  # it begins when that plan ends, and so does this one
        return self._issued.propose(state, act_ns, plan.valid_until_ns, Mode.FALLBACK, status, rows, ending=ending)
