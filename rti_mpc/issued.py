# SPDX-License-Identifier: Apache-2.0
"""The commands that a controller has made, numbered without a gap."""

from __future__ import annotations

from rti_mpc.array import Array
from rti_mpc.message import Command, State
from rti_mpc.status import Mode, QpStatus


class Issued:
    """
    The commands of one controller.

    Attributes:
        epoch: Of the next one.
        seq: Number of the last one.
        last: The last one; None before the first.
        plan: The last one with a plan of its own, as long as that may be gone on with; else None.
    """

    def __init__(self, epoch: int, config_hash: int, period_ns: int) -> None:
        self.epoch = epoch
        self.seq = 0
        self.last: Command | None = None
        self.plan: Command | None = None
        self._config_hash = config_hash
        self._period_ns = period_ns
        self._before: tuple[Command | None, Command | None] = (None, None)  # `last` and `plan` before the last one

    def make(self, state: State, act_ns: int, valid_until_ns: int, mode: Mode, status: QpStatus, u: Array) -> Command:
        """Make the next one: rows, shape ``(N, nu)``, that answer a state and act from `act_ns` on."""
        self.seq += 1
        self._before = self.last, self.plan
        self.last = Command(
            epoch=self.epoch,
            seq=self.seq,
            stamp_ns=act_ns,
            state_epoch=state.epoch,
            state_seq=state.seq,
            state_stamp_ns=state.stamp_ns,
            valid_until_ns=valid_until_ns,
            config_hash=self._config_hash,
            mode=mode,
            status=status,
            period_ns=self._period_ns,
            u=u,
        )
        return self.last

    def withdraw(self) -> None:
        """Take the last one back: it is not sent, and the next one has its number."""
        self.seq -= 1
        self.last, self.plan = self._before
