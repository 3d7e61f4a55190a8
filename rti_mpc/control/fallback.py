# SPDX-License-Identifier: Apache-2.0
"""
Commands without a plan of their own: the previous plan, continued, or the brake law.

The ladder (`rti_mpc.control.ladder`) says which of them it is, and counts them.
"""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.envelope import Envelope
from rti_mpc.control.issued import ENDING, NO_ENDING, Issued
from rti_mpc.control.ladder import Ladder
from rti_mpc.control.sent import Sent
from rti_mpc.control.stopping import Stopping


class Fallback:
    """
    Fallbacks of one controller.

    Args:
        ladder: Counts of the samples without a plan of their own.
        envelope: Limits of the inputs.
        sent: Inputs that were sent.
        issued: Commands.
        ways: Ways to rest; None where the inputs ramp to rest.
        u_rest: Input at which the robot rests, shape ``(nu,)``.
        valid_ns: How long a command is valid, robot time.
    """

    def __init__(self, ladder: Ladder, envelope: Envelope, sent: Sent, issued: Issued, ways: Stopping | None, u_rest: Array, valid_ns: int) -> None:
        self._ladder, self._envelope, self._sent, self._issued, self._ways = ladder, envelope, sent, issued, ways
        self._u_rest, self._valid_ns = u_rest, valid_ns

    @property
    def at_rest(self) -> bool:
        """Whether the last command that was sent is rest from its first row on, or none was ever sent."""
        last = self._issued.last
        return last is None or (np.array_equal(last.u[0], self._u_rest) if self._ways is None else self._ways.at_rest)

    def plays_on(self, now_ns: int, *, counted: bool = False) -> bool:
        """Whether the previous plan may serve a sample that has none of its own."""
        plan = self._issued.plan
        left = plan is not None and now_ns < plan.valid_until_ns
        return left if counted else self._ladder.fall(plan_left=left)

    def play_on(self, state: State, act_ns: int, status: QpStatus, reach: tuple[Array, Array]) -> Command:
        """Propose the rest of the previous plan, which must be there."""
        plan = self._issued.plan
        assert plan is not None
        rows = self._envelope.refit(plan.u, round((act_ns - plan.stamp_ns) / plan.period_ns), reach)
        ending = {name: getattr(plan, name) for name in ENDING}  # it begins when that plan ends, and so does this one
        return self._issued.propose(state, act_ns, plan.valid_until_ns, Mode.FALLBACK, status, rows, ending=ending)

    def brake(self, state: State, x: Array, act_ns: int, mode: Mode, status: QpStatus, *, wanted: bool = False) -> Command:
        """
        Propose the brake law, because a stop is `wanted` or because there is no plan.

        Its validity counts from its own time, not from its state's: a ramp depends on past
        commands only, and never leads further from rest than they do; a way to rest goes
        on from the state predicted with them.

        Args:
            state: The last state.
            x: That state as it is believed, shape ``(nx,)``.
            act_ns: When the command acts.
            mode: What the controller is doing.
            status: Outcome of the QP.
            wanted: Whether this is no failure.
        """
        reach, valid_ns, ending = self._sent.reach(act_ns), self._valid_ns, NO_ENDING
        if self._ways is None:
            rows = self._envelope.ramp(reach)
            at_rest = bool((rows[0] == self._u_rest).all())
        else:
            u_prev = self._sent.at(act_ns - 1)[0]
            rows, valid_ns, ending = self._ways.stop(x, state.stamp_ns, act_ns, u_prev, reach)
            at_rest = self._ways.at_rest
        if not wanted:
            self._ladder.brake(at_rest=at_rest)
        self._issued.plan = None
        return self._issued.propose(state, act_ns, act_ns + valid_ns, mode, status, rows, ending=ending)

    def step(self, state: State, act_ns: int, mode: Mode, valid_ns: int) -> Command:
        """Propose one command to a robot without a clock, each of whose rows is the next step to rest: however long each acts, slew limits hold."""
        rows = self._envelope.ramp(self._sent.reach(act_ns))
        return self._issued.propose(state, act_ns, act_ns + valid_ns, mode, QpStatus.NONE, np.tile(rows[0], (len(rows), 1)))
