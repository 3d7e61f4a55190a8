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
from tests.loop import reference
from tests.problems import pioneer


class Published(list[Reference]):
    """Published messages, the newest last."""

    def put(self, message: Reference) -> None:
        self.append(message)


class Followed(SimpleNamespace):
    """A controller that gives a stamp to each reference, and records which one it follows."""

    np_ = 7
    newest: Reference | None = None

    def lay_out(self, reference: Reference) -> None:
        return None

    def receive_reference(self, reference: Reference, rows: None) -> Reference | None:
        arriving = reference.stamp_ns == STAMP_ON_ARRIVAL
        self.newest = replace(reference, stamp_ns=7) if arriving else reference
        return self.newest if arriving else None


class Rig:
    """References between two doors and a controller, without a bus."""

    def __init__(self) -> None:
        self.published, self.controller = Published(), Followed()
        bus: Any = SimpleNamespace(intake=Intake, keys=SimpleNamespace(anchored="anchored"), publisher=lambda *_, **__: self.published)
        controller: Any = self.controller
        self.references = References(bus, controller, ny=3)

    def planner(self, *messages: Reference) -> None:
        self.references.from_planner(sent(*messages))

    def leader(self, *messages: Reference) -> None:
        self.references.from_leader(sent(*messages))

    def followed(self, *, leading: bool) -> tuple[int, int, int] | None:
        """Epoch, seq and stamp of what the controller follows after a sample."""
        self.references.hand_over(leading)
        newest = self.controller.newest
        return None if newest is None else (newest.epoch, newest.seq, newest.stamp_ns)


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


def test_controlling_thread_does_nothing_for_each_row_of_a_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    controller = Controller(Rti(pioneer(N=5), compile=False), Timing(), compile=False)
    bus: Any = SimpleNamespace(intake=Intake, keys=SimpleNamespace(anchored="anchored"), publisher=lambda *_, **__: None)
    references = References(bus, controller, ny=3)
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
