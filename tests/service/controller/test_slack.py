# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from itertools import count

import pytest

from rti_mpc.contract.message import Notice, Severity
from rti_mpc_service.controller.slack import JUDGED_SAMPLES, PAUSED_SAMPLES, Slack

MS = 1_000_000


class Clock:
    """A clock that each piece of work advances."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        return self.now_ns


def samples(slack: Slack, clock: Clock, took_ms: list[int], slack_ms: float) -> list[Notice]:
    """Let samples pass, each with as many pieces of 1 ms as it takes; return the notices."""
    notices = []
    for took in took_ms:
        left = count(took - 1, -1)

        def piece(left: count[int] = left) -> bool:
            clock.now_ns += MS
            return next(left) == 0

        assert slack.fill(piece, lambda: None) is None
        notices.append(slack.begin(1e-3 * slack_ms, judged=True))
    return [notice for notice in notices if notice is not None]


def test_pieces_are_done_until_nothing_is_left() -> None:
    clock = Clock()
    slack = Slack(clock)
    samples(slack, clock, [7], 100.0)
    assert clock.now_ns == 7 * MS
    assert slack.taken_s == 0.0, "a new sample has begun"


def test_a_message_is_returned_before_another_piece_is_begun() -> None:
    pieces: list[int] = []
    slack = Slack()
    assert slack.fill(lambda: pieces.append(1) is not None, lambda: "state" if len(pieces) == 2 else None) == "state"
    assert len(pieces) == 2
    assert slack.fill(lambda: pieces.append(1) is not None, lambda: "state") == "state"
    assert len(pieces) == 2


@pytest.mark.parametrize(("slack_ms", "enough"), [(10.0, True), (9.9, False)])
def test_a_slack_under_twice_the_p99_is_not_enough(slack_ms: float, enough: bool) -> None:
    clock = Clock()
    slack = Slack(clock)
    slack.begin(1e-3 * slack_ms, judged=False)
    notices = samples(slack, clock, [1] * (JUDGED_SAMPLES - 2) + [5, 30], slack_ms)
    assert slack.enough is enough
    assert [notice.code for notice in notices] == [] if enough else ["second_opinion_off"]


def test_a_few_short_slacks_are_no_reason() -> None:
    clock = Clock()
    slack = Slack(clock)
    for slack_ms, how_many in ((10.0, 30), (0.5, 20), (10.0, 50)):
        assert samples(slack, clock, [1] * how_many, slack_ms) == []
    assert slack.enough


def test_it_is_said_once_and_tried_again() -> None:
    clock = Clock()
    slack = Slack(clock)
    slack.begin(10e-3, judged=False)
    (notice,) = samples(slack, clock, [6, 6], 10.0)
    assert notice.severity is Severity.INFO
    assert "6.0 ms" in notice.text
    assert "10.0 ms" in notice.text
    since_ns = clock.now_ns
    assert samples(slack, clock, [6] * PAUSED_SAMPLES, 10.0) == []
    assert clock.now_ns == since_ns, "no piece is done meanwhile"
    assert slack.enough
    assert samples(slack, clock, [6, 6], 10.0) == []
    assert not slack.enough
    samples(slack, clock, [6] * (2 * PAUSED_SAMPLES - 1), 100.0)
    assert not slack.enough, "it is tried more and more rarely"
    samples(slack, clock, [6], 100.0)
    assert samples(slack, clock, [6] * JUDGED_SAMPLES, 100.0) == []
    assert slack.enough


def test_samples_without_a_plan_are_not_judged() -> None:
    slack = Slack()
    for _ in range(2 * JUDGED_SAMPLES):
        assert slack.begin(-1.0, judged=False) is None
    assert slack.enough
