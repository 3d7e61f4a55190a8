# SPDX-License-Identifier: Apache-2.0
"""The commands of a controller, numbered without a gap: first proposed, then committed once they have left."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, State
from rti_mpc.contract.status import Mode, QpStatus

ENDING = ("rest_period_ns", "u_rest", "x_rest", "K")  # the fields of a command that hold its way to rest
NO_ENDING: Mapping[str, Any] = dict.fromkeys(ENDING[1:], np.zeros((0, 0)))  # of a robot whose inputs ramp to rest


class Issued:
    """
    The commands of one controller.

    Attributes:
        epoch: Epoch of the next command.
        seq: Sequence number of the last command that has left.
        last: The last command that has left; None before the first.
        plan: The last command with a plan of its own, as long as that plan may be continued; else None.
        late: The last proposal, if it is a plan that was ready too late to be sent: the next plan begins from it; else None.
        overran: Whether the last proposal was ready too late.
    """

    def __init__(self, epoch: int, config_hash: int, period_ns: int) -> None:
        self.epoch = epoch
        self.seq = 0
        self.last: Command | None = None
        self.plan: Command | None = None
        self.late: Command | None = None
        self.overran = False
        self._config_hash = config_hash
        self._period_ns = period_ns
        self._planned: Command | None = None  # the last one proposed, if it has a plan of its own

    def propose(
        self,
        state: State,
        act_ns: int,
        valid_until_ns: int,
        mode: Mode,
        status: QpStatus,
        u: Array,
        *,
        plan: bool = False,
        ending: Mapping[str, Any] = NO_ENDING,
    ) -> Command:
        """
        Propose the next command; nothing changes until it is committed.

        Args:
            state: The state it answers.
            act_ns: When its first row acts, robot time.
            valid_until_ns: When it ends, robot time.
            mode: What the controller is doing.
            status: Outcome of the QP.
            u: Inputs, shape ``(N, nu)``.
            plan: Whether these are a plan of its own, not a fallback.
            ending: Further fields of the command by name: its way to rest, and the period of its rows if it is another.
        """
        command = self.build(state, act_ns, valid_until_ns, mode, status, u, ending)
        self._planned = command if plan else None
        return command

    def build(
        self, state: State, act_ns: int, valid_until_ns: int, mode: Mode, status: QpStatus, u: Array, ending: Mapping[str, Any] = NO_ENDING
    ) -> Command:
        """Return the command that `propose` would propose, and change nothing."""
        fields: dict[str, Any] = {"period_ns": self._period_ns, **ending}
        return Command(
            epoch=self.epoch,
            seq=self.seq + 1,
            stamp_ns=act_ns,
            state_epoch=state.epoch,
            state_seq=state.seq,
            state_stamp_ns=state.stamp_ns,
            valid_until_ns=valid_until_ns,
            config_hash=self._config_hash,
            mode=mode,
            status=status,
            u=u,
            **fields,
        )

    def commit(self, command: Command) -> None:
        """Record a proposal as the last command that has left; the next one has the next number."""
        self.seq, self.last = command.seq, command
        if command is self._planned:
            self.plan = command

    def lasts(self, t_ns: int) -> bool:
        """Whether at a time the last command acts still, or a late plan would."""
        return any(command is not None and t_ns < command.valid_until_ns for command in (self.last, self.late))
