# SPDX-License-Identifier: Apache-2.0
"""Reports of a robot: the input that acts at the stamp of a state, and the command that it comes from."""

from __future__ import annotations

from collections.abc import Mapping
from operator import le

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import State
from rti_mpc.contract.schedule import BEFORE_ALL_NS
from rti_mpc.control.sent import Sent

MAX_PAUSE_PERIODS = 2  # between reports that were not expected, in one row of them


class Reports:
    """
    Reports of one robot, compared with what is believed to act.

    Attributes:
        untaken_ns: Robot time for which it has reported its own ramp to rest where commands were believed to act, and named none in between.

    Args:
        sent: What is believed.
        limits: Bounds of the inputs by name, owned by the caller, obeyed as they are.
        dt_ns: Period of the controller.
    """

    def __init__(self, sent: Sent, limits: Mapping[str, Array], dt_ns: int) -> None:
        self.untaken_ns = 0
        self._ramp_ns = BEFORE_ALL_NS  # stamp of the last report of a ramp that was not expected
        self._pause_ns = MAX_PAUSE_PERIODS * dt_ns  # where states come faster than commands, some of these reports are expected
        self._sent = sent
        self._limits = limits

    def correct(self, state: State) -> bool:
        """Believe the input that a robot reports; return whether it was another than believed."""
        surprised = self._sent.correct(state.stamp_ns, self._within(state.u, state.stamp_ns), (state.command_epoch, state.command_seq))
        if state.command_seq:
            self.untaken_ns = 0
        elif surprised:
            since_ns, self._ramp_ns = state.stamp_ns - self._ramp_ns, state.stamp_ns
            self.untaken_ns = self.untaken_ns + since_ns if 0 <= since_ns <= self._pause_ns else 0
        return surprised

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
