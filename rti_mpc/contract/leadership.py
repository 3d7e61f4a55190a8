# SPDX-License-Identifier: Apache-2.0
"""
Leadership among the controllers of one robot: the one of the highest epoch leads.

No clock inside: every time is a stamp of the robot, or local monotonic time
handed in. There is no arbiter. Receivers take commands of the highest epoch they
have heard and no others, and so does each controller: one that hears a higher
epoch than its own stands by. It then plans like the leader, unheard, until the
leader leaves states unanswered for `SILENCE_PERIODS`; then it leads, with a higher
epoch. Of several that stand by the one of the lowest number is first, the
others wait a period longer each. A leader that has itself left states unanswered
for so long, or is shown one so late that another may lead by now, says nothing
until it has listened. One that stands by and has missed states, or is shown one
so late, knows nothing of the leader's silence: the host may have held both up.
It counts anew, from when a leader would have listened.

The low bits of an epoch are the number of its owner, drawn at its start:
whatever two controllers have heard, they never arrive at the same one.
"""

from __future__ import annotations

from collections.abc import Callable

from rti_mpc.contract.epoch import MAX_SEQ_GAP, epoch_above
from rti_mpc.contract.message import Command, Notice, Severity, State

SILENCE_PERIODS = 1.5  # another controller leads when the leader has left the states of this long unanswered
MIN_SILENCE_S = 0.03  # robot time: the silence that is waited for is never shorter
MIN_SLEEP_S = 0.03  # local time: a shorter pause between two looks at the clock is a busy machine, not a sleep
LISTENING_S = 0.03  # local time for which a leader in doubt listens before it commands again
MAX_STANDBYS = 16  # standby controllers that are remembered: anybody can announce a name
MAX_RANK = 3  # periods that a standby waits at most for those of a lower number
ABOVE_EVERY_SEQ = 2**64  # larger than every sequence number: no command of our own epoch counts if it comes from elsewhere


