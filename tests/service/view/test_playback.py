# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.contract.message import Command
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc_service.view.playback import Actuation, Playback

MS = 1_000_000


def plan(at_ms: int, u: list[float], *, period_ms: int = 100, lasts_ms: int = 250, mode: Mode = Mode.TRACKING) -> Actuation:
    stamp = at_ms * MS
    return Actuation(Command(1, 1, stamp, 1, 1, stamp, stamp + lasts_ms * MS, 9, mode, QpStatus.NONE, period_ms * MS, np.array(u)[:, None]))


def ramp(at_ms: int, u: list[float]) -> Actuation:
    return plan(at_ms, u, period_ms=10, lasts_ms=10 * len(u), mode=Mode.BRAKING)


def played(*actuations: Actuation, end: bool = True) -> list[tuple[float, float, str]]:
    playback = Playback()
    rows = [row for a in actuations for row in playback.add([a.command.stamp_ns], [a])] + (playback.end() if end else [])
    return [(row.time_ns / MS, row.u[0], row.mode.name) for row in rows]


def test_a_plan_gives_way_to_the_next_one() -> None:
    assert played(plan(0, [1.0, 2.0, 3.0]), plan(100, [4.0, 5.0]), end=False) == [(0, 1.0, "TRACKING")]


def test_a_plan_that_none_follows_plays_on_until_it_has_expired() -> None:
    assert played(plan(0, [1.0, 2.0, 3.0, 4.0])) == [(0, 1.0, "TRACKING"), (100, 2.0, "TRACKING"), (200, 3.0, "TRACKING")]


def test_a_plan_plays_on_until_the_guards_ramp_begins() -> None:
    rows = played(plan(0, [3.0] * 9), ramp(150, [2.0, 1.0]), ramp(170, [0.0]))
    assert rows == [(0, 3.0, "TRACKING"), (100, 3.0, "TRACKING"), (150, 2.0, "BRAKING"), (160, 1.0, "BRAKING"), (170, 0.0, "BRAKING")]


def test_a_ramp_told_in_time_but_not_needed_is_not_played() -> None:
    assert {mode for _, _, mode in played(plan(0, [1.0] * 3), ramp(250, [0.5, 0.0]), plan(200, [1.0] * 3))} == {"TRACKING"}


def test_a_plan_that_comes_late_acts_from_then_on() -> None:
    """Else the lane would end with the ramp, which the robot has long left."""
    rows = played(ramp(100, [0.0] * 10), ramp(200, [0.0] * 10), plan(150, [1.0, 2.0]), plan(250, [3.0]), end=False)
    assert [time for time, _, _ in rows] == sorted(time for time, _, _ in rows)
    assert rows[-1][1:] == (1.0, "TRACKING")


@pytest.mark.parametrize("late", [plan(0, [1.0]), plan(150, [1.0])])
def test_what_is_over_before_it_comes_is_not_played(late: Actuation) -> None:
    rows = played(ramp(100, [0.0] * 10), ramp(200, [0.0] * 10), late, plan(160, [2.0]))
    assert [u for _, u, _ in rows] == 10 * [0.0] + [2.0]


def test_rows_do_not_depend_on_how_plans_were_batched() -> None:
    plans = [plan(0, [1.0] * 3), plan(100, [2.0] * 3), ramp(350, [1.0, 0.0])]
    playback = Playback()
    together = playback.add([a.command.stamp_ns for a in plans], plans) + playback.end()
    assert [(row.time_ns / MS, row.u[0], row.mode.name) for row in together] == played(*plans)


@pytest.mark.parametrize("pace", [0.25, 2.0])
def test_beside_other_robots_a_row_is_played_no_longer_than_by_the_robots_clock(pace: float) -> None:
    """Of a clock at half the speed, a second row would be drawn where the next plan has long been the one that acts."""
    plans = [plan(0, [1.0, 2.0]), plan(100, [3.0, 4.0]), plan(300, [5.0, 6.0])]
    rows = Playback().add([round(pace * a.command.stamp_ns) for a in plans], plans)
    assert [(row.time_ns / MS, row.u[0]) for row in rows] == [(0, 1.0), (100 * pace, 3.0), (200 * pace, 4.0)]


def test_a_plan_without_end_costs_no_more_than_its_rows() -> None:
    endless = plan(0, [1.0] * 5, lasts_ms=10**9)
    assert len(played(endless)) == 5
