# SPDX-License-Identifier: Apache-2.0
"""
Who leads: of the controllers of one robot, the one of the highest epoch.

There is no arbiter. Receivers take commands of the highest epoch they have
heard and no others, and so does each controller: one that hears a higher epoch
than its own stands by. It then plans like the leader, unheard, until the leader
leaves states unanswered for `SILENCE_PERIODS`; then it leads, with a higher
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

import re
import secrets
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from threading import Event
from typing import Any

from rti_mpc.controller import Controller
from rti_mpc.epoch import NUMBER_BITS, SEQ_AHEAD, epoch_above, highest_believed
from rti_mpc.errors import MessageError
from rti_mpc.message import Command, Notice, Severity, State
from rti_mpc.status import Mode
from rti_mpc.wire import document
from rti_mpc.wire.bus import RING_MESSAGES, Bus, Received, unix_s

LEADER, STANDBY = "controller", "standby"  # roles
HEARING_S = 0.5  # for which a starting controller listens for others
SILENCE_PERIODS = 1.5  # of the leader, by the states it did not answer, after which another leads
SILENCE_S = 0.03  # at least, robot time
ASLEEP_S = 0.03  # without a look at the clock, at least: less is a busy machine
DOUBT_S = 0.03  # for which a leader in doubt listens, local time
COMPANY = 16  # others standing by of whom is known: a name costs nothing
RANKS = 3  # periods that one who stands by leaves to those of a lower number, at most
NUMBERED = re.compile(rf"{STANDBY}\.([0-9]{{1,7}})")  # role of one who stands by
OWN = 2**64  # above every sequence number: nobody else's command of our epoch counts
UNREADY = (Mode.IDLE, Mode.WAITING)  # with nothing to command


@dataclass(frozen=True)
class Others:
    """
    What a starting controller hears of others.

    Attributes:
        epoch: Highest epoch of a controller or a guard, 0 if there is none.
        config_hash: Of the controller that leads, None if there is none.
    """

    epoch: int
    config_hash: int | None


def hear_others(bus: Bus, stop: Event) -> Others:
    """Listen for `HEARING_S`."""
    commands = [bus.subscriber(key, capacity=RING_MESSAGES) for key in (bus.keys.command, bus.keys.actuation)]
    infos = bus.subscriber(bus.keys.info(LEADER), capacity=RING_MESSAGES)
    intake = bus.intake(Command, HEARING_S, choosing=True)
    stop.wait(HEARING_S)
    epoch = max(intake.highest_epoch(subscriber.drain()) for subscriber in commands)
    highest = highest_believed(unix_s(), epoch, choosing=True)
    leaders = [info for received in infos.drain() if (info := leader_info(received, highest)) is not None]
    leader = max(leaders, key=lambda info: (info["epoch"], info["seq"]), default=None)
    return Others(epoch, None) if leader is None else Others(max(epoch, leader["epoch"]), leader["config_hash"])


def leader_info(received: Received, highest: int) -> dict[str, Any] | None:
    """Return a leader's description of itself, if it is one; its epoch is at most `highest`."""
    try:
        info = document.read(received.payload, received.size)
    except MessageError:
        return None
    whole = all(type(number := info.get(name)) is int and number >= 0 for name in ("epoch", "seq", "config_hash"))
    return info if whole and info["epoch"] <= highest else None


