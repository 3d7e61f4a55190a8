# SPDX-License-Identifier: Apache-2.0
"""
Leadership of one process: it listens to other controllers, and lets its own controller lead or stand by.

`rti_mpc.contract.leadership` decides who leads. This module connects it to the bus, the clock and the controller.
"""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Iterator
from dataclasses import dataclass
from threading import Event
from typing import Any

from rti_mpc.contract.epoch import NUMBER_BITS, highest_believed
from rti_mpc.contract.leadership import MIN_SILENCE_S, Leadership, differ, differ_in_model
from rti_mpc.contract.message import Command, State
from rti_mpc.contract.status import Mode
from rti_mpc.control.controller import Controller
from rti_mpc.wire.bus import RING_MESSAGES, Bus, Received, Subscriber, unix_s
from rti_mpc.wire.info import Leader

LEADER, STANDBY = "controller", "standby"  # roles
LISTEN_BEFORE_START_S = 0.5  # how long a starting controller listens for others
MAX_MESSAGES_PER_LOOK = 64  # at 100 looks per second three times the rate of a sender of 2000 messages per second
MAX_BYTES_PER_LOOK = 65_536  # 64 commands of 60 rows
NUMBERED_STANDBY = re.compile(rf"{STANDBY}\.([0-9]{{1,7}})")  # role of a numbered standby
UNREADY_MODES = (Mode.IDLE, Mode.WAITING)  # modes without a command to send


@dataclass(frozen=True)
class Others:
    """
    Other controllers, as a starting controller has heard them.

    Attributes:
        epoch: Highest epoch of a controller or a guard, 0 if there is none.
        leader: Description of the leading controller, None if there is none.
    """

    epoch: int
    leader: Leader | None = None

    def misfit(self, config_hash: int, model_hash: str) -> str:
        """Return why a controller with these hashes cannot stand by the leader; empty if it can, or if nobody leads."""
        leader = self.leader
        if leader is None:
            return ""
        if leader.config_hash != config_hash:
            return differ(leader.config_hash, config_hash)
        if leader.model_hash in ("", model_hash):
            return ""
        return differ_in_model(leader.model_hash, model_hash)


def hear_others(bus: Bus, stop: Event) -> Others:
    """Listen to other controllers for `LISTEN_BEFORE_START_S`."""
    commands = [bus.subscriber(key, capacity=RING_MESSAGES) for key in (bus.keys.command, bus.keys.actuation)]
    infos = bus.subscriber(bus.keys.info(LEADER), capacity=RING_MESSAGES)
    intake = bus.intake(Command, LISTEN_BEFORE_START_S, choosing=True)
    stop.wait(LISTEN_BEFORE_START_S)
    epoch = max(intake.highest_epoch(subscriber.drain()) for subscriber in commands)
    highest = highest_believed(unix_s(), epoch, choosing=True)
    leaders = [leader for received in infos.drain() if (leader := Leader.from_received(received, highest)) is not None]
    leader = max(leaders, key=lambda leader: (leader.epoch, leader.seq), default=None)
    return Others(epoch if leader is None else max(epoch, leader.epoch), leader)


