# SPDX-License-Identifier: Apache-2.0
"""Plans approached inside the slew limits from any inputs that acted before."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.approach import SLEW_WINDOW_PERIODS, Increments, approach, segments
from rti_mpc.contract.message import Command
from rti_mpc.contract.schedule import Schedule, end_ns
from rti_mpc.contract.status import Mode, QpStatus

MS = 1_000_000
DT = 100 * MS
STEP = np.array([0.25, 0.4])
LIMITS = Increments(-STEP, STEP, DT)


def command(seq: int, stamp_ms: int, u: Array, valid_ms: int = 250, period_ms: int = 100) -> Command:
    stamp_ns = stamp_ms * MS
    return Command(1, seq, stamp_ns, 1, 1, stamp_ns, stamp_ns + valid_ms * MS, 0, Mode.TRACKING, QpStatus.SOLVED, period_ms * MS, u)


def approached(u: Array, acted: Array, *, stamp_ms: int = 0, start_ms: int = 0, period_ms: int = 100) -> Array:
    """Rows after one input has acted for long."""
    return approach(u, stamp_ms * MS, period_ms * MS, start_ms * MS, [(start_ms * MS, acted)], LIMITS)


def test_plan_inside_the_limits_is_returned_itself() -> None:
    u = np.array([[0.25, 0.4], [0.5, 0.0], [0.25, 0.4]])
    assert approached(u, np.zeros(2)) is u


def test_plan_that_begins_elsewhere_goes_on_from_what_acted_and_never_faster_than_the_limits() -> None:
    u = np.tile([0.75, -0.4], (6, 1))
    np.testing.assert_allclose(approached(u, np.zeros(2)), [[0.25, -0.4], [0.25, -0.4], [0.5, -0.4], [0.75, -0.4], [0.75, -0.4], [0.75, -0.4]])


def test_late_plan_begins_with_the_row_of_its_arrival() -> None:
    u = np.tile([0.5, 0.0], (6, 1))
    np.testing.assert_allclose(approached(u, np.zeros(2), start_ms=160)[1:4, 0], [0.25, 0.25, 0.5])


def test_rows_too_far_from_each_other_are_held_to_the_limits() -> None:
    u = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(approached(u, np.zeros(2))[:, 0], [0.0, 0.25, 0.5, 0.25])


def test_rows_closer_than_a_period_share_the_limits() -> None:
    rows = approached(np.tile([0.5, 0.0], (30, 1)), np.zeros(2), period_ms=10)
    assert np.abs(rows[10:, 0] - rows[:-10, 0]).max() <= 0.25 + 1e-12
    assert rows[-1, 0] == pytest.approx(0.5)


def test_inputs_without_limits_are_played_as_they_come() -> None:
    free = Increments(np.array([-np.inf, -0.4]), np.array([np.inf, 0.4]), DT)
    u = np.tile([9.0, 0.8], (3, 1))
    rows = approach(u, 0, DT, 0, [(0, np.zeros(2))], free)
    np.testing.assert_allclose(rows, [[9.0, 0.4], [9.0, 0.4], [9.0, 0.8]])


@pytest.mark.parametrize("seed", range(8))
def test_whatever_plans_come_whenever_no_two_inputs_within_three_quarters_of_a_period_differ_by_more_than_an_increment(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plans = Schedule(np.zeros(2), STEP / 0.1, LIMITS)
    now_ms = 0
    acted: list[tuple[int, Array]] = []
    for seq in range(1, 300):
        later_ms = now_ms + int(rng.choice([1, 3, 10, 60, 100, 100, 100, 300, 700]))
        acted += segments(plans.at, now_ms * MS, later_ms * MS)
        now_ms = later_ms
        u = np.cumsum(rng.uniform(-1.2, 1.2, (5, 2)) * STEP, axis=0)
        one = command(seq, now_ms - int(rng.integers(0, 150)), u, int(rng.integers(10, 400)), int(rng.choice([100, 100, 100, 10, 150])))
        start_ns = max(one.stamp_ns, now_ms * MS)
        if end_ns(one) > start_ns:
            plans.add(one, start_ns, end_ns(one))
    begins = np.array([0, *(until_ns for until_ns, _ in acted[:-1])])
    ends, u = np.array([until_ns for until_ns, _ in acted]), np.array([value for _, value in acted])
    assert np.abs(u).max() > 0.3
    for i in range(len(u)):
        near = ends[:i] > begins[i] - SLEW_WINDOW_PERIODS * DT
        assert (np.abs(u[:i][near] - u[i]) <= STEP + 1e-9).all(), begins[i] / MS
