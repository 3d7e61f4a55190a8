# SPDX-License-Identifier: Apache-2.0
"""Understudy of a controller: it goes the way from state to command with the last state, and leaves everything as it was."""

from __future__ import annotations

from rti_mpc.contract.message import Command
from rti_mpc.control.assembly import Assembly
from rti_mpc.control.planner import Planner


class Understudy:
    """Rehearsals of one controller."""

    def __init__(self, parts: Assembly, planner: Planner) -> None:
        self._planner, self._rti, self._modes, self._grid = planner, parts.rti, parts.modes, parts.grid
        self._states, self._judge, self._track, self._reports, self._issued = parts.states, parts.understudy, parts.track, parts.reports, parts.issued
        self._valid_ns = parts.valid_ns

    def rehearse(self, local_ns: int) -> Command | None:
        """Rehearse the next sample, at a local monotonic time: see `Controller.rehearse`."""
        state, grid, modes = self._states.last, self._grid, self._modes
        if state is None or not self._planner.loaded or modes.standing_by or not modes.mode.planned:
            return None
        self._states.check(state)
        self._judge.receive(state, local_ns)
        due_ns = grid.act_ns - min(grid.delay_ns, grid.dt_ns - 1)  # or the first time at which `prepare` has asked for the inputs
        if len(state.u):
            self._reports.expects(state, due_ns)
        if grid.early(due_ns, self._states.clock.period_ns) or self._track.ended(grid.act_ns):
            return None
        rows = self._planner.rehearse(self._states.x, due_ns, grid.act_ns)
        modes.enter(modes.mode, "nothing is said")
        return self._issued.build(state, grid.act_ns, grid.act_ns + self._valid_ns, modes.mode, self._rti.status, rows)
