# SPDX-License-Identifier: Apache-2.0
"""Tests of smooth paths: geometry, projection, widths, cusps, windows, files."""

from __future__ import annotations

from pathlib import Path as File

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.errors import ConfigError
from rti_mpc.reference.path import Path, pieces, read_path, smooth_path
from rti_mpc.reference.tracks import HALF_WIDTH_M, TRACKS, centre_line, track


def circle(n: int = 41, radius: float = 3.0) -> Array:
    turn = np.linspace(0.0, 2 * np.pi, n)
    points = radius * np.column_stack([np.cos(turn), np.sin(turn)])
    points[-1] = points[0]
    return points


def there_and_back() -> Array:
    """Forwards along an arc, then backwards along a straight: a cusp at (2, 2)."""
    turn = np.linspace(0.0, np.pi / 2, 30)
    arc = 2.0 * np.column_stack([np.sin(turn), 1.0 - np.cos(turn)])
    return np.vstack([arc, arc[-1] + np.column_stack([np.zeros(20), -np.linspace(0.1, 3.0, 20)])])


def test_path_through_a_circle_is_that_circle_by_arc_length() -> None:
    path = smooth_path(circle())
    s = np.linspace(0.0, 2 * path.length, 400)
    assert path.closed
    assert path.length == pytest.approx(6 * np.pi, rel=1e-5)  # the arc length of a spline through 40 points
    np.testing.assert_allclose(np.hypot(*path.position(s).T), 3.0, atol=3e-4)  # a spline of 16 knots
    np.testing.assert_allclose(path.curvature(s), 1 / 3, rtol=0.02)
    np.testing.assert_allclose(np.sum(path.tangent(s) * path.position(s), axis=-1), 0.0, atol=2e-3)


@pytest.mark.parametrize("name", TRACKS)
def test_track_passes_its_centre_line_and_can_be_driven(name: str) -> None:
    path = track(name)
    away = [abs(path.offset(point)[1]) for point in centre_line(name)[::3]]
    s = np.linspace(0.0, path.length, 2000)
    assert max(away) < 0.01  # knots are half a radius apart
    assert np.abs(path.curvature(s)).max() < 1 / 0.8  # a model car turns within 0.75 m
    assert np.abs(path.curvature(s)).max() * HALF_WIDTH_M < 1.0  # the edge has no kink
    along = np.hypot(*np.diff(path.position(s), axis=0).T) / (s[1] - s[0])
    np.testing.assert_allclose(along, 1.0, atol=0.01)


def test_open_path_continues_straight_beyond_its_ends() -> None:
    path = smooth_path(there_and_back()[:30])
    end, along = path.position(np.array(path.length)), path.tangent(np.array(path.length))
    np.testing.assert_allclose(end, [2.0, 2.0], atol=1e-9)
    np.testing.assert_allclose(path.position(np.array(path.length + 1.5)), end + 1.5 * along, atol=1e-3)
    np.testing.assert_allclose(path.position(np.array(-1.0)), -path.tangent(np.array(0.0)), atol=1e-3)


def test_projection_near_the_last_one_goes_on_across_laps_and_crossings() -> None:
    turn = np.linspace(0.0, 2 * np.pi, 101)
    eight = 4.0 * np.column_stack([np.sin(turn), np.sin(2 * turn) / 2])
    eight[-1] = eight[0]
    path = smooth_path(eight)
    s = 0.0
    for true in np.arange(0.0, 2.5 * path.length, 0.8):
        s = path.project(path.position(np.array(true)), near=s)
        assert s == pytest.approx(true, abs=1e-6)


def test_offset_is_positive_to_the_left() -> None:
    s, left = smooth_path(circle()).offset((2.5, 0.0))
    assert (s, left) == (pytest.approx(0.0, abs=1e-3), pytest.approx(0.5, abs=1e-3))


