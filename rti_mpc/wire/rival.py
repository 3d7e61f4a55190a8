# SPDX-License-Identifier: Apache-2.0
"""
Rival of a source of references: another one that publishes for the same robot.

Controllers follow the one of the higher epoch, see `rti_mpc.wire.source`. They tell neither
of the two, so each listens to the other. What one has published before the other came is not asked for.
"""

from __future__ import annotations

from rti_mpc.contract.message import Notice, Reference, Severity
from rti_mpc.wire.bus import RING_MESSAGES, Bus

PLANNER_STALE_S = 60.0  # silence of a planner after which one of a lower epoch may take over; a restarted planner has a higher epoch


class Rival:
    """Listens for references of others on the bus of a source."""

    def __init__(self, bus: Bus, epoch: int) -> None:
        """
        Begin to listen.

        Args:
            bus: Bus of the source, whose own references do not come back.
            epoch: Epoch of the source.
        """
        self._robot, self._epoch, self._highest = bus.keys.robot, epoch, 0
        self._references = bus.subscriber(bus.keys.reference, capacity=RING_MESSAGES, history=False)
        self._intake = bus.intake(Reference, PLANNER_STALE_S)

    def notice(self) -> Notice | None:
        """Return the notice about another source, once, and again about one of a higher epoch; None if there is nothing new."""
        highest = max((reference.epoch for reference in self._intake.newest_of_each(self._references.drain())), default=0)
        if highest <= self._highest:
            return None
        self._highest = highest
        follows = "that one, not this one" if highest > self._epoch else "this one, not that one, while this one publishes"
        text = f"another source publishes references for {self._robot}: its controller follows {follows}; stop one of the two"
        return Notice(Severity.WARNING, "reference_rival", text)