class Candidate:
    """
    One controller among others on the bus.

    Attributes:
        commands_in: Intake of other controllers' commands.
    """

    def __init__(
        self, bus: Bus, controller: Controller, others: Others, *, config_hash: int, model_hash: str, dt_s: float, nu: int, standby: bool
    ) -> None:
        self.commands_in = bus.intake(Command, MIN_SILENCE_S, {"u": nu}, choosing=True)
        number, epoch = secrets.randbits(NUMBER_BITS), max(others.epoch, unix_s() << NUMBER_BITS) + 1
        self._decision = Leadership(
            number,
            epoch,
            config_hash=config_hash,
            model_hash=model_hash,
            dt_s=dt_s,
            standby=standby,
            say=controller.say,
            local_ns=time.monotonic_ns(),
        )
        self._bus = bus
        self._controller = controller
        self._acting: int | None = None  # epoch with which the controller's commands act; None: they do not
        self._infos = bus.subscriber(bus.keys.info(LEADER), capacity=RING_MESSAGES)
        self._told = (0, -1)  # epoch and sequence number of the last description of a leader that was read
        self._news: Leader | None = None  # the last description, until it is returned
        self._commands = bus.subscriber(bus.keys.command, capacity=RING_MESSAGES)
        self._tokens: dict[str, Any] = {}
        controller.stand_by()
        self._apply()
        bus.watch_alive(self._meet)

    @property
    def leading(self) -> bool:
        """Whether this controller leads."""
        return self._decision.leading

    @property
    def epoch(self) -> int:
        """Epoch of its commands; the first leader's is at least the Unix seconds at its start times ``2 ** NUMBER_BITS``."""
        return self._decision.epoch

    @property
    def role(self) -> str:
        """Present role, ``"controller"`` or ``"standby"``."""
        return LEADER if self.leading else STANDBY

    @property
    def relieved(self) -> bool:
        """Whether another controller takes over when this one ends."""
        return self._decision.relieved

    def receive_state(self, state: State, local_ns: int) -> None:
        """
        Decide who answers a state; to be called before the controller receives it.

        Args:
            state: The state.
            local_ns: Local monotonic time.
        """
        self.listen(local_ns)
        late_ns = self._controller.robot_now_ns(local_ns) - state.stamp_ns
        self._decision.receive_state(state, local_ns, late_ns=late_ns, ready=self._controller.mode not in UNREADY_MODES)
        self._apply()

    def sends(self, command: Command) -> bool:
        """Whether to send a command, which then counts as sent. The first one is not sent if the replaced leader has answered after all."""
        if (replaced := self._decision.replaced) is not None:
            self._follow(replaced, late=True)
        return self._decision.sends(command)

    def listen(self, local_ns: int) -> None:
        """
        Process the commands of other controllers, and stand by if one of them leads.

        Args:
            local_ns: Local monotonic time.
        """
        self._decision.note_time(local_ns, self._controller.robot_rate)
        self._follow(self._decision.known)

    def leader(self) -> Leader | None:
        """Return the leader's last description, each one once; while this controller leads None, and the next leader's is kept."""
        known = self._decision.known
        least = known + 1 if self.leading else known
        highest = highest_believed(unix_s(), known, choosing=True)
        for received in self._look(self._infos):
            leader = Leader.from_received(received, highest)
            if leader is not None and leader.epoch >= least and (leader.epoch, leader.seq) > self._told:
                self._news, self._told = leader, (leader.epoch, leader.seq)
        if self.leading or self._news is None:
            return None
        news, self._news = self._news, None
        if news.epoch < known:
            return None
        self._decision.fit_model(news.epoch, news.model_hash)
        self._decision.fit(news.config_hash)
        return news

    def declare(self) -> bool:
        """Show the present role on the bus, and return whether it has changed; called off the path from state to command."""
        roles = (LEADER,) if self.leading else (STANDBY, f"{STANDBY}.{self._decision.number}")
        if tuple(self._tokens) == roles:
            return False
        before, self._tokens = self._tokens, {role: self._bus.alive(role) for role in roles}
        for token in before.values():
            token.undeclare()
        return True

    def _follow(self, known: int, *, late: bool = False) -> None:
        """Process waiting commands of others; the controller takes over those that act on the robot."""
        for received in self._look(self._commands):
            command = self.commands_in.read(received, known=known)
            if command is not None and self._decision.follow(command, late=late):
                known = command.epoch
                self._controller.overhear(command)
        self._apply()

    def _look(self, subscriber: Subscriber) -> Iterator[Received]:
        """Yield waiting messages, oldest first, up to the limits per look; the rest keeps waiting."""
        size = 0
        for _ in range(MAX_MESSAGES_PER_LOOK):
            if size >= MAX_BYTES_PER_LOOK or (received := subscriber.try_recv()) is None:
                return
            size += len(received.payload)
            yield received

    def _apply(self) -> None:
        """Let the controller lead or stand by, as decided."""
        if (acting := self._decision.acting) == self._acting:
            return
        self._acting = acting
        if acting is None:
            self._controller.stand_by()
        else:
            self._controller.lead(acting)

    def _meet(self, role: str, present: bool) -> None:
        """Count the standbys; called in a thread of the bus."""
        if (numbered := NUMBERED_STANDBY.fullmatch(role)) is not None:
            self._decision.meet(int(numbered[1]), present=present)
