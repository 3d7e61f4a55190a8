# SPDX-License-Identifier: Apache-2.0
"""Feedback, the second phase of a sample: from a due state to the command that acts at :math:`t_k`."""

from __future__ import annotations

from rti_mpc.contract.message import Command, End, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.assembly import Assembly
from rti_mpc.control.fallback import Fallback
from rti_mpc.control.issued import NO_ENDING
from rti_mpc.control.planner import Planner

FOLLOWS = Mode.TRACKING, "following the reference"
HOLDS = Mode.HOLDING, "the reference has ended"
STOP = End.STOP  # read faster than a member of the enumeration


class Feedback:
    """Second phase of one controller's samples."""

    def __init__(self, parts: Assembly, planner: Planner, fallback: Fallback) -> None:
        self._planner, self._fallback, self._rti, self._ladder, self._grid = planner, fallback, parts.rti, parts.ladder, parts.grid
        self._first = parts.rti.active_set or parts.rti.solvers[0]  # solver that is tried first
        self._horizon_ns = parts.rti.ocp.N * parts.grid.dt_ns
        self._modes, self._states, self._track, self._issued, self._ways = parts.modes, parts.states, parts.track, parts.issued, parts.ways
        self._valid_ns = parts.valid_ns

    def answer(self, state: State) -> Command:
        """Propose a command: a stop that is wanted, a plan, or what replaces it."""
        modes, grid = self._modes, self._grid
        act_ns = grid.act_ns
        ending = self._track.ended(act_ns)
        disputed = self._states.lives.disputed
        if modes.stopped or disputed or ending is STOP:
            why = "two robots use this name" if disputed else "the reference ended with STOP"
            modes.enter(*((Mode.STOPPED, modes.stopped) if modes.stopped else (Mode.BRAKING, why)))
            return self._fallback.brake(state, act_ns, QpStatus.NONE, wanted=True)
        status, u = self._planner.plan(self._states.x, state.stamp_ns, act_ns)
        if u is None:
            return self._fallback.replace(state, status)
        if self._rti.solver is not self._first:
            self._ladder.softened += 1
        mode, reason = FOLLOWS if ending is None else HOLDS
        if not self._issued.overran:
            modes.enter(mode, reason)
        valid_until_ns = min(act_ns + self._horizon_ns, state.stamp_ns + grid.delay_ns + self._valid_ns)
        after = NO_ENDING
        if self._ways is not None:
            u, after = self._ways.after(u, act_ns, valid_until_ns)
        return self._issued.propose(state, act_ns, valid_until_ns, mode, status, u, plan=True, ending=after)