def test_widths_at_points_are_interpolated_at_knots() -> None:
    path = smooth_path(np.array([[0.0, 0.0], [4.0, 0.0], [10.0, 0.0]]), right=np.array([1.0, 2.0, 0.5]), left=0.7)
    np.testing.assert_allclose(path.at(path.right, np.array([0.0, 2.0, 4.0, 10.0, 12.0])), [1.0, 1.5, 2.0, 0.5, 0.5], atol=0.1)
    assert (path.left == 0.7).all()


def test_path_that_turns_back_is_split_at_its_cusp() -> None:
    first, second = pieces(there_and_back(), right=np.linspace(1.0, 2.0, 50))
    np.testing.assert_allclose(first.position(np.array(first.length)), second.position(np.array(0.0)), atol=1e-9)
    np.testing.assert_allclose(first.tangent(np.array(first.length)), -second.tangent(np.array(0.0)), atol=0.03)  # ends of 30 points
    assert first.right[-1] == second.right[0]


def test_window_is_the_spline_around_a_knot() -> None:
    path = track("oval")
    rows = path.window(-2, 8)
    np.testing.assert_array_equal(rows[2, :2], path.control[0])
    np.testing.assert_array_equal(rows[0, :2], path.control[-2])
    near_start = (rows[1, :2] + 4 * rows[2, :2] + rows[3, :2]) / 6
    np.testing.assert_allclose(near_start, path.position(np.array(0.0)), atol=1e-12)


def test_window_beyond_the_end_of_an_open_path_is_straight_with_no_speed() -> None:
    path = smooth_path(np.array([[0.0, 0.0], [8.0, 0.0]]), speed=2.0)
    rows = path.window(len(path.control) - 3, 6)
    np.testing.assert_allclose(np.diff(rows[:, 0]), path.step_m)
    np.testing.assert_array_equal(rows[:, 4], [2.0, 2.0, 0.0, 0.0, 0.0, 0.0])


def written(folder: File, text: str) -> File:
    file = folder / "track.csv"
    file.write_text(text)
    return file


def test_centre_line_with_widths_is_read_as_the_race_track_database_has_it(tmp_path: File) -> None:
    lines = "\n".join(f"{x:.4f},{y:.4f},1.5,0.5" for x, y in circle()[:-1])
    (path,) = read_path(written(tmp_path, f"# x_m,y_m,w_tr_right_m,w_tr_left_m\n{lines}\n"))
    assert path.closed
    assert (path.right == 1.5).all() and (path.left == 0.5).all()
    assert path.length == pytest.approx(6 * np.pi, rel=1e-4)


def test_race_line_is_read_with_its_speeds(tmp_path: File) -> None:
    lines = "\n".join(f"{i};{x:.4f};{y:.4f};0;0;{5 + i / 40:.3f};0" for i, (x, y) in enumerate(circle()[:-1]))
    (path,) = read_path(written(tmp_path, f"# s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2\n{lines}\n"), width_m=0.4)
    assert path.closed
    assert (path.right == 0.4).all()
    assert 5.0 <= path.speed.min() < path.speed.max() <= 6.0


def test_one_width_without_the_other_is_refused(tmp_path: File) -> None:
    with pytest.raises(ConfigError, match=r"track\.csv: the header must name both widths, w_right and w_left, or none, got x, y, w_left"):
        read_path(written(tmp_path, "x,y,w_left\n0,0,1\n1,0,1\n2,0,1\n"))


def test_negative_width_is_refused_with_its_line(tmp_path: File) -> None:
    with pytest.raises(ConfigError, match=r"track\.csv, line 3, column right: must be at least 0, got -1"):
        read_path(written(tmp_path, "x,y,w_right,w_left\n0,0,1,1\n1,0,-1,1\n2,0,1,1\n"))


def test_values_of_another_length_than_the_points_are_refused() -> None:
    with pytest.raises(ConfigError, match="right must be at least 0, one number or one for each of 3 distinct points"):
        smooth_path(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), right=np.ones(2))


def test_paths_are_exactly_as_long_as_their_knots() -> None:
    path = smooth_path(np.array([[0.0, 0.0], [8.0, 0.0]]))
    assert isinstance(path, Path)
    assert path.length == pytest.approx(8.0, rel=1e-12)
