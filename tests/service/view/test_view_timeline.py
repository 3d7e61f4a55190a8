# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from rti_mpc.contract.message import STAMP_ON_ARRIVAL
from rti_mpc_service.view.timeline import GAP_BETWEEN_LIVES_NS, MAX_AHEAD_NS, MAX_APART_NS, MAX_PLACED_STATES, Timeline

SECOND = 1_000_000_000


def test_the_axis_is_the_robots_clock() -> None:
    timeline = Timeline()
    assert timeline.place_state(3, 17 * SECOND) == 17 * SECOND
    assert timeline.place(17 * SECOND + 5) == 17 * SECOND + 5


def test_a_clock_that_begins_again_is_appended() -> None:
    timeline = Timeline()
    timeline.place_state(3, 20 * SECOND)
    assert timeline.place_state(4, 0) == 20 * SECOND + GAP_BETWEEN_LIVES_NS
    assert timeline.place(SECOND // 2) == 20 * SECOND + GAP_BETWEEN_LIVES_NS + SECOND // 2
    assert timeline.place_state(4, 2 * SECOND) == 22 * SECOND + GAP_BETWEEN_LIVES_NS
    assert timeline.place_state(5, 0) == 22 * SECOND + 2 * GAP_BETWEEN_LIVES_NS


def test_a_clock_that_jumps_back_is_appended_but_not_one_that_jitters() -> None:
    timeline = Timeline()
    timeline.place_state(3, 20 * SECOND)
    assert timeline.place_state(3, 20 * SECOND - SECOND // 10) == 20 * SECOND - SECOND // 10
    assert timeline.place_state(3, 5 * SECOND) == 20 * SECOND + GAP_BETWEEN_LIVES_NS
    assert timeline.place(5 * SECOND + 7) == timeline.now_ns + 7
    assert timeline.place_state(3, 6 * SECOND) == 21 * SECOND + GAP_BETWEEN_LIVES_NS


def test_a_clock_that_goes_on_through_a_restart_stays_as_it_is() -> None:
    timeline = Timeline()
    timeline.place_state(3, 20 * SECOND)
    assert timeline.place_state(4, 30 * SECOND) == 30 * SECOND


def test_stamps_of_a_former_life_do_not_run_ahead_of_the_present_one() -> None:
    timeline = Timeline()
    timeline.place_state(3, 900 * SECOND)
    now = timeline.place_state(4, 0)
    assert timeline.place(900 * SECOND) == now + MAX_AHEAD_NS


def test_what_comes_before_any_state_is_placed_where_a_clock_can_be() -> None:
    assert Timeline().place(STAMP_ON_ARRIVAL) == 0
    assert Timeline().place(12) == 12


def test_the_axis_stays_within_int64_whatever_lives_of_a_robot_say() -> None:
    timeline = Timeline()
    for epoch, stamp_ns in enumerate(20 * [2**62 - 1, 1 - 2**62, 0, 2**62 - 1, 5]):
        for placed in (timeline.place_state(epoch, stamp_ns), timeline.place(2**62 - 1), timeline.place(1 - 2**62), timeline.now_ns):
            assert abs(placed) < 2**63


def test_several_robots_share_the_local_time_of_their_first_states() -> None:
    early, late = Timeline(begun_ns=100), Timeline(begun_ns=100)
    assert early.place_state(1, 7_000, 150) == 50
    assert late.place_state(9, 5, 400) == 300
    assert early.place_state(1, 7_250, 999) == 300, "from then on by the robot's own clock"
    assert early.place(7_260) == 310
    assert early.place_state(2, 0, 900) == 800, "a restarted robot is placed anew"


@pytest.mark.parametrize("speed", [0.375, 3.0])
def test_robots_that_share_a_view_end_at_the_present_however_fast_their_clocks_are(speed: float) -> None:
    timeline = Timeline(begun_ns=0)
    placed = [timeline.place_state(1, round(speed * local_ns), 7 * SECOND + local_ns) for local_ns in range(0, 60 * SECOND, SECOND // 20)]
    assert placed[0] == 7 * SECOND
    assert sorted(placed) == placed, "never back in time"
    assert abs(placed[-1] - 67 * SECOND) <= MAX_APART_NS + SECOND // 20
    assert timeline.place(round(speed * 60 * SECOND)) - placed[-1] <= MAX_AHEAD_NS
    assert timeline.place(0) >= 7 * SECOND, "what belongs to its beginning is not before it"


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_what_is_late_is_placed_at_its_state_however_fast_the_clock_is(speed: float) -> None:
    timeline, period_ns = Timeline(begun_ns=0), SECOND // 50
    placed = {k * period_ns: timeline.place_state(1, k * period_ns, 7 * SECOND + round(k * period_ns / speed)) for k in range(1000)}
    for stamp_ns, time_ns in placed.items():
        assert timeline.place(stamp_ns) == time_ns
        assert time_ns <= timeline.place(stamp_ns + period_ns // 2) <= placed.get(stamp_ns + period_ns, 99 * SECOND), "and between two states"
    now_ns, stamp_ns = timeline.now_ns, 990 * period_ns
    assert timeline.place_state(1, stamp_ns, 99 * SECOND) == placed[stamp_ns], "a state that comes late, too"
    assert timeline.now_ns == now_ns


def test_times_of_as_many_states_are_kept_as_messages_wait() -> None:
    timeline = Timeline(begun_ns=0)
    placed = [timeline.place_state(1, k * SECOND, 2 * k * SECOND) for k in range(2 * MAX_PLACED_STATES)]
    kept = placed[-MAX_PLACED_STATES:]
    assert [timeline.place((MAX_PLACED_STATES + k) * SECOND) for k in range(MAX_PLACED_STATES)] == kept
    assert timeline.place((MAX_PLACED_STATES - 1) * SECOND) == kept[0] - SECOND, "older ones by the robot's clock"


def test_a_clock_that_waits_or_jumps_does_not_leave_the_robots_beside_it() -> None:
    timeline = Timeline(begun_ns=0)
    timeline.place_state(1, 0, SECOND)
    assert timeline.place_state(1, SECOND // 10, 61 * SECOND) == 61 * SECOND - MAX_APART_NS, "its clock has waited for a minute"
    assert timeline.place_state(1, 3600 * SECOND, 61 * SECOND) == 61 * SECOND + MAX_APART_NS, "its clock has jumped by an hour"
    assert timeline.place_state(1, 0, 62 * SECOND) == 62 * SECOND, "and back"
    assert timeline.place_state(1, SECOND, 63 * SECOND) == 63 * SECOND


def test_what_comes_before_the_first_state_of_one_of_several_robots_is_placed_when_it_has_arrived() -> None:
    assert Timeline(begun_ns=2 * SECOND).place(4800 * SECOND, 5 * SECOND) == 3 * SECOND, "its stamp is of a clock that nobody knows yet"
