# SPDX-License-Identifier: Apache-2.0
"""Smoothing of recorded paths: their headings can be followed, and paths without noise are not changed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.errors import ConfigError
from rti_mpc.reference.smoothing import average, smoothed
from rti_mpc.reference.trajectory import rows, waypoints

T = np.linspace(0.0, 60.0, 1500)
LINE = np.column_stack([0.25 * T, np.zeros_like(T)])
EIGHT = np.column_stack([np.sin(T / 10), np.sin(T / 5)])
CIRCLE = np.column_stack([np.cos(T * math.tau / 60), np.sin(T * math.tau / 60)])


def noisy(points: Array, sigma_m: float, seed: int = 1) -> Array:
    return points + sigma_m * np.random.default_rng(seed).normal(size=points.shape)


def turns(y: Array) -> Array:
    """Change of the heading from row to row, in degrees."""
    return np.degrees(np.abs(np.diff(y[:, 2])))


@pytest.mark.parametrize("heading", ["tangent", "consistent"])
def test_headings_of_a_recorded_path_do_not_jump(heading) -> None:
    recorded = noisy(EIGHT, 0.01)
    assert turns(rows(waypoints(recorded, smooth_m=0.0), 0.05, "tangent")).max() > 30.0, "as it was"
    assert turns(rows(waypoints(recorded), 0.05, heading)).max() < 5.0


@pytest.mark.parametrize("sigma_m", [0.003, 0.01, 0.03])
def test_headings_of_a_straight_recording_are_straight(sigma_m: float) -> None:
    y = rows(waypoints(noisy(LINE, sigma_m)), 0.05, "tangent")
    off = np.degrees(y[:, 2])
    assert np.std(off) < 2.5  # degrees: 1.5 are aimed at, and the ends see half a window
    assert np.abs(off).max() < 10.0


def test_the_window_follows_the_noise_and_is_said_with_what_it_moves() -> None:
    windows = [smoothed(noisy(LINE, sigma_m)).window_m for sigma_m in (0.003, 0.01, 0.03)]
    assert windows == sorted(windows)
    assert 0.1 <= windows[0] < windows[2] <= 2.0
    trajectory = waypoints(noisy(LINE, 0.01))
    assert f"degrees from one to the next: averaged over {windows[1]:g} m of path, which moves it by at most " in trajectory.note
    moved_mm = float(trajectory.note.split()[-2])
    position = trajectory.position(np.linspace(0.0, trajectory.duration_s, 500))
    assert np.abs(position[:, 1]).max() < 0.01
    assert 5.0 < moved_mm < 60.0


def test_rounded_coordinates_count_as_noise() -> None:
    assert turns(rows(waypoints(np.round(EIGHT, 2), smooth_m=0.0), 0.05, "tangent")).max() > 30.0
    assert turns(rows(waypoints(np.round(EIGHT, 2)), 0.05, "tangent")).max() < 8.0


def test_where_the_robot_stood_while_it_was_recorded_is_one_point() -> None:
    stood = np.vstack([noisy(np.zeros((300, 2)), 0.01), noisy(LINE[:500], 0.01, seed=2)])
    trajectory = waypoints(stood)
    assert trajectory.duration_s == pytest.approx(20.0, rel=0.05)  # 5 m at 0.25 m/s; the points alone are three times as long
    assert np.degrees(np.abs(rows(trajectory, 0.05, "tangent")[:, 2])).max() < 12.0


@pytest.mark.parametrize(
    "points",
    [
        np.array([[0.0, 0.0], [1.5, 0.0], [2.0, 1.0], [3.5, 1.0]]),
        np.array([[0.0, 0.0], [1.5, 0.0], [1.7, 0.2], [2.5, 0.2], [2.7, 0.0], [4.0, 0.0]]),
        np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 0.0]]),
        EIGHT,
        CIRCLE,
        noisy(EIGHT[::50], 0.01),
    ],
    ids=["zigzag", "dodge", "there and back", "eight", "circle", "surveyed"],
)
def test_path_that_was_laid_out_stays_as_it_is(points: Array) -> None:
    followed = smoothed(points)
    assert followed.window_m == 0.0
    assert followed.points is points
    assert waypoints(points).note == ""


@pytest.mark.parametrize("points", [noisy(LINE, 0.01), noisy(EIGHT, 0.02)])
def test_ends_of_a_recorded_path_stay_in_place(points: Array) -> None:
    averaged, _ = average(points, 0.5)
    np.testing.assert_allclose(averaged[[0, -1]], points[[0, -1]], atol=1e-12)


def test_recorded_lap_stays_closed_and_as_smooth_where_it_closes() -> None:
    lap = noisy(CIRCLE, 0.01)
    lap[-1] = lap[0]
    trajectory = waypoints(lap)
    assert trajectory.lap_s is not None
    assert turns(rows(trajectory, 0.05, "tangent")).max() < 8.0
    radius = np.hypot(*trajectory.position(np.linspace(0.0, trajectory.lap_s, 500)).T)
    np.testing.assert_allclose(radius, 1.0, atol=0.03)  # a tenth of the points' own


@pytest.mark.parametrize("window_m", [-0.1, math.nan, math.inf])
def test_window_that_is_none_is_refused(window_m: float) -> None:
    with pytest.raises(ConfigError, match="smooth_m must be a distance of at least 0 m"):
        waypoints(EIGHT, smooth_m=window_m)


def test_path_shorter_than_its_window_is_a_path_all_the_same() -> None:
    averaged, _ = average(noisy(LINE[:20], 0.003), 1.0)
    assert np.isfinite(averaged).all()
    assert len(averaged) >= 2
