# SPDX-License-Identifier: Apache-2.0
"""Latches of a stop: precedence between two, and decoding."""

from __future__ import annotations

import itertools
from functools import reduce
from typing import Any

import pytest

from rti_mpc.contract.latch import MAX_COUNTER, MAX_COUNTER_LEAP, MAX_REASON_CHARS, Latch, merge, read_latch
from rti_mpc.errors import MessageError

WHEN = "2026-11-28T09:30:00Z"
STOPPED = Latch(5, True, WHEN, "asked for by ada@lab")
CONTENT = {"counter": 5, "stopped": True, "when": WHEN, "reason": "asked for by ada@lab"}


def test_higher_counter_holds_and_of_equal_ones_that_which_stops() -> None:
    released = Latch(6, False, WHEN, "asked for by bob@lab")
    assert merge(STOPPED, released) == merge(released, STOPPED) == released
    tie = Latch(5, False, WHEN, "asked for by bob@lab")
    assert merge(STOPPED, tie) == merge(tie, STOPPED) == STOPPED
    assert merge(Latch(), STOPPED) == STOPPED


def test_all_agree_in_whatever_order_they_hear_of_each_other() -> None:
    latches = [Latch(counter, stopped, WHEN, reason) for counter in (0, 1, 2) for stopped in (False, True) for reason in ("a", "b")]
    for some in itertools.combinations(latches, 4):
        assert len({reduce(merge, order, Latch()) for order in itertools.permutations(some)}) == 1


def test_change_exceeds_what_is_known_and_a_word_that_holds_already_changes_nothing() -> None:
    assert STOPPED.change(stopped=True, reason="asked for by bob@lab", when=WHEN) is STOPPED, "it stands since the first one"
    released = STOPPED.change(stopped=False, reason="asked for by bob@lab", when=WHEN)
    assert released == Latch(6, False, WHEN, "asked for by bob@lab")
    assert merge(STOPPED, released) is released


def test_counter_that_leaps_is_not_believed() -> None:
    assert merge(STOPPED, Latch(5 + MAX_COUNTER_LEAP, False)).counter == 5 + MAX_COUNTER_LEAP
    assert merge(STOPPED, Latch(6 + MAX_COUNTER_LEAP, False)) == STOPPED


def test_forged_counters_never_reach_the_last_one_that_is_read() -> None:
    years = MAX_COUNTER / MAX_COUNTER_LEAP / (1000 * 86_400 * 365.0)  # at a thousand messages per second, each the greatest leap
    assert years > 100.0


def test_latch_is_read_as_it_was_written() -> None:
    assert read_latch(CONTENT) == STOPPED
    assert read_latch(CONTENT | {"from": "a later release"}) == STOPPED
    assert str(STOPPED) == f"stopped since {WHEN}: asked for by ada@lab"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("counter", -1),
        ("counter", True),
        ("counter", 5.0),
        ("counter", "5"),
        ("counter", None),
        ("counter", MAX_COUNTER + 1),
        ("stopped", 1),
        ("stopped", "yes"),
        ("when", 0),
        ("when", "yesterday"),
        ("when", f"{WHEN}\n"),
        ("reason", None),
        ("reason", "a\x1b[2Jb"),
        ("reason", "a" * (MAX_REASON_CHARS + 1)),
    ],
)
def test_what_is_no_latch_is_refused_in_a_line_that_names_the_field(field: str, value: Any) -> None:
    with pytest.raises(MessageError, match=rf"^latch\.{field} must be [^\n]*$") as refusal:
        read_latch(CONTENT | {field: value})
    assert len(str(refusal.value)) < 200


@pytest.mark.parametrize("content", [None, [], "stopped", 5])
def test_what_is_no_object_is_no_latch(content: Any) -> None:
    with pytest.raises(MessageError, match="latch must be an object"):
        read_latch(content)
