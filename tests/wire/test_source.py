# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re

import numpy as np
import pytest

from rti_mpc.wire.source import Source, Verdict

STALE_NS = 100


@pytest.fixture
def source() -> Source:
    """Locked to epoch 5, sequence 10, at time 0."""
    source = Source(STALE_NS)
    assert source.accept(5, 10, 0) is Verdict.NEW
    return source


def test_the_next_message_is_accepted_and_gaps_are_counted(source: Source) -> None:
    assert source.accept(5, 11, 1) is Verdict.NEXT
    assert source.accept(5, 14, 2) is Verdict.NEXT
    assert source.lost == 2


def test_repeated_messages_are_dropped_however_late_and_old_ones_while_the_source_lives(source: Source) -> None:
    assert source.accept(5, 9, STALE_NS) is Verdict.OLD
    assert source.accept(5, 10, 10 * STALE_NS) is Verdict.REPEATED
    assert source.dropped == 2
    assert source.seq == 10


def test_a_message_far_ahead_is_no_loss_of_those_between(source: Source) -> None:
    assert source.accept(5, 10 + 10**6, 1) is Verdict.NEXT
    assert source.accept(5, 11 + 2 * 10**6, 2) is Verdict.AHEAD
    assert source.accept(5, 2**64 - 1, 3) is Verdict.AHEAD
    assert source.lost == 10**6 - 1


@pytest.mark.parametrize("seq", [10 + 10**6, 2**64 - 1])
def test_a_source_of_which_nothing_is_accepted_is_left_though_it_goes_on(seq: int) -> None:
    source = Source(STALE_NS)
    source.accept(5, seq, 0)  # somebody else's, in the name of ours
    heard = [source.accept(5, n, n) for n in range(1, 2 * STALE_NS)]
    assert set(heard[: STALE_NS + 1]) == {Verdict.OLD}
    assert heard[STALE_NS + 1] is Verdict.NEW
    assert set(heard[STALE_NS + 2 :]) == {Verdict.NEXT}


def test_what_is_sent_again_takes_nothing_over_however_long_the_source_is_silent(source: Source) -> None:
    rng = np.random.default_rng(1)
    for now_ns in range(1, 20 * STALE_NS):
        assert source.accept(5, int(rng.integers(10)), now_ns) is Verdict.OLD
    assert source.accept(5, 11, 20 * STALE_NS) is Verdict.NEXT


def test_a_higher_epoch_takes_over_at_once(source: Source) -> None:
    assert source.accept(6, 0, 1) is Verdict.NEW
    assert (source.epoch, source.seq, source.lost) == (6, 0, 0)


def test_a_lower_epoch_takes_over_only_from_a_stale_source(source: Source) -> None:
    assert source.accept(4, 99, STALE_NS) is Verdict.FOREIGN
    assert source.accept(4, 100, STALE_NS + 1) is Verdict.NEW
    assert source.dropped == 1


def test_foreign_messages_do_not_keep_a_source_alive_nor_disturb_it(source: Source) -> None:
    assert source.accept(4, 1, 60) is Verdict.FOREIGN
    assert source.accept(5, 11, 61) is Verdict.NEXT
    assert source.accept(4, 2, 61 + STALE_NS) is Verdict.FOREIGN
    assert source.accept(4, 3, 62 + STALE_NS) is Verdict.NEW


def test_every_verdict_is_a_word_that_an_event_s_code_can_end_with() -> None:
    """Codes have no spaces, as those of the robot."""
    assert [verdict for verdict in Verdict if not re.fullmatch(r"[a-z]+(_[a-z]+)*", verdict.value)] == []
