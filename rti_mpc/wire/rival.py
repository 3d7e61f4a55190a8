# SPDX-License-Identifier: Apache-2.0
"""
Rival of a source of references: another one that publishes for the same robot.

Controllers follow the one of the higher epoch, see `rti_mpc.wire.source`. Neither is told by
them, so each listens to the other.
"""

from __future__ import annotations

from rti_mpc.contract.message import Notice, Reference, Severity
from rti_mpc.wire.bus import RING_MESSAGES, Bus

STALE_S = 60.0  # as of a controller's intake of references


class Rival:
    """Listens for references of others on the bus of a source."""

    def __init__(self, bus: Bus, epoch: int) -> None:
        """
        Begin to listen.

        Args:
            bus: Bus of the source, whose own references do not come back.
            epoch: Epoch of the source.
        """
        self._robot, self._epoch, self._told = bus.keys.robot, epoch, epoch
        self._references = bus.subscriber(bus.keys.reference, capacity=RING_MESSAGES)
        self._intake = bus.intake(Reference, STALE_S)

    def notice(self) -> Notice | None:
        """Return the notice about another source that was heard since the last call; None if there is none, or of one that was told last."""
        epochs = [reference.epoch for reference in self._intake.newest_of_each(self._references.drain())]
        other = max(epochs, default=self._told)
        if other == self._told:
            return None
        self._told = other
        follows = "that one from now on, not this one" if other > self._epoch else "this one from now on, not that one"
        text = f"another source publishes references for {self._robot}: its controller follows {follows}; stop one of the two"
        return Notice(Severity.WARNING, "reference_rival", text)
