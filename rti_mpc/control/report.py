# SPDX-License-Identifier: Apache-2.0
"""Reports of a robot: the input that acts at the stamp of a state, and the command that it comes from."""

from __future__ import annotations

from collections.abc import Mapping
from operator import le

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import State
from rti_mpc.control.sent import Sent

UNTAKEN_REPORTS, UNTAKEN_NS = 20, 1_000_000_000  # how many, and for how long: a robot that has lost some commands ramps as well


class Reports:
    """
    Reports of one robot, compared with what is believed to act.

    Attributes:
        untaken: Whether the last report is the one after which it may be said that the robot takes no commands: it has reported its own ramp to rest
            where they should act, in `UNTAKEN_REPORTS` reports in a row and for `UNTAKEN_NS`.

    Args:
        sent: What is believed.
        limits: Bounds of the inputs by name, owned by the caller, obeyed as they are.
    """

    def __init__(self, sent: Sent, limits: Mapping[str, Array]) -> None:
        self.untaken = False
        self._ramps, self._since_ns, self._told = 0, 0, False  # reports of the ramp in a row, since when, and whether `untaken` was true
        self._sent = sent
        self._limits = limits

    def correct(self, state: State) -> bool:
        """Believe the input that a robot reports; return whether it was another than believed."""
        surprised = self._sent.correct(state.stamp_ns, self._within(state.u, state.stamp_ns), (state.command_epoch, state.command_seq))
        self.untaken = False
        if not surprised or state.command_seq:
            self._ramps, self._told = 0, False
            return surprised
        if self._ramps == 0:
            self._since_ns = state.stamp_ns
        self._ramps += 1
        if not self._told and self._ramps >= UNTAKEN_REPORTS and state.stamp_ns - self._since_ns >= UNTAKEN_NS:
            self.untaken = self._told = True
        return True

    def expects(self, state: State, t_ns: int) -> bool:
        """Whether the report of a state would be believed if it were stamped `t_ns`; nothing changes."""
        return self._sent.expects(t_ns, self._within(state.u, t_ns), (state.command_epoch, state.command_seq))

    def _within(self, u: Array, t_ns: int) -> Array:
        """Return an input that is reported at a time, inside its bounds, or those that were tightened since."""
        lbu, ubu = self._limits["lbu"], self._limits["ubu"]
        values = u.tolist()
        if all(map(le, lbu.tolist(), values)) and all(map(le, values, ubu.tolist())):
            return u
        believed = self._sent.at(t_ns - 1)[0]  # it may be outside bounds that were tightened
        inside: Array = np.minimum(np.maximum(u, np.minimum(lbu, believed)), np.maximum(ubu, believed))
        return inside
