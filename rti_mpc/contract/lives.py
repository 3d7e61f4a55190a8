# SPDX-License-Identifier: Apache-2.0
"""
The lives of the robot that are heard: which one is commanded, and whether two robots use one name.

An epoch is one life of a robot. The first one heard is believed. Another one,
heard within the stale time of it, is a second robot of that name, or a forgery:
then neither may be moved, until only one was heard for as long as any command
can still move it. If that is the life which was believed before, it goes on where
it was. Another life is believed only then; or, if the one before has been silent
for longer than the stale time, once it was heard alone for that long.

No clock inside: local times are handed in. Two epochs are remembered, however many are heard.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rti_mpc.contract.message import Notice, Severity


class Heard(Enum):
    """Whose a state is."""

    OURS = "ours"  # of the life that is believed
    BEGINS = "begins"  # the first one of a life that is believed from now on
    OTHER = "other"  # of another robot, or of a life that is not sure yet


@dataclass(slots=True)
class Life:
    """
    One life, as heard.

    Attributes:
        epoch: Of its states.
        since_ns: Local time since when it was the last one heard beside the one that is believed.
        heard_ns: Local time of its last state.
    """

    epoch: int
    since_ns: int
    heard_ns: int


class Lives:
    """
    Decides from the epochs of states alone.

    Attributes:
        disputed: Whether two robots are there: nothing may move.
        notice: What the last state has shown that people must know, None as a rule.
    """

    def __init__(self, stale_s: float, settling_s: float) -> None:
        """
        Begin with nothing heard.

        Args:
            stale_s: Silence of the robot that is no silence yet, s of the robot.
            settling_s: How long after its state a command of anybody may still move the robot, s of the robot.
        """
        self.disputed = False
        self.notice: Notice | None = None
        self._stale_s, self._settling_s = stale_s, settling_s
        self._life: Life | None = None
        self._rival: Life | None = None

    @property
    def rival(self) -> int | None:
        """Epoch of a life that may be believed next, None if there is none."""
        return None if self._rival is None else self._rival.epoch

    def hear(self, epoch: int, local_ns: int, rate: float = 1.0) -> Heard:
        """
        Judge a state.

        Args:
            epoch: Epoch of the state.
            local_ns: Local monotonic time.
            rate: Seconds of the robot that is believed, per local second.
        """
        self.notice = None
        stale_ns, settling_ns = 1e9 * self._stale_s / rate, 1e9 * self._settling_s / rate
        life, rival = self._life, self._rival
        if life is None:
            return self._believe(Life(epoch, local_ns, local_ns))
        if epoch == life.epoch:
            life.heard_ns = local_ns
            if rival is not None and not self.disputed and local_ns - rival.heard_ns <= stale_ns:
                self._dispute(life.epoch, rival.epoch)
            elif rival is not None and (not self.disputed or local_ns - rival.heard_ns > settling_ns):
                self._rival, self.disputed = None, False
            return Heard.OURS
        beside = life if rival is None or rival.epoch == epoch or life.heard_ns > rival.heard_ns else rival  # who else was heard last
        if rival is None or rival.epoch != epoch:
            self._rival = rival = Life(epoch, local_ns, local_ns)
        if not self.disputed and local_ns - beside.heard_ns <= stale_ns:
            self._dispute(beside.epoch, epoch)
        rival.heard_ns = local_ns
        alone_ns = local_ns - max(life.heard_ns, rival.since_ns)
        if alone_ns > (settling_ns if self.disputed else stale_ns):
            return self._believe(rival)
        return Heard.OTHER

    def _believe(self, life: Life) -> Heard:
        self._life, self._rival, self.disputed = life, None, False
        return Heard.BEGINS

    def _dispute(self, one: int, other: int) -> None:
        self.disputed = True
        text = (
            f"two robots use this name, of epochs {one} and {other}: commands end in a ramp, "
            f"and go on when only one was heard for {self._settling_s:g} s; stop one of them, or give it another name"
        )
        self.notice = Notice(Severity.ERROR, "two_robots", text)
