# SPDX-License-Identifier: Apache-2.0
"""
The robot's side of the command contract: it accepts or refuses commands, counts them, and plays their plans.

Accepted commands act as `rti_mpc.contract.schedule` says. They are approached within the slew
limits from the input that really acts, whatever was lost before. A way to rest that needs
feedback is corrected by the robot's own measurements. Times are arguments; there is no clock.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.approach import Increments
from rti_mpc.contract.message import Command
from rti_mpc.contract.schedule import NO_COMMAND, UNKNOWN, Schedule, end_ns, unfit
from rti_mpc.rotation import Rotations
from rti_mpc.wire.source import Source

MAX_EARLY_NS = 250_000_000  # how far the stamp of an answered state may be ahead of the robot's clock, which a guard knows no better
STALE_NS = 250_000_000  # silence after which another controller may take over, even one of a lower epoch


@dataclass(slots=True)
class Counters:
    """
    What became of commands since start.

    Attributes:
        lost: Missing sequence numbers.
        late: Arrived when their first row was already over; the remaining rows act.
        expired: Arrived when nothing of them could act any more.
        refused: Malformed, repeated, from another source, for another life of the robot or a state still to come, or no finite plan.
        starved: How often a plan ran out in motion and the robot braked on its own.
    """

    lost: int = 0
    late: int = 0
    expired: int = 0
    refused: int = 0
    starved: int = 0


class Actuator:
    """
    Plays plans.

    Attributes:
        u: Input demanded now, shape ``(nu,)``.
        source: Epoch and sequence number of the command it comes from; zeros: the robot itself, on its way to rest.
        counters: What became of commands.
        braking: Whether no plan acts.
    """

    def __init__(
        self,
        u_rest: Array,
        slew: Array,
        epoch: int,
        delay_ns: int = 0,
        bounds: tuple[float | Array, float | Array] = (-np.inf, np.inf),
        increments: Increments | None = None,
        rotations: Rotations = UNKNOWN,
    ) -> None:
        """
        Begin at rest.

        Args:
            u_rest: Input at rest, shape ``(nu,)``.
            slew: Largest rate of the ramp to rest, shape ``(nu,)``, in the input's unit per s.
            epoch: Life of the robot that commands must be for.
            delay_ns: Time from the arrival of a command to the instant from which it can act.
            bounds: Of the inputs, shape ``(nu,)``: a drive does no more, whatever it is told.
            increments: Slew limits inside which plans are approached; None: their rows are played as they come.
            rotations: Among the measured states; of size 0: none is measured.
        """
        self.u = np.array(u_rest, dtype=np.float64)
        self.source = NO_COMMAND
        self.counters = Counters()
        self.braking = True
        self._schedule = Schedule(u_rest, slew, increments, bounds, rotations)
        self._now_ns = 0
        self._robot_epoch = epoch
        self._nx = rotations.size or None
        self._delay_ns = delay_ns
        self._source = Source(STALE_NS)
        self._bounds = bounds  # of the inputs, shape (nu,): a drive does no more, whatever it is told
        self._off = False

    @property
    def at_rest(self) -> bool:
        """Whether the inputs have come to rest, and no plan acts."""
        return self.braking and self._schedule.rests(self._now_ns - 1)

    def accept(self, command: Command, arrival_ns: int) -> str:
        """
        Take a command, or refuse it. It can act from its arrival on, plus the delay of the actuators.

        Returns:
            The reason for refusing it, empty if it was taken.
        """
        early = command.state_stamp_ns > arrival_ns + MAX_EARLY_NS
        arrival_ns += self._delay_ns
        reason = "switched_off" if self._off else unfit(command, len(self.u), self._robot_epoch, self._nx) or ("early" if early else "")
        start_ns = max(command.stamp_ns, arrival_ns)
        expired = end_ns(command) <= start_ns
        if not reason and not (expired and command.epoch != self._source.epoch):  # what could not act locks nobody out
            verdict = self._source.accept(command.epoch, command.seq, arrival_ns)
            reason = "" if verdict.accepted else verdict.value
        self.counters.lost = self._source.lost
        reason = reason or ("expired" if expired else "")
        if reason:
            self.counters.expired += reason == "expired"
            self.counters.refused += reason != "expired"
            return reason
        self.counters.late += arrival_ns >= command.stamp_ns + command.period_ns
        self._schedule.add(replace(command, u=np.clip(command.u, *self._bounds)), start_ns, end_ns(command))
        return ""

    def play(self, from_ns: int, to_ns: int) -> Iterator[tuple[int, Array]]:
        """
        Tell which inputs act in an interval; intervals must follow one another.

        Yields:
            Until when, in ns, and the input held until then, shape ``(nu,)``: valid until the next one.
        """
        t = from_ns
        while t < to_ns:
            self._schedule.forget(t)
            u, change_ns, braking = self._schedule.at(t)
            begins, self.braking = braking and not self.braking, braking
            self.counters.starved += begins and not (self._off or self.at_rest)
            self.u[:], self.source = u, self._schedule.source(t)
            t = self._now_ns = min(change_ns, to_ns)
            yield t, self.u

    def acting(self, t_ns: int) -> tuple[Array, tuple[int, int]]:
        """Return the input that acts at a time up to a period ago, shape ``(nu,)``, and epoch and sequence number of its command; see `source`."""
        return self._schedule.at(t_ns)[0], self._schedule.source(t_ns)

    def measure(self, x: Array | None, stamp_ns: int, now_ns: int | None = None) -> None:
        """
        Take what the robot measures: it corrects a way to rest that needs it, after the delay of the actuators.

        Args:
            x: State, shape ``(nx,)``; None: the last one is too old, and the way's rows act as they are.
            stamp_ns: When it was measured.
            now_ns: The present time; None: it was measured just now.
        """
        self._schedule.feed_back(x, stamp_ns, (stamp_ns if now_ns is None else now_ns) + self._delay_ns)

    def switch_off(self) -> None:
        """Drop every plan and take no other: the inputs go their way to rest from what acts."""
        self._off = True
        self._schedule.cut(self._now_ns, self._now_ns)
