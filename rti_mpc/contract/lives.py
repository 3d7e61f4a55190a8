# SPDX-License-Identifier: Apache-2.0
"""
The lives of the robot that are heard: which one is commanded, and whether two robots use one name.

An epoch is one life of a robot. The first life heard is believed. A second one that is
heard within the stale time of the first is another robot of that name, or a forgery.
Then neither may be moved until only one was heard for as long as any command can still
move it. If that is the life which was believed before, it continues where it was.
Another life is believed only then; or, if the one before was silent for longer than the
stale time, once the new one was heard alone for that long.

It reads no clock: local times are handed in. Two epochs are remembered, however many are heard.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rti_mpc.contract.message import Notice, Severity


class Heard(Enum):
    """Life that a state belongs to."""

    OURS = "ours"  # the life that is believed
    BEGINS = "begins"  # a life that is believed from this state on
    OTHER = "other"  # another robot, or a life that is not believed yet


OURS, BEGINS, OTHER = Heard  # read faster than a member of the enumeration


@dataclass(slots=True)
class Life:
    """
    One life that was heard.

    Attributes:
        epoch: Epoch of its states.
        since_ns: Local time since which it has been the only one heard beside the life that is believed.
        heard_ns: Local time of its last state.
    """

    epoch: int
    since_ns: int
    heard_ns: int


class Lives:
    """
    Judge of the robot's lives, by the epochs of states only.

    Attributes:
        disputed: Whether two robots use the name, so that neither may move.
        notice: Notice about the last state; None for most states.
        settling_s: Time for which any command may still move the robot after the state that it answers, s of the robot.
    """

    def __init__(self, stale_s: float, settling_s: float) -> None:
        """
        Begin with nothing heard.

        Args:
            stale_s: Time without a state after which the robot counts as silent, s of the robot.
            settling_s: As the attribute, at first.
        """
        self.disputed = False
        self.notice: Notice | None = None
        self._stale_s, self.settling_s = stale_s, settling_s
        self._life: Life | None = None
        self._rival: Life | None = None

    @property
    def rival(self) -> int | None:
        """Epoch of the life that may be believed next, None if there is none."""
        return None if self._rival is None else self._rival.epoch

    def judge(self, epoch: int, local_ns: int, rate: float = 1.0) -> Heard:
        """
        Judge a state.

        Args:
            epoch: Epoch of the state.
            local_ns: Local monotonic time.
            rate: Seconds of the believed robot's clock per local second.
        """
        self.notice = None
        stale_ns, settling_ns = 1e9 * self._stale_s / rate, 1e9 * self.settling_s / rate
        life, rival = self._life, self._rival
        if life is None:
            return self._believe(Life(epoch, local_ns, local_ns))
        if epoch == life.epoch:
            life.heard_ns = local_ns
            if rival is not None and not self.disputed and local_ns - rival.heard_ns <= stale_ns:
                self._dispute(life.epoch, rival.epoch)
            elif rival is not None and (not self.disputed or local_ns - rival.heard_ns > settling_ns):
                self._rival, self.disputed = None, False
            return OURS
        beside = life if rival is None or rival.epoch == epoch or life.heard_ns > rival.heard_ns else rival  # the other life that was heard last
        if rival is None or rival.epoch != epoch:
            self._rival = rival = Life(epoch, local_ns, local_ns)
        if not self.disputed and local_ns - beside.heard_ns <= stale_ns:
            self._dispute(beside.epoch, epoch)
        rival.heard_ns = local_ns
        alone_ns = local_ns - max(life.heard_ns, rival.since_ns)
        if alone_ns > (settling_ns if self.disputed else stale_ns):
            return self._believe(rival)
        return OTHER

    def _believe(self, life: Life) -> Heard:
        self._life, self._rival, self.disputed = life, None, False
        return BEGINS

    def _dispute(self, one: int, other: int) -> None:
        self.disputed = True
        text = (
            f"two robots use this name, of epochs {one} and {other}: commands are stopped, the inputs ramp to rest, "
            f"and commands continue once only one was heard for {self.settling_s:g} s; stop one of them, or give it another name"
        )
        self.notice = Notice(Severity.ERROR, "two_robots", text)
