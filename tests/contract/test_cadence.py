# SPDX-License-Identifier: Apache-2.0
"""Cadence of a robot's states: increasing numbers, and stamps in nanoseconds."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.contract.cadence import Cadence

MS = 1_000_000


class Robot:
    """A robot that sends states, and what is made of them."""

    def __init__(self, rate: float = 1.0, period_ms: float = 100.0) -> None:
        self.cadence = Cadence()
        self.rate, self.period_ms = rate, period_ms
        self.seq, self.stamp, self.local_ms = 0, 5e9, 1000.0
        self.told: list[tuple[str, str]] = []

    def send(self, *, seq: int | None = None, stamp: int | None = None) -> bool:
        """Let a local period pass, and send."""
        self.local_ms += self.period_ms
        self.seq += 1
        self.stamp += self.rate * self.period_ms * MS
        counts = self.cadence.observe(self.seq if seq is None else seq, int(self.stamp) if stamp is None else stamp, round(self.local_ms * MS))
        if self.cadence.notice is not None:
            self.told.append((self.cadence.notice.code, self.cadence.notice.text))
        return counts

    def live(self, seconds: float) -> None:
        for _ in range(round(1e3 * seconds / self.period_ms)):
            assert self.send()


@pytest.mark.parametrize("rate", [0.005, 0.1, 1.0, 10.0, 200.0])
@pytest.mark.parametrize("period_ms", [1.0, 100.0, 20_000.0])
def test_clock_of_any_simulation_is_known_when_the_second_state_has_come_after_a_while(rate: float, period_ms: float) -> None:
    robot = Robot(rate, period_ms)
    robot.send()
    assert not robot.cadence.known
    while robot.local_ms < 1000 + 50 + 2 * period_ms:
        robot.send()
    assert robot.cadence.known
    assert robot.cadence.rate == pytest.approx(rate, rel=1e-6)
    assert not robot.told


@pytest.mark.parametrize(
    ("rate", "unit"),
    [
        (1e-9, "s (seconds)"),
        (1e-6, "ms (milliseconds)"),
        (1e-3, "us (microseconds)"),
        (1e3, "ps (picoseconds)"),
        (4e-6, "ms (milliseconds)"),
        (4e-3, "us (microseconds)"),
    ],
)
@pytest.mark.parametrize("period_ms", [5.0, 100.0])
def test_unit_that_is_none_is_named_and_nothing_is_ever_known(rate: float, unit: str, period_ms: float) -> None:
    robot = Robot(rate, period_ms)
    for _ in range(round(5000 / period_ms)):
        robot.send()
        assert not robot.cadence.known
    assert [text for code, text in robot.told if code == "stamps_not_ns"] == [robot.cadence.fault + "; nothing is commanded"]
    assert unit in robot.cadence.fault
    assert "nanoseconds are expected" in robot.cadence.fault


def test_what_was_seen_is_said_in_numbers() -> None:
    robot = Robot(1e-3)
    robot.live(1.0)
    assert robot.cadence.fault == "the robot's stamps advance 0.001 ns per ns: they look like us (microseconds), nanoseconds are expected"


@pytest.mark.parametrize("rate", [1e-6, 1e-3, 1e3])
def test_rate_that_leaves_what_is_possible_is_told_within_three_states_and_forgiven_when_it_returns(rate: float) -> None:
    robot = Robot()
    robot.live(3.0)
    robot.rate = rate
    robot.live(0.3)
    assert not robot.cadence.known
    assert [code for code, _ in robot.told] == ["stamps_not_ns"]
    robot.rate = 1.0
    robot.live(0.2)
    assert (robot.cadence.known, robot.cadence.fault) == (True, "")


def test_robot_that_was_held_up_once_is_no_clock_that_has_stopped() -> None:
    """Its clock waits with it; the same holds if the queue was held up."""
    robot = Robot()
    robot.live(3.0)
    robot.local_ms += 60_000.0
    robot.live(3.0)
    assert (robot.cadence.known, robot.told) == (True, [])


def test_states_that_come_in_bursts_show_no_fast_clock() -> None:
    robot = Robot()
    for i in range(100):
        robot.period_ms = 1.0 if i % 10 else 991.0
        robot.rate = 100.0 / robot.period_ms
        robot.send()
    assert (robot.cadence.known, robot.told) == (True, [])


@pytest.mark.parametrize("seed", [1, 2])
def test_jitter_of_arrivals_neither_hides_a_unit_nor_makes_one_up(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for rate, known in ((1.0, True), (1e-3, False)):
        robot = Robot(rate)
        for i in range(300):
            robot.period_ms = 100.0 * rng.uniform(0.25, 1.75)
            robot.rate = rate * 100.0 / robot.period_ms
            robot.send()
            assert robot.cadence.known == (known and i > 0)


def test_stamps_that_stand_still_are_told_within_two_seconds_and_once() -> None:
    robot = Robot()
    robot.live(1.0)
    stamp = int(robot.stamp)
    told_after = next(i for i in range(100) if robot.send(stamp=stamp) and robot.told)
    for _ in range(50):
        robot.send(stamp=stamp)
    assert told_after * robot.period_ms <= 2000
    ((code, text),) = robot.told
    assert code == "stamps_stand_still"
    assert f"of {stamp}" in text
    assert "must advance" in text


def test_stamps_that_come_three_times_each_are_no_fault() -> None:
    robot = Robot()
    for i in range(100):
        robot.send(stamp=i // 3 * 300 * MS)
    assert (robot.cadence.known, robot.told) == (True, [])


def test_number_that_never_counts_is_told_within_two_seconds_and_once() -> None:
    robot = Robot()
    counted = [robot.send(seq=7) for _ in range(50)]
    assert counted == [True] + [False] * 49
    assert not robot.cadence.known
    ((code, text),) = robot.told
    assert code == "seq_stands_still"
    assert "seq must be above the one before in every state, got 7 after 7" in text


def test_state_that_is_sent_twice_is_no_number_that_never_counts() -> None:
    """The same holds for a state repeated by a simulation that is far slower than the receiver."""
    robot = Robot(rate=0.005, period_ms=20_000.0)
    for _ in range(10):
        assert robot.send()
        for _ in range(5):
            robot.local_ms += 1000.0
            assert not robot.cadence.observe(robot.seq, int(robot.stamp), round(robot.local_ms * MS))
            assert robot.cadence.notice is None


def test_number_far_above_the_last_one_does_not_deafen() -> None:
    robot = Robot()
    robot.live(1.0)
    assert not robot.send(seq=2**63)
    robot.live(1.0)


def test_robot_that_was_not_heard_for_long_may_have_counted_on() -> None:
    robot = Robot(period_ms=1.0)
    robot.live(1.0)
    robot.local_ms += 3_600_000.0
    robot.stamp += 3_600_000.0 * MS
    robot.seq += 3_600_000
    robot.live(1.0)
