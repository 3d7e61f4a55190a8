# SPDX-License-Identifier: Apache-2.0
"""References on their way to a controller, through two threads."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import STAMP_ON_ARRIVAL, End, Reference, State
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.track import Track
from rti_mpc.reference.trajectory import circle
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.bus import Received
from rti_mpc.wire.cdr import encode, encoding
from rti_mpc.wire.intake import Intake
from rti_mpc_service.controller.references import References
from tests.loop import MS, reference
from tests.problems import pioneer


class Published(list[Reference]):
    """Published messages, the newest last."""

    cached: Reference | None = None  # what a late joiner gets

    def put(self, message: Reference) -> None:
        self.append(message)
        self.cached = message

    def withdraw(self, _: object) -> None:
        self.cached = None


def bus_of(published: Published) -> Any:
    return SimpleNamespace(
        intake=Intake, keys=SimpleNamespace(anchored="anchored"), publisher=lambda *_, **__: published, withdraw=published.withdraw
    )


class Followed(SimpleNamespace):
    """A controller that gives a stamp to each reference, and records which one it follows."""

    np_ = 7
    followed: Reference | None = None

    def lay_out(self, reference: Reference) -> None:
        return None

    def receive_reference(self, reference: Reference, rows: None) -> Reference | None:
        arriving = reference.stamp_ns == STAMP_ON_ARRIVAL
        self.followed = replace(reference, stamp_ns=7) if arriving else reference
        return self.followed if arriving else None


class Rig:
    """References between two doors and a controller, without a bus."""

    def __init__(self) -> None:
        self.published, self.controller = Published(), Followed()
        controller: Any = self.controller
        self.references = References(bus_of(self.published), controller, ny=3)

    def planner(self, *messages: Reference) -> None:
        self.references.from_planner(sent(*messages))

    def leader(self, *messages: Reference) -> None:
        self.references.from_leader(sent(*messages))

    def followed(self, *, leading: bool) -> tuple[int, int, int] | None:
        """Epoch, seq and stamp of what the controller follows after a sample."""
        self.references.hand_over(leading)
        followed = self.controller.followed
        return None if followed is None else (followed.epoch, followed.seq, followed.stamp_ns)


class Pair:
    """A leader, a standby and a planner in lockstep, without a bus."""

    def __init__(self, rtis: list[Rti]) -> None:
        self.published = Published()
        self.controllers = [Controller(rti, Timing(), compile=False) for rti in rtis]
        self.controllers[1].stand_by()
        self.references = []
        for controller in self.controllers:
            self.references.append(References(bus_of(self.published), controller, ny=3))
        self.delivered = 0
        self.leader: int | None = 0

    def plan(self, *messages: Reference) -> None:
        for references in self.references:
            references.from_planner(sent(*messages))

    def hear(self, state: State, local_ns: int) -> None:
        """Let both answer a state; what the leader publishes comes after the sample."""
        for i, (controller, references) in enumerate(zip(self.controllers, self.references, strict=True)):
            if (command := controller.receive_state(state, local_ns)) is not None:
                controller.commit(command)
                controller.prepare()
            references.hand_over(i == self.leader)
        for references in self.references:
            references.from_leader(sent(*self.published[self.delivered :]))
        self.delivered = len(self.published)

    def drive(self, epoch: int, stamps_ms: range, local_ms: int, *, magnitude: float = 0.0) -> None:
        """Let the robot send states of one life, the first at a local time."""
        for stamp_ms in stamps_ms:
            local_ns = (local_ms + stamp_ms - stamps_ms.start) * MS
            self.hear(State(epoch, 1 + stamp_ms // stamps_ms.step, stamp_ms * MS, np.full(5, magnitude)), local_ns)

    @property
    def stamps_ms(self) -> list[float | None]:
        """Since when leader and standby follow their reference, and the last stamp on the bus."""
        followed = [controller.followed for controller in self.controllers]
        return [None if message is None else message.stamp_ns / MS for message in (*followed, *self.published[-1:])]


@pytest.fixture(scope="module")
def rtis() -> list[Rti]:
    return [Rti(pioneer(N=5), compile=False) for _ in range(2)]


@pytest.fixture
def pair(rtis: list[Rti]) -> Pair:
    return Pair(rtis)


def sent(*messages: Reference) -> Any:
    """A subscriber that has received these, and is closed after them."""
    waiting = iter([*(Received(encode(message), encoding(Reference), "reference") for message in messages), None])
    return SimpleNamespace(recv=lambda: next(waiting))


def planned(seq: int, stamp_ns: int = STAMP_ON_ARRIVAL, epoch: int = 1) -> Reference:
    return Reference(epoch, seq, stamp_ns, 20_000_000, End.HOLD, np.zeros((2, 3)), np.zeros((2, 0)))


def test_waiting_reference_is_started_on_a_takeover() -> None:
    rig = Rig()
    rig.planner(planned(1))
    assert rig.followed(leading=False) is None, "it waits for its stamp"
    assert rig.followed(leading=True) == (1, 1, 7)
    assert [message.stamp_ns for message in rig.published] == [7]


@pytest.mark.parametrize("stamp_ns", [STAMP_ON_ARRIVAL, 3])
@pytest.mark.parametrize(("epoch", "seq"), [(1, 2), (2, 1)])
def test_waiting_reference_displaces_no_newer_one_on_a_takeover(stamp_ns: int, epoch: int, seq: int) -> None:
    rig = Rig()
    rig.planner(planned(1))
    rig.followed(leading=False)
    rig.planner(planned(seq, stamp_ns, epoch))
    assert rig.followed(leading=True) == (epoch, seq, 7 if stamp_ns == STAMP_ON_ARRIVAL else 3)
    assert rig.followed(leading=True) == (epoch, seq, 7 if stamp_ns == STAMP_ON_ARRIVAL else 3), "nor later"


@pytest.mark.parametrize("leading", [False, True])
def test_stamp_that_the_last_leader_has_given_is_kept(leading: bool) -> None:
    """Also where it comes with the takeover itself; another stamp would start the reference again."""
    for planner_first in (True, False):
        rig = Rig()
        calls = [lambda rig=rig: rig.planner(planned(1)), lambda rig=rig: rig.leader(planned(1, stamp_ns=5))]
        for call in calls if planner_first else reversed(calls):
            call()
        assert rig.followed(leading=leading) == (1, 1, 5)
        assert rig.followed(leading=True) == (1, 1, 5)


def test_reference_that_a_leader_was_faster_with_is_not_started_again() -> None:
    rig = Rig()
    rig.leader(planned(2, stamp_ns=5))
    assert rig.followed(leading=False) == (1, 2, 5)
    rig.planner(planned(2))
    assert rig.followed(leading=False) == (1, 2, 5)
    assert rig.followed(leading=True) == (1, 2, 5)
    assert [(message.seq, message.stamp_ns) for message in rig.published] == [(2, 5)], "the new leader publishes it for those that come late"


def test_leaders_stamp_for_an_older_reference_displaces_no_newer_one() -> None:
    for planner_first in (True, False):
        rig = Rig()
        calls = [lambda rig=rig: rig.planner(planned(2, stamp_ns=9)), lambda rig=rig: rig.leader(planned(1, stamp_ns=5))]
        for call in calls if planner_first else reversed(calls):
            call()
        assert rig.followed(leading=False) == (1, 2, 9)
        rig.leader(planned(1, stamp_ns=6))
        assert rig.followed(leading=True) == (1, 2, 9)


def test_leader_follows_planners_alone() -> None:
    rig = Rig()
    rig.planner(planned(1))
    assert rig.followed(leading=True) == (1, 1, 7)
    rig.leader(planned(2, stamp_ns=5))
    assert rig.followed(leading=True) == (1, 1, 7)
    rig.planner(planned(3, stamp_ns=8))
    assert rig.followed(leading=True) == (1, 3, 8)


def test_controlling_thread_does_nothing_for_each_row_of_a_reference(rtis: list[Rti], monkeypatch: pytest.MonkeyPatch) -> None:
    controller = Controller(rtis[0], Timing(), compile=False)
    references = References(bus_of(Published()), controller, ny=3)
    message = reference(circle())
    waiting = iter([Received(encode(message), encoding(type(message)), "reference"), None])
    subscriber: Any = SimpleNamespace(recv=lambda: next(waiting))
    references.from_planner(subscriber)

    def refuse(*_: Any) -> None:
        raise AssertionError("laid out by the thread that controls")

    monkeypatch.setattr(Track, "lay_out", refuse)
    controller.receive_state(State(1, 1, 0, np.zeros(5)), 0)
    references.hand_over(leading=True)
    assert controller.receive_state(State(1, 2, 100_000_000, np.zeros(5)), 100_000_000) is not None


def test_reference_sent_before_a_restart_is_believed_starts_once_for_leader_and_standby(pair: Pair) -> None:
    pair.plan(planned(1))
    pair.drive(1, range(100_000, 102_000, 100), 100_000)
    assert pair.stamps_ms == [100_000] * 3
    pair.drive(2, range(100, 200, 100), 103_000)
    pair.plan(planned(2))
    pair.drive(2, range(200, 400, 100), 103_100)
    assert [message.seq for message in pair.published] == [1], "no stamp before it is certain on whose clock"
    pair.drive(2, range(400, 1000, 100), 103_300)
    assert pair.stamps_ms == [pair.stamps_ms[0]] * 3
    assert 200 <= (pair.stamps_ms[0] or 0) <= 500
    pair.leader = 1
    pair.drive(2, range(1000, 1500, 100), 103_900)
    assert pair.stamps_ms == [pair.stamps_ms[0]] * 3
    assert [message.seq for message in pair.published] == [1, 2, 2], "the new leader publishes it for those that come late"


def test_standby_that_takes_over_before_a_restart_is_believed_starts_the_reference_itself(pair: Pair) -> None:
    pair.plan(planned(1))
    pair.drive(1, range(100_000, 102_000, 100), 100_000)
    pair.drive(2, range(100, 200, 100), 103_000)
    pair.plan(planned(2))
    pair.drive(2, range(200, 300, 100), 103_100)
    pair.leader = 1
    pair.drive(2, range(300, 1000, 100), 103_200)
    assert pair.stamps_ms[1] == pair.stamps_ms[2]
    assert (pair.published[-1].seq, pair.published[-1].stamp_ns < 1000 * MS) == (2, True)


def test_reference_sent_to_a_life_that_ended_before_it_was_believed_is_not_followed_by_the_next(pair: Pair) -> None:
    pair.drive(1, range(100_000, 101_000, 100), 100_000)
    pair.drive(2, range(100, 200, 100), 103_000)
    pair.plan(planned(1))
    pair.drive(2, range(200, 300, 100), 103_100)
    pair.drive(3, range(100, 1000, 100), 110_000)
    assert pair.stamps_ms == [None, None]


def test_reference_of_the_last_life_is_withdrawn_from_those_that_come_late(pair: Pair) -> None:
    """Its stamp is of another clock: a standby that starts after the restart would follow it for as long as that clock was ahead."""
    pair.plan(planned(1))
    pair.drive(1, range(100_000, 102_000, 100), 100_000)
    assert pair.published.cached is not None
    pair.drive(2, range(100, 1000, 100), 103_000)
    assert pair.stamps_ms[:2] == [None, None]
    assert pair.published.cached is None
    pair.plan(planned(2))
    pair.drive(2, range(1000, 1200, 100), 103_900)
    assert pair.published.cached is not None
    assert pair.published.cached.seq == 2


def test_reference_that_came_with_a_refused_state_starts_once_for_leader_and_standby(pair: Pair) -> None:
    pair.plan(planned(1))
    pair.drive(1, range(100_000, 100_100, 100), 100_000, magnitude=1e10)
    assert pair.stamps_ms == [None, None]
    pair.drive(1, range(100_100, 101_000, 100), 100_100)
    assert pair.stamps_ms == [100_100] * 3
    pair.leader = 1
    pair.drive(1, range(101_000, 102_000, 100), 101_000)
    assert pair.stamps_ms == [100_100] * 3


def test_reference_sent_while_two_robots_use_the_name_starts_when_one_is_left(pair: Pair) -> None:
    pair.plan(planned(1))
    pair.drive(1, range(100_000, 102_000, 100), 100_000)
    pair.hear(State(9, 1, 5 * MS, np.zeros(5)), 101_950 * MS)
    pair.plan(planned(2))
    pair.drive(1, range(102_000, 102_200, 100), 102_000)
    assert [message.seq for message in pair.published] == [1]
    pair.drive(1, range(102_200, 105_000, 100), 102_200)
    assert [message.seq for message in pair.published] == [1, 2]
    assert pair.stamps_ms == [pair.stamps_ms[0]] * 3
    assert (pair.stamps_ms[0] or 0) > 102_200


def test_reference_that_its_planner_has_stamped_is_not_published_again_before_a_takeover(pair: Pair) -> None:
    pair.plan(planned(1, stamp_ns=100_000 * MS))
    pair.drive(1, range(100_000, 101_000, 100), 100_000)
    assert pair.stamps_ms == [100_000] * 2
    pair.leader = 1
    pair.drive(1, range(101_000, 102_000, 100), 101_000)
    assert pair.stamps_ms == [100_000] * 3