class Leadership:
    """
    Decides whether one controller leads or stands by.

    The caller hands in what it hears, each with its time. After each call, commands
    of the controller act or do not, as `acting` says.

    Attributes:
        number: What the controller's epochs end with.
        epoch: Of its commands.
        leading: Whether it leads.
        misfit: Why it takes over from nobody: whoever leads has another configuration, and ours never led. Empty while it may.
    """

    def __init__(
        self, number: int, epoch: int, *, config_hash: int, dt_s: float, standby: bool, say: Callable[[Notice], None], local_ns: int = 0
    ) -> None:
        """
        Begin to lead, or to stand by.

        Args:
            number: Of `rti_mpc.contract.epoch.NUMBER_BITS`, drawn at random.
            epoch: Of the first commands, at least; above all that were heard.
            config_hash: Of the controller's configuration.
            dt_s: Period of the controller, s.
            standby: Whether it stands by at first.
            say: Takes a notice.
            local_ns: Local monotonic time.
        """
        self.number = number
        self.epoch = epoch_above(epoch - 1, number)
        self.leading = not standby
        self.misfit = ""
        self._config_hash = config_hash
        self._say = say
        self._dt_ns = round(1e9 * dt_s)
        self._silence_ns = round(1e9 * max(SILENCE_PERIODS * dt_s, MIN_SILENCE_S))
        self._late_ns = -((self._dt_ns - self._silence_ns) // self._dt_ns) * self._dt_ns  # age of a state not answered at which another leads
        self._last = (
            (0, -1) if standby else (self.epoch, ABOVE_EVERY_SEQ)
        )  # the last command of the highest epoch, ours included; a guard counts its own
        self._belongs = not standby  # whether a controller of this configuration has ever led this robot
        self._robot_epoch = 0
        self._seen_ns = 0  # stamp of the last state
        self._quiet_ns = 0  # stamp of the last state that the leader, we or another, is known to have answered, or from which on we listen
        self._doubt_ns: int | None = None  # local time from which on this leader is in doubt
        self._replaced = (0, -1)  # the last command of the leader before
        self._took_over: Notice | None = None  # until the first command
        self._looked_ns = local_ns
        self._company: frozenset[int] = frozenset()  # numbers of those who stand by
        self._accompanied = False  # whether there ever was one

    @property
    def acting(self) -> int | None:
        """Epoch of the controller's commands if they act, None if they do not: it stands by, or is in doubt."""
        return self.epoch if self.leading and self._doubt_ns is None else None

    @property
    def known(self) -> int:
        """Highest epoch that is followed, of ours or of another's."""
        return self._last[0]

    @property
    def replaced(self) -> int | None:
        """Epoch of the leader that was replaced, until the first command of this one, which acts; else None."""
        return None if self._took_over is None or self.acting is None else self._replaced[0]

    @property
    def relieved(self) -> bool:
        """Whether another one takes over when this one ends."""
        return not self.leading or bool(self._company)

    def meet(self, number: int, *, present: bool) -> None:
        """Count one of those who stand by, or one less; in any thread."""
        if number == self.number:
            return
        if not present:
            self._company = self._company - {number}
        elif len(self._company) < MAX_STANDBYS:
            self._company = self._company | {number}
        self._accompanied = True

    def look(self, local_ns: int, rate: float) -> None:
        """
        Take note of the time, and be in doubt after a sleep.

        Args:
            local_ns: Local monotonic time.
            rate: Seconds of the robot per local second.
        """
        slept_ns, self._looked_ns = local_ns - self._looked_ns, local_ns
        if slept_ns > 1e9 * MIN_SLEEP_S and rate * slept_ns > self._silence_ns:
            self._doubt(local_ns)

    def follow(self, command: Command, *, late: bool = False) -> bool:
        """
        Take in what another controller commands, and stand by if it leads.

        Args:
            command: Of anybody; one that does not go on from the last one, or is for another life of the robot, does not act.
            late: Whether it came before the first command of a leader that has taken over, and is to be answered to the one that was replaced.

        Returns:
            Whether it acts.
        """
        last = self._replaced if late and self._took_over is not None else self._last
        if self._robot_epoch and command.state_epoch != self._robot_epoch:
            return False
        if not (command.epoch > last[0] or (command.epoch == last[0] and last[1] < command.seq <= last[1] + MAX_SEQ_GAP)):
            return False
        if late and self._took_over is not None:
            self._took_over = None
            self._stand_by()
        self._last = command.epoch, command.seq
        self.fit(command.config_hash)
        if self.leading:
            self._stand_by()
            whose = "" if command.config_hash == self._config_hash else f" of another configuration, {command.config_hash:016x},"
            text = f"stands by: epoch {command.epoch}{whose} leads, ours was {self.epoch}"
            self._say(Notice(Severity.WARNING, "stepped_down", text))
        if command.state_epoch == self._robot_epoch:
            self._quiet_ns = max(self._quiet_ns, command.state_stamp_ns)
        return True

    def hear(self, state: State, local_ns: int, *, late_ns: int, ready: bool) -> None:
        """
        Decide who answers a state; before the controller does, and when all was taken in that others have commanded.

        Args:
            state: The state.
            local_ns: Local monotonic time.
            late_ns: How late it comes, robot time.
            ready: Whether the controller has something to command.
        """
        elapsed_ns, self._seen_ns = state.stamp_ns - self._seen_ns, state.stamp_ns
        if state.epoch != self._robot_epoch or not ready or elapsed_ns < 0:  # the clock of the robot may be set back
            self._robot_epoch, self._quiet_ns = state.epoch, state.stamp_ns
        elif not self.leading and (elapsed_ns >= self._silence_ns or late_ns >= self._late_ns):
            # Held up, as the leader may be, which listens first; a clock of the robot that has waited looks late by more than any state.
            self._quiet_ns = state.stamp_ns + max(0, min(late_ns, self._late_ns)) + round(1e9 * LISTENING_S)
        silent_ns = state.stamp_ns - self._quiet_ns
        if not self.leading:
            rank = min(MAX_RANK, sum(number < self.number for number in self._company))
            if silent_ns >= self._silence_ns + rank * self._dt_ns and not self.misfit:
                self._take_over(silent_ns)
                self._quiet_ns = state.stamp_ns  # the silence was another's, and our first sample may be states away
        elif self._doubt_ns is None:
            if silent_ns >= self._silence_ns or late_ns >= self._late_ns:
                self._doubt(local_ns)
        elif local_ns - self._doubt_ns >= 1e9 * LISTENING_S:
            self._doubt_ns = None

    def sends(self, command: Command) -> bool:
        """Whether a command is ours to send; it then counts as sent."""
        if self.acting is None:
            return False
        if self._took_over is not None:
            self._say(self._took_over)
            self._took_over = None
        self._quiet_ns = command.state_stamp_ns
        return True

    def fit(self, config_hash: int) -> None:
        """Take over from whoever falls silent, if a controller of our configuration has ever led; else from none of another one."""
        self._belongs |= config_hash == self._config_hash
        misfit = "" if self._belongs else differ(config_hash, self._config_hash)
        if misfit and misfit != self.misfit:
            self._say(Notice(Severity.ERROR, "misfit", f"{misfit}: it takes over from nobody"))
        self.misfit = misfit

    def _take_over(self, silent_ns: int) -> None:
        self._replaced = self._last
        self.epoch = epoch_above(max(self.epoch - 1, self._last[0]), self.number)
        self._last = self.epoch, ABOVE_EVERY_SEQ
        self.leading = self._belongs = True
        text = f"leads from now on, with epoch {self.epoch}: nobody has answered a state for {1e-9 * silent_ns:.3f} s"
        self._took_over = Notice(Severity.WARNING, "took_over", text)

    def _stand_by(self) -> None:
        self.leading = False
        self._quiet_ns, self._doubt_ns = self._seen_ns, None

    def _doubt(self, local_ns: int) -> None:
        """Say nothing for a while, if there is somebody who may lead by now."""
        if self.leading and self._accompanied:
            self._doubt_ns = local_ns


def differ(leader: int, ours: int) -> str:
    """Say that configurations differ."""
    return f"a standby needs the leader's configuration: its hash is {leader:016x}, ours {ours:016x}"
