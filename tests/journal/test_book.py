# SPDX-License-Identifier: Apache-2.0
"""Journal of one controller: bounded, with what was dropped counted, and snapshots when they are due."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import Journal, JournalKind, Notice, Severity
from rti_mpc.control.controller import Controller
from rti_mpc.errors import JournalError
from rti_mpc.journal.book import PERIOD_NS, Book
from rti_mpc.journal.replay import replay
from rti_mpc.journal.snapshot import Camera, Snapshot
from rti_mpc.reference.trajectory import circle
from tests.control.test_call import made
from tests.journal.test_replay import KINDS, live, replayed
from tests.loop import drive, reference, robot


def test_numbers_of_messages_have_no_gap() -> None:
    messages = live(KINDS["riccati"], samples=20, snapshots=(0, 5)).messages
    seq = messages[0].seq
    for message, entries in zip(messages, map(count, messages), strict=True):
        assert message.seq == seq
        seq += entries


def count(message: Journal) -> int:
    from rti_mpc.journal.entry import decode_entries

    return 1 if message.kind is JournalKind.SNAPSHOT else len(list(decode_entries(message.data, message.seq)))


def test_what_finds_no_room_is_dropped_and_counted_and_a_snapshot_follows() -> None:
    controller = made()
    book = Book(controller, capacity=10)
    book.photograph(0)
    messages = list(book.messages(0))
    assert not book.due(1)
    for k in range(25):
        controller.tick(k)
    assert book.dropped == 15
    assert not book.due(1), "there is no room yet"
    messages += book.messages(1)
    assert book.due(1)
    book.photograph(1)
    controller.tick(25)
    assert not book.due(1)
    messages += book.messages(1)
    assert [message.kind.name for message in messages] == ["CALLS", "SNAPSHOT", "CALLS", "CALLS", "SNAPSHOT", "CALLS"]
    assert messages[-1].dropped == 15
    on = replayed(KINDS["riccati"], [])[1]
    list(replay(on, messages))
    (gap,) = on.outcome.gaps
    assert (gap.first, gap.last) == (13, 28)


def test_snapshots_that_nobody_takes_do_not_pile_up() -> None:
    controller = made()
    book = Book(controller, capacity=10)
    for k in range(30):
        controller.tick(k)
        book.photograph(k * PERIOD_NS)
    assert not book.due(30 * PERIOD_NS), "there is no room"
    assert 0 < sum(message.kind is JournalKind.SNAPSHOT for message in book.messages(0)) <= 5
    assert book.due(30 * PERIOD_NS)


def test_a_journal_that_has_ended_takes_nothing_more() -> None:
    controller = made()
    book = Book(controller)
    controller.tick(0)
    book.end()
    controller.tick(1)
    book.photograph(1)
    assert not book.due(10 * PERIOD_NS)
    assert list(book.messages(1)) == []
    assert book.dropped == 1


def test_snapshot_is_due_at_the_start_each_period_and_when_asked_for() -> None:
    book = Book(made())
    assert book.due(5)
    book.photograph(5)
    assert not book.due(5 + PERIOD_NS - 1)
    assert book.due(5 + PERIOD_NS)
    book.ask()
    assert book.due(6)
    book.photograph(6)
    assert not book.due(7)


def test_missing_messages_are_a_gap_and_the_replay_goes_on_with_the_next_snapshot() -> None:
    lived = live(KINDS["riccati"], samples=60, snapshots=(0, 35))
    lost = lived.messages[10]
    outcome, _ = replayed(KINDS["riccati"], [message for message in lived.messages if message is not lost])
    assert not outcome.differences
    (gap,) = outcome.gaps
    assert gap.first == lost.seq
    assert gap.last + 1 in [message.seq for message in lived.messages if message.kind is JournalKind.SNAPSHOT]


def test_commands_before_the_first_snapshot_are_a_gap_but_not_those_that_were_left_out_on_purpose() -> None:
    messages = live(KINDS["riccati"], samples=60, snapshots=(0, 35)).messages
    starts = [message.seq for message in messages if message.kind is JournalKind.SNAPSHOT]
    late, _ = replayed(KINDS["riccati"], messages[5:])
    (gap,) = late.gaps
    assert gap.last + 1 == min(start for start in starts if start >= messages[5].seq)
    assert gap.why == "commands before the first snapshot"
    chosen, _ = replayed(KINDS["riccati"], messages, starts[-2])
    assert not chosen.gaps


def test_attribute_that_is_added_is_part_of_the_snapshot_without_being_named() -> None:
    def grown() -> Any:
        controller: Any = made()
        controller.grid.added = [1, {"b": np.zeros(3)}]
        return controller

    one, other = grown(), grown()
    camera, camera_of_other = Camera(one), Camera(other)
    one.grid.added[1]["b"] = np.array([4.0, 5.0, 6.0])
    one.grid.added.append("late")
    camera_of_other.restore(Snapshot.decode(camera.take().encode()))
    np.testing.assert_array_equal(other.grid.added[1]["b"], [4.0, 5.0, 6.0])
    assert other.grid.added[2] == "late"


@pytest.mark.parametrize("between", [[], [[]]], ids=["in a row", "apart"])
def test_object_that_is_reached_twice_is_restored_as_one(between: list[Any]) -> None:
    one: Any = made()
    other: Any = made()
    one.grid.added = other.grid.added = None
    camera, camera_of_other = Camera(one), Camera(other)
    shared = Notice(Severity.INFO, "code", "text")
    one.grid.added = [shared, *between, shared]
    camera_of_other.restore(Snapshot.decode(camera.take().encode()))
    first, *_, last = other.grid.added
    assert first == shared
    assert first is last


@pytest.mark.parametrize("value", [(n for n in "abc"), open, object()], ids=["generator", "function", "object"])
def test_attribute_that_cannot_be_copied_is_refused_by_name(value: Any) -> None:
    controller: Any = made()
    camera, book = Camera(controller), Book(controller)
    controller.grid.pieces = value
    with pytest.raises(JournalError, match=r"controller\.grid\.pieces must be of a kind that a snapshot can copy"):
        camera.take()
    book.photograph(0)
    assert "controller.grid.pieces" in book.failure, "and the controller goes on"


def test_memory_that_compiled_code_is_bound_to_never_moves() -> None:
    """A snapshot copies such arrays in place: the controller must not replace one."""
    controller: Controller = made()
    before = Camera(controller)
    body = robot(circle())
    controller.receive_reference(reference(circle()))
    drive(controller, body, 3.0)
    after = Camera(controller)
    assert set(before._pins) <= set(after._pins)


def test_snapshot_of_another_controller_is_refused() -> None:
    snapshot = Camera(KINDS["riccati"].build()[0]).take()
    with pytest.raises(JournalError, match="built like this one"):
        Camera(KINDS["sequential"].build()[0]).restore(snapshot)
    with pytest.raises(JournalError, match="encoding"):
        Snapshot.decode(b"\x02")
    with pytest.raises(JournalError, match="zlib"):
        Snapshot.decode(b"\x01nothing")
