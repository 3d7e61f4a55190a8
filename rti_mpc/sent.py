# SPDX-License-Identifier: Apache-2.0
"""The inputs already sent: what the robot does until the next command acts."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from rti_mpc.array import Array
from rti_mpc.message import Command
from rti_mpc.schedule import EVER_NS, Schedule, end_ns


class Sent:
    """The last commands, as the robot plays them if none is late."""

    def __init__(self, u_rest: Array, lbdu: Array, ubdu: Array, dt_ns: int) -> None:
        self._schedule = Schedule(u_rest, 1e9 * np.minimum(-lbdu, ubdu) / dt_ns)

    def append(self, command: Command) -> None:
        """Remember a command, unless it has expired before its time, as the last of several fallbacks may: the robot refuses it."""
        if command.stamp_ns < end_ns(command):
            self._schedule.add(command, command.stamp_ns, end_ns(command))

    def clear(self) -> None:
        """Forget everything: the robot was restarted, and stands."""
        self._schedule.brake(self._schedule.u_rest, EVER_NS)

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
        u, change_ns, _ = self._schedule.at(t_ns)
        return u, change_ns
