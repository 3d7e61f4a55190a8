# SPDX-License-Identifier: Apache-2.0
"""
Leader election among the controllers of one robot: the highest epoch leads.

It reads no clock: every time is a stamp of the robot or local monotonic time that the
caller hands in. There is no arbiter. Receivers take commands of the highest epoch they
have heard and no others, and so does each controller: one that hears a higher epoch than
its own stands by. A standby plans like the leader, but publishes no command, until the
leader has left states unanswered for `SILENCE_PERIODS`; then it leads, with a higher
epoch. Of several standbys the one with the lowest number is first, the others wait one
period longer each.

A leader is in doubt if it has itself left states unanswered for that long, or receives a
state so late that another may lead by now: then it sends nothing until it has listened. A
standby that has missed states, or receives one so late, cannot judge the leader's
silence, since the host may have held up both. It counts anew, from the time at which a
leader would have listened.

The low bits of an epoch are the number of its owner, drawn at its start: whatever two
controllers have heard, they never choose the same epoch.
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
    Decision whether one controller leads or stands by.

    The caller hands in all that it hears, with the time. After each call `acting` says
    whether commands of the controller act.

    Attributes:
        number: Low bits of the controller's epochs.
        epoch: Epoch of its commands.
        leading: Whether it leads.
    """

    def __init__(
        self,
        number: int,
        epoch: int,
        *,
        config_hash: int,
        dt_s: float,
        standby: bool,
        say: Callable[[Notice], None],
        model_hash: str,
        local_ns: int = 0,
    ) -> None:
        """
        Begin to lead, or to stand by.

        Args:
            number: Number of `rti_mpc.contract.epoch.NUMBER_BITS` bits, drawn at random.
            epoch: Lower limit of the first epoch; above all epochs that were heard.
            config_hash: Hash of the controller's configuration.
            dt_s: Period of the controller, s.
            standby: Whether it stands by at first.
            say: Receiver of notices.
            model_hash: Hash of its model's equations; empty if it fits any.
            local_ns: Local monotonic time.
        """
        self.number = number
        self.epoch = epoch_above(epoch - 1, number)
        self.leading = not standby
        self._config_hash = config_hash
        self._model_hash = model_hash
        self._other_config = ""  # why it takes over from nobody, in words: the leader has another configuration
        self._described = (0, "")  # epoch and model of the leader that has described itself last
        self._told_misfit = ""
        self._say = say
        self._dt_ns = round(1e9 * dt_s)
        self._silence_ns = round(1e9 * max(SILENCE_PERIODS * dt_s, MIN_SILENCE_S))
        self._late_ns = (
            -((self._dt_ns - self._silence_ns) // self._dt_ns) * self._dt_ns
        )  # age of an unanswered state at which another controller leads
        self._last = (0, -1) if standby else (self.epoch, ABOVE_EVERY_SEQ)  # epoch and number of the last command of the highest epoch
        self._belongs = not standby  # whether a controller of this configuration has ever led this robot
        self._robot_epoch = 0
        self._seen_ns = 0  # stamp of the last state
        self._quiet_ns = 0  # stamp of the last state that the leader is known to have answered, or from which this one listens
        self._doubt_ns: int | None = None  # local time from which on this leader is in doubt
        self._replaced = (0, -1)  # the last command of the leader before
        self._took_over: Notice | None = None  # notice of the takeover, until the first command
        self._looked_ns = local_ns
        self._company: frozenset[int] = frozenset()  # numbers of those who stand by
        self._accompanied = False  # whether there ever was one

    @property
    def acting(self) -> int | None:
        """Epoch of the controller's commands if they act; None if it stands by or is in doubt."""
        return self.epoch if self.leading and self._doubt_ns is None else None

    @property
    def known(self) -> int:
        """Highest epoch that is followed, this controller's or another's."""
        return self._last[0]

    @property
    def replaced(self) -> int | None:
        """Epoch of the leader that was replaced, until this controller's first command; else None."""
        return None if self._took_over is None or self.acting is None else self._replaced[0]

    @property
    def misfit(self) -> str:
        """Why it takes over from nobody: the leader has another configuration, and none of ours has led, or another model. Empty if it may."""
        epoch, model_hash = self._described
        foreign = epoch >= self.known and "" not in (model_hash, self._model_hash) and model_hash != self._model_hash
        return self._other_config or (differ_in_model(model_hash, self._model_hash) if foreign else "")

    @property
    def relieved(self) -> bool:
        """Whether another controller leads when this one ends."""
        return not self.leading or bool(self._company)

    def meet(self, number: int, *, present: bool) -> None:
        """Add or remove a standby by its number; may be called in any thread."""
        if number == self.number:
            return
        if not present:
            self._company = self._company - {number}
        elif len(self._company) < MAX_STANDBYS:
            self._company = self._company | {number}
        self._accompanied = True

    def note_time(self, local_ns: int, rate: float) -> None:
        """
        Note the time; after a sleep the leader is in doubt.

        Args:
            local_ns: Local monotonic time.
            rate: Seconds of the robot per local second.
        """
        slept_ns, self._looked_ns = local_ns - self._looked_ns, local_ns
        if slept_ns > 1e9 * MIN_SLEEP_S and rate * slept_ns > self._silence_ns:
            self._doubt(local_ns)

    def follow(self, command: Command, *, late: bool = False) -> bool:
        """
        Take a command of another controller, and stand by if that one leads.

        Args:
            command: Command of any controller; one that does not continue the last one, or is for another life of the robot, does not act.
            late: Whether it came after a takeover, but before the new leader's first command: then it must continue the replaced leader's last one.

        Returns:
            Whether the command acts.
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
            text = f"stands by: epoch {command.epoch}{whose} leads, this controller's was {self.epoch}"
            self._say(Notice(Severity.WARNING, "stepped_down", text))
        if command.state_epoch == self._robot_epoch:
            self._quiet_ns = max(self._quiet_ns, command.state_stamp_ns)
        return True

    def receive_state(self, state: State, local_ns: int, *, late_ns: int, ready: bool) -> None:
        """
        Decide who answers a state. Called before the controller answers it, and after all commands of others were handed in.

        Args:
            state: The state.
            local_ns: Local monotonic time.
            late_ns: Lateness of the state, robot time.
            ready: Whether the controller has something to command.
        """
        elapsed_ns, self._seen_ns = state.stamp_ns - self._seen_ns, state.stamp_ns
        if state.epoch != self._robot_epoch or not ready or elapsed_ns < 0:  # the robot's clock may have gone back
            self._robot_epoch, self._quiet_ns = state.epoch, state.stamp_ns
        elif not self.leading and (elapsed_ns >= self._silence_ns or late_ns >= self._late_ns):
            # This process was held up, and so may be the leader, which then listens first. The limit is for a robot's clock that has waited.
            self._quiet_ns = state.stamp_ns + max(0, min(late_ns, self._late_ns)) + round(1e9 * LISTENING_S)
        silent_ns = state.stamp_ns - self._quiet_ns
        if not self.leading:
            rank = min(MAX_RANK, sum(number < self.number for number in self._company))
            if silent_ns >= self._silence_ns + rank * self._dt_ns and not self.misfit:
                self._take_over(silent_ns)
                self._quiet_ns = state.stamp_ns  # the silence was the other leader's; the first sample of this one may be several states away
        elif self._doubt_ns is None:
            if silent_ns >= self._silence_ns or late_ns >= self._late_ns:
                self._doubt(local_ns)
        elif local_ns - self._doubt_ns >= 1e9 * LISTENING_S:
            self._doubt_ns = None

    def sends(self, command: Command) -> bool:
        """Return whether this controller may send a command; it then counts as sent."""
        if self.acting is None:
            return False
        if self._took_over is not None:
            self._say(self._took_over)
            self._took_over = None
        self._quiet_ns = command.state_stamp_ns
        return True

    def fit(self, config_hash: int) -> None:
        """Compare the leader's configuration: unless one of ours has ever led, this controller takes over from none of another configuration."""
        self._belongs |= config_hash == self._config_hash
        self._other_config = "" if self._belongs else differ(config_hash, self._config_hash)
        self._tell_misfit()

    def fit_model(self, epoch: int, model_hash: str) -> None:
        """
        Compare the model of the leader of an epoch: from one with other equations this controller never takes over, whoever has led before.

        Of one configuration, its plans would be those of another robot. The next leader is judged by its own model.
        """
        self._described = epoch, model_hash
        self._tell_misfit()

    def _tell_misfit(self) -> None:
        misfit = self.misfit
        if misfit and misfit != self._told_misfit:
            self._say(Notice(Severity.ERROR, "misfit", f"{misfit}: this standby does not take over"))
        self._told_misfit = misfit

    def _take_over(self, silent_ns: int) -> None:
        self._replaced = self._last
        self.epoch = epoch_above(max(self.epoch - 1, self._last[0]), self.number)
        self._last = self.epoch, ABOVE_EVERY_SEQ
        self.leading = self._belongs = True
        text = f"leads from now on, with epoch {self.epoch}: no controller has answered a state for {1e-9 * silent_ns:.3f} s"
        self._took_over = Notice(Severity.WARNING, "took_over", text)

    def _stand_by(self) -> None:
        self.leading = False
        self._quiet_ns, self._doubt_ns = self._seen_ns, None

    def _doubt(self, local_ns: int) -> None:
        """Send nothing for a while, if another controller may lead by now."""
        if self.leading and self._accompanied:
            self._doubt_ns = local_ns


def differ(leader: int, ours: int) -> str:
    """Return the text that two configurations differ."""
    return f"a standby needs the leader's configuration: its hash is {leader:016x}, this standby's {ours:016x}"


def differ_in_model(leader: str, ours: str) -> str:
    """Return the text that two models differ."""
    return f"a standby needs the leader's model: the hash of its equations is {leader}, this standby's {ours}"
