# SPDX-License-Identifier: Apache-2.0
"""Preparation, the first phase of a sample: before its state arrives, all is done that does not depend on it."""

from __future__ import annotations

import numpy as np

from rti_mpc.contract.status import Mode
from rti_mpc.control.assembly import Assembly
from rti_mpc.control.opinions import Opinions
from rti_mpc.control.planner import Planner
from rti_mpc.control.record import Record


class Preparation:
    """First phase of one controller's samples."""

    def __init__(self, parts: Assembly, planner: Planner, record: Record, opinions: Opinions | None) -> None:
        self._planner, self._record, self._opinions = planner, record, opinions
        self._rti, self._ladder, self._grid = parts.rti, parts.ladder, parts.grid
        self._modes, self._states, self._sent, self._issued, self._ways = parts.modes, parts.states, parts.sent, parts.issued, parts.ways
        self._tuning, self._delay, self._blockage = parts.tuning, parts.delay, parts.blockage

    def prepare(self) -> None:
        """Close the last sample, and prepare the next one, see `Controller.prepare`."""
        modes, grid, state = self._modes, self._grid, self._states.last
        planned = modes.mode.planned
        self._record.keep_plan(self._issued.seq)
        if self._opinions is not None:
            self._opinions.keep(self._issued.seq, planned=planned and not modes.standing_by)
        if planned and self._blockage.judge():
            modes.notices.append(self._blockage.notice)
        if not grid.running or state is None:
            return
        if self._delay is not None:
            acting = None if modes.standing_by else self._issued.last
            self._sent.delay_ns = self._delay.learn(self._states.seen, state.stamp_ns, acting, self._sent.confirmed)
            grid.adapt(self._sent.delay_ns)
        grid.advance(state.stamp_ns, self._states.clock.period_ns)
        self._planner.loaded = False
        if planned:
            self._ladder.failed = 0
        elif self._issued.late is None and (modes.mode is not Mode.FALLBACK or not np.isfinite(self._rti.x).all()):
            return  # the next sample starts cold; after a late one it does not, as a cold one takes longest and would be late again
        self._tuning.begin()
        self._planner.load(grid.act_ns, shift=True)
        if self._ways is not None:
            self._ways.prepare()
