# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable

import pytest

from rti_mpc_service.controller.rehearsal import JUDGED_SAMPLES, LEAD_S, LEAST_AHEAD_S, LEAST_SLACK_S, Rehearsal

MS = 1_000_000


class Over(Exception):
    """The thread would wait for ever."""


class Clock:
    """A clock on which only sleep takes time; whoever sleeps may be interrupted by what happens meanwhile."""

    def __init__(self) -> None:
        self.now_ns = 1000 * MS
        self.woke_ns: list[int] = []
        self.meanwhile: list[Callable[[], object]] = []

    def __call__(self) -> int:
        return self.now_ns

    def sleep(self, span_s: float) -> None:
        self.now_ns += round(1e9 * span_s)
        if self.meanwhile:
            self.meanwhile.pop(0)()

    def wake(self) -> None:
        self.woke_ns.append(self.now_ns)


def timekeeper() -> tuple[Rehearsal, Clock]:
    clock = Clock()
    return Rehearsal(clock.wake, clock, clock.sleep), clock


def keep_time(rehearsal: Rehearsal, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run its thread until it waits for the next sample."""
    waiting = rehearsal._expected

    class Waiting:
        def get(self) -> int:
            if waiting.empty():
                raise Over
            return waiting.get()

        empty, put = waiting.empty, waiting.put

    monkeypatch.setattr(rehearsal, "_expected", Waiting())
    with pytest.raises(Over):
        rehearsal.keep_time()


def test_control_thread_is_woken_shortly_before_the_next_state(monkeypatch: pytest.MonkeyPatch) -> None:
    rehearsal, clock = timekeeper()
    assert rehearsal.begin(0.1) is None
    assert not rehearsal.timely
    keep_time(rehearsal, monkeypatch)
    assert clock.woke_ns == [pytest.approx(1100 * MS - 1e9 * LEAD_S, abs=1)]  # 1 ns of rounding
    assert rehearsal.timely


def test_state_that_comes_early_moves_the_next_rehearsal(monkeypatch: pytest.MonkeyPatch) -> None:
    rehearsal, clock = timekeeper()
    rehearsal.begin(0.1)
    clock.meanwhile.append(lambda: rehearsal.begin(0.08))
    keep_time(rehearsal, monkeypatch)
    assert clock.woke_ns == [pytest.approx(1100 * MS + 80 * MS - 2e9 * LEAD_S, abs=2)], "once, for the later one"


@pytest.mark.parametrize(("left_s", "timely"), [(LEAST_AHEAD_S + 1e-6, True), (LEAST_AHEAD_S - 1e-6, False), (-1e-4, False), (2.1 * LEAD_S, False)])
def test_nothing_is_rehearsed_where_a_state_may_come_at_once_or_not_soon(left_s: float, timely: bool) -> None:
    """A thread that was woken late, or for a state that has come early meanwhile."""
    rehearsal, _ = timekeeper()
    rehearsal.begin(left_s)
    assert rehearsal.timely is timely


def test_slack_that_is_too_short_is_told_once_and_nothing_is_rehearsed(monkeypatch: pytest.MonkeyPatch) -> None:
    rehearsal, clock = timekeeper()
    notices = [rehearsal.begin(0.9 * LEAST_SLACK_S) for _ in range(3 * JUDGED_SAMPLES)]
    keep_time(rehearsal, monkeypatch)
    assert clock.woke_ns == []
    assert [notice.code for notice in notices if notice is not None] == ["rehearsal_off"]
    rehearsal.begin(1.1 * LEAST_SLACK_S)
    keep_time(rehearsal, monkeypatch)
    assert len(clock.woke_ns) == 1
    assert all(rehearsal.begin(0.9 * LEAST_SLACK_S) is None for _ in range(3 * JUDGED_SAMPLES))


def test_short_slack_now_and_then_is_not_told() -> None:
    rehearsal, _ = timekeeper()
    for _ in range(5):
        assert all(rehearsal.begin(0.0) is None for _ in range(JUDGED_SAMPLES - 1))
        assert rehearsal.begin(0.1) is None
