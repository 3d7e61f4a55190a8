# SPDX-License-Identifier: Apache-2.0
"""Reports of a robot: the input that acts at the stamp of a state, and the command that it comes from."""

from __future__ import annotations

from collections.abc import Mapping
from operator import le

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import State
from rti_mpc.control.sent import Sent


class Reports:
    """
    Reports of one robot, compared with what is believed to act.

    Attributes:
        ramps: Last reports in a row of the robot's own ramp to rest where a command was believed to act.

    Args:
        sent: What is believed.
        limits: Bounds of the inputs by name, owned by the caller, obeyed as they are.
    """

    def __init__(self, sent: Sent, limits: Mapping[str, Array]) -> None:
        self.ramps = 0
        self._sent = sent
        self._limits = limits

    def correct(self, state: State) -> bool:
        """Believe the input that a robot reports; return whether it was another than believed."""
        surprised = self._sent.correct(state.stamp_ns, self._within(state.u, state.stamp_ns), (state.command_epoch, state.command_seq))
        self.ramps = self.ramps + 1 if surprised and not state.command_seq else 0
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
