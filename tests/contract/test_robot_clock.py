# SPDX-License-Identifier: Apache-2.0
"""The robot's clock as seen from its stamps."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.contract.robot_clock import RobotClock

MS = 1_000_000


def ticking(rate: float, period_ms: float = 100.0, count: int = 30, start_ns: int = 5_000 * MS, jitter_ms: float = 0.0) -> RobotClock:
    """A clock that has heard states: robot time advances `rate` times as fast as local time."""
    clock = RobotClock()
    rng = np.random.default_rng(1)
    for i in range(count):
        late_ns = round(MS * jitter_ms * rng.random())
        clock.observe(i + 1, start_ns + round(i * period_ms * MS), round(i * period_ms * MS / rate) + late_ns)
    return clock


@pytest.mark.parametrize("rate", [0.1, 1.0, 4.0, 50.0])
def test_simulated_time_runs_at_its_own_rate(rate: float) -> None:
    clock = ticking(rate, count=300)
    assert clock.rate == pytest.approx(rate, rel=1e-3)
    assert clock.now_ns(clock.arrival_ns + 10 * MS) == pytest.approx(clock.stamp_ns + rate * 10 * MS, abs=2)


def test_jitter_of_arrivals_is_averaged_out() -> None:
    assert ticking(1.0, jitter_ms=20.0).rate == pytest.approx(1.0, rel=0.05)


def test_rate_is_assumed_low_until_it_is_known() -> None:
    """Otherwise the first states of a slow simulation would be taken for the last of a dead robot."""
    clock = ticking(1.0, count=2)
    assert clock.rate == 0.1
    assert clock.now_ns(clock.arrival_ns + 1000 * MS) - clock.stamp_ns == 100 * MS


def test_rate_is_at_most_as_fast_as_states_have_come_until_it_is_known() -> None:
    """Otherwise a sample of a fast simulation would be sent long after its time."""
    clock = ticking(4.0, count=1)
    assert clock.latest_ns(clock.arrival_ns + 10 * MS) - clock.stamp_ns == 100 * MS  # after one state it may be that of any
    clock = ticking(4.0, count=2)
    assert (clock.rate, clock.rate_most) == (0.1, 4.0)
    assert ticking(4.0, count=30).rate_most == pytest.approx(4.0)


def test_lateness_of_one_state_after_another_adds_up() -> None:
    clock = ticking(1.0)
    for i, late_ms in enumerate((30, 70), start=1):
        stamp_ns = clock.stamp_ns + 100 * MS
        clock.observe(30 + i, stamp_ns, stamp_ns - 5_000 * MS + late_ms * MS)
        assert clock.late_ns == pytest.approx(late_ms * MS, abs=15 * MS)  # the rate follows, by a twentieth at a time


def test_lateness_is_in_doubt_after_a_silence() -> None:
    clock = ticking(1.0)
    clock.observe(31, clock.stamp_ns + 100 * MS, clock.arrival_ns + 100 * MS)
    assert clock.doubt_ns == pytest.approx(10 * MS, rel=1e-3)
    clock.observe(32, clock.stamp_ns + 2000 * MS, clock.arrival_ns + 2000 * MS)
    assert clock.doubt_ns == pytest.approx(200 * MS, rel=1e-3)


def test_clock_that_has_jumped_runs_as_fast_as_before() -> None:
    clock = ticking(4.0)
    rate = clock.rate
    clock.jump()
    clock.observe(31, 1000 * MS, clock.arrival_ns + 10**9)
    assert (clock.rate, clock.rate_most) == (rate, rate)
    assert clock.now_ns(clock.arrival_ns) == 1000 * MS


def test_time_of_a_robot_that_has_fallen_silent_goes_on() -> None:
    clock = ticking(2.0)
    assert clock.now_ns(clock.arrival_ns + 500 * MS) - clock.stamp_ns == pytest.approx(1000 * MS, rel=1e-3)


def test_rate_follows_a_simulation_that_is_slowed_down() -> None:
    clock = ticking(4.0)
    stamp_ns, arrival_ns = clock.stamp_ns, clock.arrival_ns
    for i in range(1, 30):
        clock.observe(30 + i, stamp_ns + i * 100 * MS, arrival_ns + i * 200 * MS)
    assert clock.rate == pytest.approx(0.5, rel=1e-3)


def test_rate_does_not_follow_states_that_come_late_now_and_then() -> None:
    clock, rates = ticking(1.0, count=300), []
    for i in range(1, 50):
        clock.observe(300 + i, clock.stamp_ns + 100 * MS, 29_900 * MS + i * 100 * MS + (0 if i % 4 else 90 * MS))
        rates.append(clock.rate)
    assert rates == pytest.approx([1.0] * len(rates), rel=1e-3)


def test_states_that_were_held_up_together_show_no_faster_clock() -> None:
    """Otherwise all later states would look late, and no sample would be answered until the rate is measured again."""
    clock = ticking(1.0)
    stamp_ns, arrival_ns = clock.stamp_ns, clock.arrival_ns + 300 * MS
    assert not clock.observe(31, stamp_ns + 100 * MS, arrival_ns + 100 * MS)
    for i in range(2, 20):
        assert clock.observe(30 + i, stamp_ns + i * 100 * MS, arrival_ns - 40 * MS + i * 100 * MS)
        assert clock.rate == pytest.approx(1.0, rel=1e-3)
        assert clock.late_ns == 0


def test_period_is_that_of_the_robot_where_states_are_lost() -> None:
    clock = RobotClock()
    for i in range(0, 60, 3):
        clock.observe(i, i * 20 * MS, i * 20 * MS)
    assert clock.period_ns == pytest.approx(20 * MS)


def test_period_is_smoothed_over_jitter() -> None:
    clock = RobotClock()
    rng = np.random.default_rng(2)
    for i in range(200):
        stamp_ns = i * 20 * MS + round(rng.uniform(-3, 3) * MS)
        clock.observe(i, stamp_ns, stamp_ns)
    assert clock.period_ns == pytest.approx(20 * MS, rel=0.1)


def test_another_life_of_the_robot_begins_with_nothing() -> None:
    clock = ticking(4.0)
    clock.reset()
    assert (clock.period_ns, clock.rate) == (0.0, 0.1)
    clock.observe(1, 0, 10**12)
    assert clock.now_ns(10**12) == 0


def test_stamp_that_stands_still_changes_nothing() -> None:
    clock = ticking(1.0)
    rate, period_ns = clock.rate, clock.period_ns
    clock.observe(31, clock.stamp_ns, clock.arrival_ns + 5 * MS)
    assert (clock.rate, clock.period_ns) == (rate, period_ns)


def test_states_that_waited_and_come_in_clumps_are_not_fresh() -> None:
    """A process that was stopped and then gets few turns drains its queue so: the first of each clump has taken its time."""
    clock = RobotClock()
    for k in range(200):
        assert clock.observe(k, k * 10 * MS, k * 10 * MS)
    arrival_ns = 1990 * MS + 1500 * MS
    for k in range(200, 260):
        arrival_ns += (90 if k % 5 == 0 else 1) * MS
        assert not clock.observe(k, k * 10 * MS, arrival_ns), k
