# SPDX-License-Identifier: Apache-2.0
"""Controller among others, on a bus made of lists: messages that it reads and publishes."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import pytest

from rti_mpc.contract.epoch import highest_believed
from rti_mpc.contract.message import Command, Notice, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.wire.bus import Received, unix_s
from rti_mpc.wire.cdr import encode, encoding
from rti_mpc.wire.info import Leader
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.keys import Keys
from rti_mpc_service.controller.leadership import MAX_BYTES_PER_LOOK, MAX_MESSAGES_PER_LOOK, Candidate, Others
from rti_mpc_service.origin import model_hash

DT_S = 0.1
DT_NS = 100_000_000
HASH = 7
MODEL = "00000000000000aa"


@dataclass
class Wire:
    """Messages that all controllers receive from each other."""

    buses: list[WireBus] = field(default_factory=list)

    def put(self, sender: WireBus, payload: bytes, kind: str = encoding(Command)) -> None:
        for bus in self.buses:
            if bus is not sender:
                bus.commands.append(Received(payload, kind, ""))

    def show(self, role: str, present: bool) -> None:
        for bus in self.buses:
            bus.watch(role, present)


class WireBus:
    """As much of a bus as a `Candidate` uses."""

    def __init__(self, wire: Wire) -> None:
        self.keys = Keys()
        self.commands: deque[Received] = deque()
        self.infos: deque[Received] = deque()
        self.watch: Callable[[str, bool], None] = lambda role, present: None
        self._wire = wire
        wire.buses.append(self)

    def subscriber(self, key: str, **_: object) -> Any:
        inbox = {self.keys.command: self.commands, self.keys.info("controller"): self.infos}.get(key, deque())

        class Subscriber:
            def try_recv(self) -> Received | None:
                return inbox.popleft() if inbox else None

            def drain(self) -> list[Received]:
                return []

        return Subscriber()

    def intake(self, cls: Any, stale_s: float, widths: Any, *, choosing: bool) -> Any:
        return Intake(cls, stale_s, widths, unix_s=unix_s, choosing=choosing)

    def watch_alive(self, callback: Callable[[str, bool], None]) -> None:
        self.watch = callback

    def alive(self, role: str) -> Any:
        self._wire.show(role, True)

        class Token:
            def undeclare(token) -> None:
                self._wire.show(role, False)

        return Token()


@dataclass
class Puppet:
    """As much of a controller as a `Candidate` uses."""

    mode: Mode = Mode.TRACKING
    standing_by: bool = False
    epoch: int = 0
    heard: list[Command] = field(default_factory=list)
    said: list[Notice] = field(default_factory=list)
    robot_rate = 1.0

    def say(self, notice: Notice) -> None:
        self.said.append(notice)

    def stand_by(self) -> None:
        self.standing_by = True

    def overhear(self, command: Command) -> None:
        self.heard.append(command)

    def lead(self, epoch: int) -> None:
        self.epoch, self.standing_by = epoch, False

    def robot_now_ns(self, local_ns: int) -> int:
        return local_ns


class One:
    """One controller of several on a wire."""

    def __init__(self, wire: Wire, *, standby: bool) -> None:
        self.bus, self.puppet, self.wire = WireBus(wire), Puppet(), wire
        bus, puppet = cast(Any, self.bus), cast(Any, self.puppet)
        self.leadership = Candidate(bus, puppet, Others(0), config_hash=HASH, model_hash=MODEL, dt_s=DT_S, nu=1, standby=standby)
        self.leadership.declare()
        self._seq = 0

    def see(self, k: float, late_ns: int = 0) -> bool:
        """Be shown the state of a sample; return whether it was answered."""
        stamp_ns = round(k * DT_NS)
        state = State(1, round(10 * k), stamp_ns, np.zeros(1))
        self.leadership.receive_state(state, stamp_ns + late_ns)
        command = self.made(k)
        sends = self.leadership.sends(command)
        if sends:
            self.wire.put(self.bus, encode(command))
        return sends

    def made(self, k: float) -> Command:
        """A command that answers the state of a sample."""
        self._seq += 1
        stamp_ns = round(k * DT_NS)
        head = (self.puppet.epoch, self._seq, stamp_ns, 1, round(10 * k), stamp_ns, stamp_ns + DT_NS, HASH)
        return Command(*head, Mode.TRACKING, QpStatus.SOLVED, DT_NS, np.zeros((1, 1)))


@pytest.fixture
def pair() -> tuple[One, One]:
    """A leader and one that stands by, who have seen some states."""
    wire = Wire()
    pair = One(wire, standby=False), One(wire, standby=True)
    for k in range(1, 5):
        assert [one.see(k) for one in pair] == [True, False]
    return pair


def codes(one: One) -> list[str]:
    return [notice.code for notice in one.puppet.said]


@pytest.mark.parametrize(
    "change", [{"epoch": 2**64 - 1}, {"epoch": 2**63}, {"epoch": 2**52, "state_epoch": 9}, {"state_epoch": 9}, {"seq": 2**64 - 1}]
)
def test_commands_that_act_on_no_robot_change_nobodys_role(pair: tuple[One, One], change: dict[str, int]) -> None:
    leader = pair[0]
    forged = replace(leader.made(4), **{"epoch": leader.leadership.epoch, "seq": 100} | change)
    for k in range(5, 12):
        for one in pair:
            one.bus.commands.append(Received(encode(forged), encoding(Command), ""))
        assert [one.see(k) for one in pair] == [True, False]
    assert leader.leadership.epoch < 2**53


def test_whoever_succeeds_the_highest_epoch_there_can_be_leads_with_one_that_all_believe(pair: tuple[One, One]) -> None:
    leader, standby = pair
    highest = highest_believed(unix_s())
    forged = replace(leader.made(4), epoch=highest)
    for one in pair:
        one.bus.commands.append(Received(encode(forged), encoding(Command), ""))
    answered = [[one.see(k) for one in pair] for k in range(5, 12)]
    assert sum(map(any, answered)) >= 5
    assert forged.epoch < max(leader.leadership.epoch, standby.leadership.epoch) <= highest_believed(0, highest)


def test_a_hundred_names_keep_nobody_from_taking_over(pair: tuple[One, One]) -> None:
    _, standby = pair
    for number in range(100):
        standby.bus.watch(f"standby.{number}", True)
    for name in ("standby.²", "standby.", "standby.-1", "standby." + 5000 * "9", "standby.9" + 7 * "9", "", "."):
        standby.bus.watch(name, True)
        standby.bus.watch(name, False)
    assert any(standby.see(k) for k in range(5, 10))


def test_what_is_no_command_for_this_robot_unseats_nobody_and_is_counted(pair: tuple[One, One]) -> None:
    """Commands for more inputs, or of a later version: they claim to lead, but cannot be played."""
    leader, standby = pair
    command = replace(standby.made(5), epoch=leader.leadership.epoch + 1)
    leader.wire.put(standby.bus, encode(replace(command, u=np.zeros((1, 2)))))
    leader.wire.put(standby.bus, encode(command), encoding(Command).replace("@2", "@1"))
    assert leader.see(5)
    assert leader.leadership.leading
    assert leader.leadership.commands_in.refused == {"length": 1, "version": 1}
    assert not leader.puppet.heard


def test_what_is_decided_reaches_the_controller_and_the_bus(pair: tuple[One, One]) -> None:
    leader, standby = pair
    assert (standby.puppet.standing_by, standby.leadership.role, leader.leadership.relieved) == (True, "standby", True)
    assert [standby.see(k) for k in (5, 6)] == [False, True]
    assert (standby.puppet.standing_by, standby.puppet.epoch) == (False, standby.leadership.epoch)
    assert standby.leadership.declare()
    assert not standby.leadership.declare(), "once per change"
    assert standby.leadership.role == "controller"
    assert not leader.see(7)
    assert (leader.puppet.standing_by, codes(leader), codes(standby)) == (True, ["stepped_down"], ["took_over"])
    assert [command.state_stamp_ns for command in leader.puppet.heard] == [6 * DT_NS]


@pytest.mark.parametrize(("rows", "most"), [(1, MAX_MESSAGES_PER_LOOK), (MAX_BYTES_PER_LOOK // 8, 1)], ids=["many", "long"])
def test_one_look_reads_no_more_than_it_takes_whatever_waits(pair: tuple[One, One], rows: int, most: int) -> None:
    """Each has a higher sequence number than all before, so none is dropped as old."""
    leader, standby = pair
    long = np.zeros((rows, 1))
    flood = [replace(leader.made(4), epoch=leader.leadership.epoch, state_seq=40, seq=100 + i, u=long) for i in range(3 * MAX_MESSAGES_PER_LOOK)]
    waiting = [Received(encode(command), encoding(Command), "") for command in flood]
    before = len(standby.puppet.heard)
    standby.bus.commands.extend(waiting)
    for looks in (1, 2, 3):
        standby.leadership.listen(4 * DT_NS + looks)
        assert len(standby.puppet.heard) - before == looks * most
    assert len(standby.bus.commands) == len(flood) - 3 * most, "the rest waits on"


def test_leader_that_slept_finds_out_within_the_time_it_listens_though_all_that_may_wait_waits(pair: tuple[One, One]) -> None:
    """The new leader's command lies behind a full ring of an old one's, repeated."""
    leader, standby = pair
    old = replace(leader.made(4), epoch=leader.leadership.epoch)
    leader.bus.commands.extend([Received(encode(old), encoding(Command), "")] * MAX_MESSAGES_PER_LOOK)
    assert [standby.see(k) for k in (5, 6)] == [False, True]
    assert not leader.see(7)
    leader.leadership.listen(7 * DT_NS + 10_000_000)
    assert leader.leadership.role == "standby"


def test_standby_fits_a_leader_of_the_same_configuration_whose_model_has_the_same_equations() -> None:
    ours = model_hash(pioneer_3dx())
    longer = model_hash(pioneer_3dx().with_parameters(a=0.3))
    assert ours == model_hash(pioneer_3dx()) != longer
    assert Others(0).misfit(1, ours) == ""
    for leader, said in (
        (Leader(9, 1, 1, None, ours), ""),
        (Leader(9, 1, 1), ""),  # of a version that does not tell
        (Leader(9, 1, 2, None, ours), "a standby needs the leader's configuration: its hash is 0000000000000002, this standby's 0000000000000001"),
        (Leader(9, 1, 1, None, longer), f"a standby needs the leader's model: the hash of its equations is {longer}, this standby's {ours}"),
    ):
        assert Others(9, leader).misfit(1, ours) == said


def described(one: One, epoch: int, model_hash: str, seq: int = 1) -> Received:
    """Description of a leader, and its receipt."""
    document = {"role": "controller", "epoch": epoch, "seq": seq, "config_hash": HASH, "model_hash": model_hash}
    received = Received(json.dumps(document).encode(), "", "")
    one.bus.infos.append(received)
    return received


def test_standby_hears_that_its_leader_has_come_back_with_another_model_and_does_not_take_over(pair: tuple[One, One]) -> None:
    leader, standby = pair
    described(standby, epoch := leader.leadership.epoch, "00000000000000bb")
    assert standby.leadership.leader() == Leader(epoch, 1, HASH, None, "00000000000000bb")
    assert [standby.see(k) for k in range(5, 12)] == [False] * 7
    assert [notice.code for notice in standby.puppet.said] == ["misfit"]
    described(standby, epoch, MODEL, seq=2)
    standby.leadership.leader()
    assert [standby.see(k) for k in range(12, 15)] == [True] * 3


def test_controller_that_leads_keeps_the_description_of_the_one_that_relieves_it(pair: tuple[One, One]) -> None:
    leader, _ = pair
    described(leader, epoch := leader.leadership.epoch + 256, "00000000000000bb")
    assert leader.leadership.leader() is None
    leader.wire.put(WireBus(leader.wire), encode(replace(leader.made(4), epoch=epoch)))
    assert not leader.see(5)
    assert leader.leadership.leader() == Leader(epoch, 1, HASH, None, "00000000000000bb")
    assert [leader.see(k) for k in range(6, 12)] == [False] * 6
