# SPDX-License-Identifier: Apache-2.0
"""Answer of a healthy controller to a state."""

from __future__ import annotations

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, State
from rti_mpc.contract.status import Mode, QpStatus


def answer(state: State, u: Array, *, epoch: int, seq: int, period_ns: int, valid_ns: int) -> Command:
    """
    Return the command that answers a state.

    Args:
        state: The state; the first row acts from its time on.
        u: Rows, shape ``(n, nu)``.
        epoch: Epoch of the controller.
        seq: Number of the command.
        period_ns: Time between rows.
        valid_ns: Time after the state for which the command may act.
    """
    return Command(
        epoch=epoch,
        seq=seq,
        stamp_ns=state.stamp_ns,
        state_epoch=state.epoch,
        state_seq=state.seq,
        state_stamp_ns=state.stamp_ns,
        valid_until_ns=state.stamp_ns + valid_ns,
        config_hash=0,
        mode=Mode.TRACKING,
        status=QpStatus.SOLVED,
        period_ns=period_ns,
        u=u,
    )
