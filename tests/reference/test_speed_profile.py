# SPDX-License-Identifier: Apache-2.0
"""Tests of speed profiles: limits kept, the fastest inside them, starts and ends."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.reference.path import smooth_path
from rti_mpc.reference.speed_profile import SpeedLimits, profile_time_s, speed_profile
from rti_mpc.reference.tracks import TRACKS, track

LIMITS = SpeedLimits(speed=7.0, lateral=5.0, acceleration=4.0, braking=6.0)


def test_profile_of_a_straight_rises_from_rest_and_falls_to_rest_with_constant_acceleration() -> None:
    step_m = 0.01
    speed = speed_profile(np.zeros(1001), step_m, LIMITS, closed=False)
    # From rest over 10 m: up to v with 4 m/s^2, down with 6: v^2 (1/8 + 1/12) = 10, v = 6.93 m/s.
    peak = np.sqrt(10.0 / (1 / 8 + 1 / 12))
    assert speed.max() == pytest.approx(peak, rel=2e-3)  # the peak lies between two steps
    assert speed[-1] == 0.0
    assert speed[0] == pytest.approx(np.sqrt(2 * 4.0 * step_m))
    assert speed[0] / 4 + profile_time_s(speed, step_m, closed=False) == pytest.approx(peak / 4 + peak / 6, rel=2e-3)


@pytest.mark.parametrize("name", TRACKS)
def test_profile_of_a_track_keeps_to_its_limits_and_touches_one_everywhere(name: str) -> None:
    path = track(name).limited(LIMITS)
    kappa, v2, h = path.curvature(path.step_m * np.arange(len(path.control))), path.speed**2, path.step_m
    lateral = np.abs(kappa) * v2
    along = (np.roll(v2, -1) - v2) / (2 * h)
    left_over = np.sqrt(np.clip(1 - (lateral / LIMITS.lateral) ** 2, 0, 1))
    left_over_next = np.roll(left_over, -1)
    tolerance = 1e-6  # a square root of rounding
    assert (lateral <= LIMITS.lateral + tolerance).all()
    assert (path.speed <= LIMITS.speed + tolerance).all()
    assert (along <= LIMITS.acceleration * left_over + tolerance).all()
    assert (-along <= LIMITS.braking * left_over_next + tolerance).all()
    fast = (lateral > LIMITS.lateral - 1e-6) | (path.speed > LIMITS.speed - 1e-6)
    rising = np.roll(along > LIMITS.acceleration * left_over - 1e-6, 1)
    falling = -along > LIMITS.braking * left_over_next - 1e-6
    assert (fast | rising | falling).all()


def test_profile_of_a_closed_path_does_not_depend_on_where_it_begins() -> None:
    path = track("chicane")
    kappa = path.curvature(path.step_m * np.arange(len(path.control)))
    speed = speed_profile(kappa, path.step_m, LIMITS, closed=True)
    turned = speed_profile(np.roll(kappa, 40), path.step_m, LIMITS, closed=True)
    np.testing.assert_allclose(np.roll(turned, -40), speed, rtol=1e-12)


def test_profile_inside_a_given_one_exceeds_neither() -> None:
    given = smooth_path(np.array([[0.0, 0.0], [20.0, 0.0]]), speed=2.0)
    assert given.limited(LIMITS, inside=True).speed.max() == pytest.approx(2.0)
    assert given.limited(LIMITS).speed.max() > 5.0


def test_limits_that_are_not_positive_are_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="lateral of the limits of a speed profile must be finite and above 0, got 0"):
        SpeedLimits(1.0, 0.0, 1.0, 1.0)