class Leadership:
    """
    Whether one controller leads or stands by.

    Attributes:
        commands_in: Door of what other controllers send.
        leading: Whether it leads.
        epoch: Of its commands; those of the robot's first leader are the Unix seconds at its start, times ``2 ** NUMBER_BITS``, or above.
        misfit: Why it takes over from nobody: whoever leads has another configuration, and ours never led. Empty while it may.
    """

    def __init__(self, bus: Bus, controller: Controller, others: Others, *, config_hash: int, dt_s: float, nu: int, standby: bool) -> None:
        self.commands_in = bus.intake(Command, SILENCE_S, {"u": nu}, choosing=True)
        self.number = secrets.randbits(NUMBER_BITS)
        self.epoch = epoch_above(max(others.epoch, unix_s() << NUMBER_BITS), self.number)
        self.leading = False
        self.misfit = ""
        self._bus = bus
        self._controller = controller
        self._config_hash = config_hash
        self._dt_ns = round(1e9 * dt_s)
        self._silence_ns = round(1e9 * max(SILENCE_PERIODS * dt_s, SILENCE_S))
        self._late_ns = -((self._dt_ns - self._silence_ns) // self._dt_ns) * self._dt_ns  # age of a state not answered at which another leads
        self._last = (0, -1)  # epoch and sequence number of the last command of the highest epoch, ours included; a guard counts its own
        self._belongs = False  # whether a controller of this configuration has ever led this robot
        self._robot_epoch = 0
        self._seen_ns = 0  # stamp of the last state
        self._quiet_ns = 0  # stamp of the last state that the leader, we or another, is known to have answered, or from which on we listen
        self._doubt_ns: int | None = None  # local time from which on this leader is in doubt
        self._replaced = (0, -1)  # the last command of the leader before
        self._took_over: Notice | None = None  # until the first command
        self._looked_ns = time.monotonic_ns()
        self._infos = bus.subscriber(bus.keys.info(LEADER), capacity=RING_MESSAGES)
        self._told = (0, -1)  # epoch and sequence number of the last description of a leader that was read
        self._commands = bus.subscriber(bus.keys.command, capacity=RING_MESSAGES)
        self._tokens: dict[str, Any] = {}
        self._company: set[int] = set()  # numbers of those who stand by
        self._accompanied = False  # whether there ever was one
        if not standby:
            self._lead()
        bus.watch_alive(self._meet)
        controller.shadowing = standby

    @property
    def role(self) -> str:
        """Role it plays."""
        return LEADER if self.leading else STANDBY

    @property
    def relieved(self) -> bool:
        """Whether another one takes over when this one ends."""
        return not self.leading or bool(self._company)

    def hear(self, state: State, local_ns: int) -> None:
        """
        Decide who answers a state; before the controller does.

        Args:
            state: The state.
            local_ns: Local monotonic time.
        """
        self.listen(local_ns)
        elapsed_ns = state.stamp_ns - self._seen_ns
        late_ns = self._controller.robot_now_ns(local_ns) - state.stamp_ns
        self._seen_ns = state.stamp_ns
        if state.epoch != self._robot_epoch or self._controller.mode in UNREADY or elapsed_ns < 0:  # the clock of the robot may be set back
            self._robot_epoch, self._quiet_ns = state.epoch, state.stamp_ns
        elif not self.leading and (elapsed_ns >= self._silence_ns or late_ns >= self._late_ns):
            # Held up, as the leader may be, which listens first; a clock of the robot that has waited looks late by more than any state.
            self._quiet_ns = state.stamp_ns + max(0, min(late_ns, self._late_ns)) + round(1e9 * DOUBT_S)
        silent_ns = state.stamp_ns - self._quiet_ns
        if not self.leading:
            rank = min(RANKS, sum(number < self.number for number in self._company))
            if silent_ns >= self._silence_ns + rank * self._dt_ns and not self.misfit:
                self._replaced = self._last
                self._lead()
                self._quiet_ns = state.stamp_ns  # the silence was another's, and our first sample may be states away
                text = f"leads from now on, with epoch {self.epoch}: nobody has answered a state for {1e-9 * silent_ns:.3f} s"
                self._took_over = Notice(Severity.WARNING, "took_over", text)
        elif self._doubt_ns is None:
            if silent_ns >= self._silence_ns or late_ns >= self._late_ns:
                self._doubt(local_ns)
        elif local_ns - self._doubt_ns >= 1e9 * DOUBT_S:
            self._doubt_ns = None
            self._controller.lead(self.epoch)

    def sends(self, command: Command) -> bool:
        """Whether a command is ours to send; it then counts as sent. The first one is not if the one that was replaced has answered after all."""
        if not self.leading or self._doubt_ns is not None:
            return False
        if self._took_over is not None:
            notice, self._took_over = self._took_over, None
            late = list(self._heard(self._replaced))
            if late:
                self._last = self._replaced
                self._stand_by()
                for command in late:
                    self._follow(command)
                return False
            self._controller.notices.append(notice)
        self._quiet_ns = command.state_stamp_ns
        return True

    def listen(self, local_ns: int) -> None:
        """
        Take in what others command, and stand by if one of them leads.

        Args:
            local_ns: Local monotonic time.
        """
        slept_ns, before_ns, self._looked_ns = local_ns - self._looked_ns, self._looked_ns, local_ns
        if slept_ns > 1e9 * ASLEEP_S and self._controller.robot_now_ns(local_ns) - self._controller.robot_now_ns(before_ns) > self._silence_ns:
            self._doubt(local_ns)
        for command in self._heard(self._last):
            self._follow(command)

    def leader(self) -> Mapping[str, Any] | None:
        """Return what the leader has last said of itself, once; None while this one leads."""
        waiting = self._infos.drain()
        if self.leading:
            return None
        news, highest = None, highest_believed(unix_s(), self._last[0], choosing=True)
        for received in waiting:
            info = leader_info(received, highest)
            if info is not None and info["epoch"] >= self._last[0] and (info["epoch"], info["seq"]) > self._told:
                news, self._told = info, (info["epoch"], info["seq"])
        if news is not None:
            self._fit(news["config_hash"])
        return news

    def declare(self) -> bool:
        """Show on the bus which role is played, if that has changed, and tell whether it has; off the path from state to command."""
        roles = (LEADER,) if self.leading else (STANDBY, f"{STANDBY}.{self.number}")
        if tuple(self._tokens) == roles:
            return False
        before, self._tokens = self._tokens, {role: self._bus.alive(role) for role in roles}
        for token in before.values():
            token.undeclare()
        return True

    def _lead(self) -> None:
        self.epoch = epoch_above(max(self.epoch - 1, self._last[0]), self.number)
        self._last = self.epoch, OWN
        self.leading = self._belongs = True
        self._controller.lead(self.epoch)

    def _heard(self, last: tuple[int, int]) -> Iterator[Command]:
        """Yield what others have commanded since the last call and after a command, for this life of the robot: all else does not act."""
        while (received := self._commands.try_recv()) is not None:
            command = self.commands_in.read(received, known=last[0])
            if command is None or (self._robot_epoch and command.state_epoch != self._robot_epoch):
                continue
            if command.epoch > last[0] or (command.epoch == last[0] and last[1] < command.seq <= last[1] + SEQ_AHEAD):
                last = command.epoch, command.seq
                yield command

    def _stand_by(self) -> None:
        self.leading = False
        self._controller.shadowing = True
        self._quiet_ns, self._doubt_ns = self._seen_ns, None

    def _doubt(self, local_ns: int) -> None:
        """Say nothing for a while, if there is somebody who may lead by now."""
        if self.leading and self._accompanied:
            self._doubt_ns = local_ns
            self._controller.shadowing = True

    def _follow(self, command: Command) -> None:
        """Let somebody else's command act: its epoch is the highest."""
        self._last = command.epoch, command.seq
        self._fit(command.config_hash)
        if self.leading:
            self._stand_by()
            whose = "" if command.config_hash == self._config_hash else f" of another configuration, {command.config_hash:016x},"
            text = f"stands by: epoch {command.epoch}{whose} leads, ours was {self.epoch}"
            self._controller.notices.append(Notice(Severity.WARNING, "stepped_down", text))
        self._controller.overhear(command)
        if command.state_epoch == self._robot_epoch:
            self._quiet_ns = max(self._quiet_ns, command.state_stamp_ns)

    def _fit(self, config_hash: int) -> None:
        """Take over from whoever falls silent, if a controller of our configuration has ever led; else from none of another one."""
        self._belongs |= config_hash == self._config_hash
        misfit = "" if self._belongs else differ(config_hash, self._config_hash)
        if misfit and misfit != self.misfit:
            self._controller.notices.append(Notice(Severity.ERROR, "misfit", f"{misfit}: it takes over from nobody"))
        self.misfit = misfit

    def _meet(self, role: str, present: bool) -> None:
        """Count who stands by; in a thread of the bus."""
        numbered = NUMBERED.fullmatch(role)
        if numbered is None or (number := int(numbered[1])) == self.number:
            return
        if not present:
            self._company = self._company - {number}
        elif len(self._company) < COMPANY:
            self._company = self._company | {number}
        self._accompanied = True


def differ(leader: int, ours: int) -> str:
    """Say that configurations differ."""
    return f"a standby needs the leader's configuration: its hash is {leader:016x}, ours {ours:016x}"
