# SPDX-License-Identifier: Apache-2.0
"""Interruptions of a controller's samples, by a gap or by another life of the robot: what goes on after them, and what is forgotten."""

from __future__ import annotations

from rti_mpc.contract.message import Severity, State
from rti_mpc.contract.status import Mode
from rti_mpc.control.assembly import Assembly
from rti_mpc.control.planner import Planner
from rti_mpc.control.state_stream import Arrival


class Interruption:
    """Interruptions of one controller."""

    def __init__(self, parts: Assembly, planner: Planner) -> None:
        self._planner, self._rti, self._modes, self._ladder, self._grid = planner, parts.rti, parts.modes, parts.ladder, parts.grid
        self._states, self._track, self._sent, self._issued = parts.states, parts.track, parts.sent, parts.issued
        self._ways, self._delay, self._blockage = parts.ways, parts.delay, parts.blockage

    def rejoin(self, stamp_ns: int, behind: int) -> None:
        """Move plan and grid to a state that the grid did not expect: a late one, or the first one after a gap."""
        grid, planner = self._grid, self._planner
        grid.skipped += behind
        late, act_ns = self._issued.late, stamp_ns + grid.delay_ns
        if late is not None and act_ns >= late.valid_until_ns:
            planner.loaded = False  # it would have run out: this sample starts cold
        if behind and self._issued.lasts(act_ns):
            grid.catch_up(behind, stamp_ns)
            if planner.loaded:
                for _ in range(behind - 1):
                    self._rti.shift()
                planner.load(grid.act_ns, shift=True)
            return
        if behind:
            self._modes.say(Severity.WARNING, "gap", f"no sample for {behind} period{'s' * (behind > 1)}: starting cold")
        self._forget_plan()
        self._ladder.failed = 0
        clock = self._states.clock
        if not grid.too_late(clock.late_ns + clock.doubt_ns):
            grid.start(stamp_ns)
        else:  # this state may have waited on its way for too long to be answered: the next one will show
            grid.running = False

    def forget(self, arrival: Arrival, state: State) -> None:
        """Forget the robot's last life; or, after a jump of its clock, all but the inputs from which it has braked since then."""
        self._issued.late = None
        if arrival is Arrival.NEW_LIFE:
            self._sent.clear()
        else:
            self._sent.brake(self._states.before_ns, state.stamp_ns)
        if arrival is not Arrival.JUMPED_AHEAD:
            self._modes.enter(Mode.IDLE, "the robot was restarted, or its clock has jumped")
            self._track.clear(state.epoch if arrival is Arrival.NEW_LIFE else None)
            self._blockage.clear()
        if self._delay is not None:
            self._delay.clear()
        self._forget_plan()
        self._issued.overran = self._grid.running = False

    def _forget_plan(self) -> None:
        """Let the next sample start cold."""
        self._planner.loaded = False
        self._issued.plan = None
        if self._ways is not None:
            self._ways.forget()
