# SPDX-License-Identifier: Apache-2.0
"""The inputs already sent: what the robot does until the next command acts."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from rti_mpc.array import Array
from rti_mpc.message import Command


class Sent:
    """
    The last commands, played as the contract says a robot plays them.

    Row ``i`` of the newest command whose time has come acts; nothing acts from
    `valid_until_ns` on, and the robot ramps to rest inside the slew limits.
    """

    def __init__(self, u_rest: Array, lbdu: Array, ubdu: Array, dt_ns: int, commands: int) -> None:
        self._u_rest = u_rest
        self._slew = (lbdu, ubdu)  # per dt
        self._dt_ns = dt_ns
        self._commands: deque[Command] = deque(maxlen=commands)

    def append(self, command: Command) -> None:
        """Remember a command, unless it has expired before its time, as the last of several fallbacks may: the robot refuses it."""
        if command.stamp_ns < command.valid_until_ns:
            self._commands.append(command)

    def clear(self) -> None:
        """Forget everything: the robot was restarted, and stands."""
        self._commands.clear()

    def spans(self, from_ns: int, to_ns: int) -> Iterator[tuple[Array, float]]:
        """Yield the inputs that act between two times, shape ``(nu,)``, each with for how long, s; backward, the one that acts at the end."""
        if to_ns < from_ns:
            yield self.at(to_ns)[0], 1e-9 * (to_ns - from_ns)
        while from_ns < to_ns:
            u, change_ns = self.at(from_ns)
            until_ns = min(change_ns, to_ns)
            yield u, 1e-9 * (until_ns - from_ns)
            from_ns = until_ns

    def at(self, t_ns: int) -> tuple[Array, int]:
        """Return the input that acts at a time, shape ``(nu,)``, and when it next changes."""
        command = None
        change_ns = 2**62
        for candidate in reversed(self._commands):
            if candidate.stamp_ns <= t_ns:
                command = candidate
                break
            change_ns = candidate.stamp_ns
        if command is None:
            return self._u_rest, change_ns
        row = min((t_ns - command.stamp_ns) // command.period_ns, len(command.u) - 1)
        if t_ns < command.valid_until_ns:
            row_end_ns = command.stamp_ns + (row + 1) * command.period_ns
            return command.u[row], min(change_ns, command.valid_until_ns, row_end_ns if row < len(command.u) - 1 else change_ns)
        last = command.u[min((command.valid_until_ns - command.stamp_ns) // command.period_ns, len(command.u) - 1)]
        steps = (t_ns - command.valid_until_ns) / self._dt_ns
        with np.errstate(invalid="ignore"):  # no slew limit, no time: 0 * inf is no way at all
            lowest, highest = (np.nan_to_num(steps * limit, nan=0.0) for limit in self._slew)
        return last + np.clip(self._u_rest - last, lowest, highest), min(change_ns, t_ns + self._dt_ns)
