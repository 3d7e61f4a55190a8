# SPDX-License-Identifier: Apache-2.0
"""Leader election, state by state: without processes, bus or clock."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from rti_mpc.contract.epoch import NUMBER_BITS, epoch_above
from rti_mpc.contract.leadership import Leadership
from rti_mpc.contract.message import Command, Notice, State
from rti_mpc.contract.status import Mode, QpStatus

DT_S = 0.1
DT_NS = 100_000_000
HASH = 7
EPOCH = 1 << 50  # of the robot's first leader, about

Wire = list["One"]  # who hears each other


class One:
    """One controller of several that hear each other."""

    def __init__(
        self, wire: Wire, *, standby: bool, number: int | None = None, dt_s: float = DT_S, config_hash: int = HASH, model_hash: str = ""
    ) -> None:
        self.inbox: deque[Command] = deque()
        self.heard: list[Command] = []
        self.notices: list[Notice] = []
        self.ready = True
        number = 100 + len(wire) if number is None else number
        self.leadership = Leadership(
            number, EPOCH, config_hash=config_hash, model_hash=model_hash, dt_s=dt_s, standby=standby, say=self.notices.append
        )
        self.wire = wire
        wire.append(self)
        self._seq = 0
        self._dt_ns = round(1e9 * dt_s)
        self._meet()

    def _meet(self) -> None:
        """Let all who stand by know of each other, and the leader of them."""
        for one in self.wire:
            for other in self.wire:
                one.leadership.meet(other.leadership.number, present=not other.leadership.leading)

    def put(self, command: Command) -> None:
        """Let the others hear a command."""
        for one in self.wire:
            if one is not self:
                one.inbox.append(command)

    def take_in(self, *, late: bool = False) -> None:
        while self.inbox:
            command = self.inbox.popleft()
            if self.leadership.follow(command, late=late):
                self.heard.append(command)

    def listen(self, local_ns: int) -> None:
        self.leadership.note_time(local_ns, 1.0)
        self.take_in()

    def hear(self, state: State, local_ns: int) -> None:
        self.listen(local_ns)
        self.leadership.receive_state(state, local_ns, late_ns=local_ns - state.stamp_ns, ready=self.ready)

    def see(self, k: float, late_ns: int = 0) -> bool:
        """Be shown the state of a sample; return whether it was answered."""
        stamp_ns = round(k * self._dt_ns)
        self.hear(State(1, round(10 * k), stamp_ns, np.zeros(1)), stamp_ns + late_ns)
        command = self.made(k)
        if self.leadership.replaced is not None:
            self.take_in(late=True)
        sends = self.leadership.sends(command)
        if sends:
            self.put(command)
        self._meet()
        return sends

    def made(self, k: float) -> Command:
        """A command that answers the state of a sample."""
        self._seq += 1
        stamp_ns = round(k * self._dt_ns)
        head = (self.leadership.acting or 0, self._seq, stamp_ns, 1, round(10 * k), stamp_ns, stamp_ns + self._dt_ns, HASH)
        return Command(*head, Mode.TRACKING, QpStatus.SOLVED, self._dt_ns, np.zeros((1, 1)))


@pytest.fixture
def pair() -> tuple[One, One]:
    """A leader and one that stands by, who have seen some states."""
    wire: Wire = []
    pair = One(wire, standby=False), One(wire, standby=True)
    for k in range(1, 5):
        assert [one.see(k) for one in pair] == [True, False]
    return pair


def codes(one: One) -> list[str]:
    return [notice.code for notice in one.notices]


def test_standby_hears_the_leader_and_leads_from_the_second_state_without_an_answer(pair: tuple[One, One]) -> None:
    leader, standby = pair
    assert standby.leadership.acting is None
    assert [standby.see(k) for k in (5, 6, 7)] == [False, True, True]
    assert [command.state_stamp_ns for command in standby.heard] == [k * DT_NS for k in range(1, 5)]
    assert standby.leadership.epoch > leader.leadership.epoch
    assert codes(standby) == ["took_over"]
    assert standby.leadership.acting is not None


def test_states_between_samples_are_no_silence(pair: tuple[One, One]) -> None:
    """A robot that sends states five times per period: the leader answers each fifth, and has one period to do so."""
    _, standby = pair
    assert [standby.see(4 + k / 5) for k in range(1, 9)] == [False] * 7 + [True]


def test_one_that_takes_over_between_samples_answers_the_next_one(pair: tuple[One, One]) -> None:
    """With ten states per period, and a further standby: the silence that this takeover ended does not count against the new leader."""
    _, standby = pair
    One(standby.wire, standby=True, number=standby.leadership.number + 1)
    for i in range(41, 60):
        standby.hear(State(1, i, i * DT_NS // 10, np.zeros(1)), i * DT_NS // 10)
    assert standby.leadership.leading
    assert standby.see(6)


def test_leader_that_has_slept_says_nothing_until_it_has_listened(pair: tuple[One, One]) -> None:
    leader, standby = pair
    assert [standby.see(k) for k in (5, 6, 7)] == [False, True, True]
    leader.inbox.clear()  # not here yet
    assert not leader.see(8)
    standby.see(8)
    assert not leader.see(9)
    assert not leader.leadership.leading
    assert codes(leader) == ["stepped_down"]
    assert str(standby.leadership.epoch) in leader.notices[0].text


def test_leader_that_nobody_has_replaced_goes_on_after_listening(pair: tuple[One, One]) -> None:
    """No state reached either controller for a while: the former leader continues."""
    leader, standby = pair
    epoch = leader.leadership.epoch
    assert [(leader.see(k), standby.see(k)) for k in (8, 9, 10)] == [(False, False), (True, False), (True, False)]
    assert leader.leadership.epoch == leader.leadership.acting == epoch
    assert codes(leader) == codes(standby) == []


def test_late_look_at_the_clock_counts_as_sleep(pair: tuple[One, One]) -> None:
    """A process that was stopped may be shown a state of before: it is fresh by its stamp only."""
    leader, _ = pair
    assert not leader.see(5, late_ns=10 * DT_NS)
    assert not leader.see(6, late_ns=9 * DT_NS + 10_000_000), "a queue of old states is no time to listen"
    assert leader.see(7, late_ns=8 * DT_NS + 50_000_000)


def test_state_shown_a_period_late_is_not_answered() -> None:
    """The next state has been sent, and a standby may have answered it."""
    for late_ns, answered in ((DT_NS - 1, True), (DT_NS, False)):
        leader, standby = One(wire := [], standby=False), One(wire, standby=True)
        assert leader.see(1)
        for local_ns in range(DT_NS, 2 * DT_NS + late_ns, 10_000_000):
            leader.listen(local_ns)  # awake all the time
        assert leader.see(2, late_ns) == answered
        assert not standby.leadership.leading


@pytest.mark.parametrize("dead", [False, True])
@pytest.mark.parametrize("shown", [{5: 30, 6: 11, 7: 0}, {7: 12}], ids=["late", "lost"])  # states, and by how many ms they come late
def test_host_that_holds_both_up_changes_no_leader(shown: dict[int, int], dead: bool) -> None:
    """At 50 Hz, for 50 ms: the leader listens before it goes on, and whoever stands by waits for that, but for a dead one no longer."""
    wire: Wire = []
    leader, standby = One(wire, standby=False, dt_s=0.02), One(wire, standby=True, dt_s=0.02)
    for k in range(1, 5):
        assert [one.see(k) for one in (leader, standby)] == [True, False]
    answers = []
    for k, late_ms in (shown | dict.fromkeys(range(8, 12), 0)).items():
        answers += [(k, one) for one in ([standby] if dead else [standby, leader]) if one.see(k, late_ns=1_000_000 * late_ms)]
    assert {one for _, one in answers} == {standby if dead else leader}
    assert answers[-1][0] == 11
    assert codes(standby) == (["took_over"] if dead else [])


def test_leader_that_answers_while_it_is_being_replaced_stays_the_leader(pair: tuple[One, One]) -> None:
    leader, standby = pair
    hear = standby.hear

    def hear_and_compute(state: State, local_ns: int) -> None:
        hear(state, local_ns)
        if state.stamp_ns == 6 * DT_NS:
            leader.put(leader.made(5))  # comes at last

    standby.hear = hear_and_compute  # type: ignore[method-assign]
    assert [standby.see(k) for k in (5, 6, 7, 8)] == [False, False, False, True]
    assert codes(standby) == ["took_over"]


def test_leader_that_missed_states_says_nothing_until_it_has_listened(pair: tuple[One, One]) -> None:
    """It was awake, and is shown the next state in time: those before were lost on the way, to it alone perhaps."""
    leader, _ = pair
    for local_ns in range(4 * DT_NS, 7 * DT_NS, 10_000_000):
        leader.listen(local_ns)
    assert not leader.see(7)
    assert leader.see(8)


def test_leader_that_has_just_woken_sends_no_ramp_of_its_own(pair: tuple[One, One]) -> None:
    leader, _ = pair
    leader.listen(30 * DT_NS)
    assert not leader.leadership.sends(leader.made(4))


def test_standby_that_has_slept_itself_listens_first(pair: tuple[One, One]) -> None:
    leader, standby = pair
    for k in range(5, 20):
        assert leader.see(k)
    standby.inbox.clear()
    assert not standby.see(20)
    leader.see(20)
    assert not standby.see(21)


def test_leader_alone_answers_whatever_it_missed() -> None:
    leader = One([], standby=False)
    assert [leader.see(k) for k in (1, 2, 9, 10)] == [True] * 4


def test_of_two_that_stand_by_the_lower_number_leads_and_the_other_a_period_later_if_it_must() -> None:
    for dead in (False, True):
        wire: Wire = []
        leader, high, low = One(wire, standby=False), One(wire, standby=True, number=9), One(wire, standby=True, number=5)
        for k in range(1, 5):
            assert [one.see(k) for one in (leader, high, low)] == [True, False, False]
        answers = [(high.see(k), not dead and low.see(k)) for k in range(5, 9)]
        assert answers == ([(False, False), (False, False), (True, False), (True, False)] if dead else [(False, False)] + [(False, True)] * 3)


def test_higher_epoch_ends_a_leadership_at_once(pair: tuple[One, One]) -> None:
    leader, standby = pair
    standby.leadership._take_over(0)
    assert standby.see(5)
    assert not leader.see(5)
    assert [leader.see(k) for k in (6, 7)] == [False, True], "and begins another when that falls silent"
    assert leader.leadership.epoch > standby.leadership.epoch


def test_robot_that_restarts_or_sets_its_clock_back_is_not_a_silent_leader(pair: tuple[One, One]) -> None:
    _, standby = pair
    for epoch, stamp_ns in ((2, 90 * DT_NS), (2, 91 * DT_NS), (2, 3 * DT_NS), (2, 4 * DT_NS)):
        standby.hear(State(epoch, 1, stamp_ns, np.zeros(1)), stamp_ns)
        assert not standby.leadership.leading
    standby.hear(State(2, 1, 5 * DT_NS, np.zeros(1)), 5 * DT_NS)
    assert standby.leadership.leading, "silence is counted from there"


def test_controller_with_nothing_to_command_takes_over_nothing(pair: tuple[One, One]) -> None:
    _, standby = pair
    standby.ready = False
    assert [standby.see(k) for k in range(5, 12)] == [False] * 7
    standby.ready = True
    assert [standby.see(k) for k in (12, 13)] == [False, True]


def test_one_that_stands_by_takes_over_from_no_leader_of_another_configuration_and_says_so_once() -> None:
    wire: Wire = []
    leader, standby = One(wire, standby=False), One(wire, standby=True, config_hash=8)
    for k in range(1, 6):
        leader.see(k)
        standby.see(k)
    assert f"{HASH:016x}" in standby.leadership.misfit
    assert [standby.see(k) for k in range(6, 10)] == [False] * 4
    assert codes(standby) == ["misfit"]


def test_one_that_stands_by_takes_over_from_no_leader_that_has_come_back_with_another_model_until_it_has_its_own_again() -> None:
    wire: Wire = []
    leader, standby = One(wire, standby=False), One(wire, standby=True, model_hash="ours")
    standby.leadership.fit_model(leader.leadership.epoch, "ours")
    lives = {}
    for life, model_hash in enumerate(("ours", "theirs", "ours", "")):  # the last one of a version that does not tell
        leader.leadership.epoch = standby.leadership.known + 256
        standby.leadership.fit_model(leader.leadership.epoch, model_hash)
        for k in range(20 * life + 1, 20 * life + 6):
            leader.see(k)
            standby.see(k)
        lives[life] = standby.leadership.misfit
    assert [bool(misfit) for misfit in lives.values()] == [False, True, False, False]
    assert lives[1] == "a standby needs the leader's model: the hash of its equations is theirs, this standby's ours"
    assert codes(standby) == ["misfit"]
    leader.leadership.epoch += 256
    standby.leadership.fit_model(leader.leadership.epoch, "theirs")
    for k in range(81, 86):
        leader.see(k)
        standby.see(k)
    assert [standby.see(k) for k in range(86, 92)] == [False] * 6, "though a controller with its model has led before"
    assert codes(standby) == ["misfit", "misfit"]
    standby.inbox.append(replace(leader.made(92), epoch=leader.leadership.epoch + 256))  # another leads, whose model is not known yet
    assert [standby.see(k) for k in range(92, 96)] == [False, False, True, True]


def test_a_command_of_another_configuration_ends_neither_leader_nor_standby(pair: tuple[One, One]) -> None:
    """Those that have led this robot, or stood by for one that did, go on when it is silent."""
    leader, standby = pair
    forged = replace(leader.made(4), epoch=leader.leadership.epoch + 1, config_hash=666)
    leader.inbox.append(forged)
    standby.inbox.append(forged)
    answered = [[one.see(k) for one in pair] for k in range(5, 12)]
    assert answered[0] == [False, False]
    assert sum(map(any, answered)) >= 5
    assert all(sum(both) <= 1 for both in answered)
    assert f"{666:016x}" in next(notice.text for notice in leader.notices if notice.code == "stepped_down")
    assert "misfit" not in codes(leader) + codes(standby)


def test_replayed_commands_make_no_leader_step_down_and_no_standby_believe_in_them(pair: tuple[One, One]) -> None:
    leader, standby = pair
    sent = [replace(leader.made(k), epoch=leader.leadership.epoch, seq=k) for k in (1, 2, 3, 4)]
    leader._seq = 4
    for k in range(5, 12):
        for command in sent:
            for one in pair:
                one.inbox.append(command)
        assert [one.see(k) for one in pair] == [True, False]
    assert codes(leader) == codes(standby) == []
    assert [command.state_stamp_ns for command in standby.heard] == [k * DT_NS for k in range(1, 12)]


def test_never_two_answer_a_state_and_nearly_every_state_is_answered_though_controllers_sleep() -> None:
    """Three that hear each other; each falls asleep now and then, for up to 20 states."""
    rng = np.random.default_rng(2)
    answered = []
    for _ in range(20):
        wire: Wire = []
        ones = [One(wire, standby=k > 0) for k in range(3)]
        asleep = np.zeros(3, dtype=int)
        for k in range(1, 200):
            falling = (rng.random(3) < 0.02) & (asleep == 0)
            asleep = np.where(falling, rng.integers(1, 20, 3), np.maximum(asleep - 1, 0))
            answered.append(sum(one.see(k) for one, rest in zip(ones, asleep, strict=True) if rest == 0))
    assert max(answered) == 1
    assert np.mean(answered) > 0.9


def test_epochs_of_two_numbers_never_meet() -> None:
    rng = np.random.default_rng(1)
    for heard, other, number in rng.integers(0, [2**52, 2**52, 2**NUMBER_BITS], size=(500, 3)).tolist():
        epoch = epoch_above(heard, number)
        assert heard < epoch <= heard + 2**NUMBER_BITS
        assert epoch % 2**NUMBER_BITS == number
        assert epoch != epoch_above(other, (number + 1) % 2**NUMBER_BITS)
