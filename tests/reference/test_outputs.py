# SPDX-License-Identifier: Apache-2.0
"""References of outputs: start, end, and refused files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.reference.outputs import OUTPUT_SCENARIOS, names_outputs, recorded
from rti_mpc.rotation import Rotations
from rti_mpc.signals import Signal

INFINITE = np.full(3, np.inf)
T = np.arange(0.0, 120.0, 0.05)
JOINTS = (Signal("q1", "rad", angle=True), Signal("z", "m"))


@pytest.mark.parametrize("name", OUTPUT_SCENARIOS)
def test_outputs_begin_where_the_robot_is_and_those_that_do_not_move_stay_there(name: str) -> None:
    y0 = np.array([3.0, -2.0, 7.0])
    y = OUTPUT_SCENARIOS[name](-INFINITE, INFINITE, [2, 0]).rows(y0, T)
    np.testing.assert_allclose(y[0], y0, rtol=0, atol=1e-12)
    assert (y[:, 1] == -2.0).all()
    assert (np.ptp(y[:, [0, 2]], axis=0) >= 0.4).all()


@pytest.mark.parametrize("name", OUTPUT_SCENARIOS)
@pytest.mark.parametrize("start", [0.0, 0.05, 0.2, -3.0], ids=["at a bound", "near it", "between both", "beyond it"])
def test_outputs_stay_inside_their_bounds_wherever_they_begin(name: str, start: float) -> None:
    """An output that begins outside its bounds does not move farther away."""
    y = OUTPUT_SCENARIOS[name](np.zeros(1), np.full(1, 0.4), [0]).rows(np.array([start]), T)
    assert y.min() >= min(start, 0.0)
    assert y.max() <= 0.4


def test_outputs_that_move_do_not_all_turn_back_at_once() -> None:
    y = OUTPUT_SCENARIOS["sines"](-INFINITE, INFINITE, [0, 1, 2]).rows(np.zeros(3), T)
    assert np.abs(np.diff(y, axis=0)).max(axis=1).min() > 0.0


@pytest.mark.parametrize("name", OUTPUT_SCENARIOS)
def test_nothing_that_moves_is_no_trouble(name: str) -> None:
    assert (OUTPUT_SCENARIOS[name](-INFINITE, INFINITE, []).rows(np.ones(3), T) == 1.0).all()


def test_file_has_a_column_for_each_output_by_name_and_times_from_any_start_on(tmp_path: Path) -> None:
    """Angles are interpolated across whole turns; the last row holds."""
    path = tmp_path / "wave.csv"
    path.write_text("# a comment\n z , note, t, q1\n\n0.0,a,100.0,3.1\n1.0,b,101.0,-3.1\n2.0,c,103.0,-3.0\n")
    reference = recorded(path, JOINTS, Rotations.of(JOINTS))
    assert (reference.name, reference.duration_s) == ("wave", 3.0)
    y = reference.rows(np.full(2, np.nan), np.array([0.0, 0.5, 2.0, 9.0]))
    np.testing.assert_allclose(y[:, 1], [0.0, 0.5, 1.5, 2.0])
    np.testing.assert_allclose(y[:, 0], [3.1, np.pi, 2 * np.pi - 3.05, 2 * np.pi - 3.0])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("t,q1\n0,0\n1,0\n", "line 1: the header must name t and every output of the model, z is missing, got t, q1"),
        ("# a path\nx,y\n0,0\n", "line 2: the header must name t and every output of the model, t is missing, got x, y"),
        ("0,0,0\n1,0,0\n", "line 1: the header must name t and every output of the model, t is missing, got 0, 0, 0"),
        ("", "line 1: the header must name t and every output of the model, t is missing, got nothing"),
        ("t,q1,z\n0,0,0\n", "must have at least two lines below its header, got 1"),
        ("t,q1,z\n0,0,0\n\n1,0\n", "line 4, column z: must be a finite number, got ''"),
        ("t,q1,z\n0,up,0\n1,0,0\n", "line 2, column q1: must be a finite number, got 'up'"),
        ("t,q1,z\n0,0,0\n1,0,inf\n", "line 3, column z: must be a finite number, got 'inf'"),
        ("t,q1,z\n0,0,0\n1,0,0\n1,0,0\n", "line 4, column t: must be later than in the line before"),
    ],
)
def test_what_is_wrong_with_a_file_is_one_line_that_names_line_and_column(text: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "wave.csv"
    path.write_text(text)
    with pytest.raises(ConfigError) as refusal:
        recorded(path, JOINTS, Rotations.of(JOINTS))
    assert str(refusal.value).startswith(str(path))
    assert told in str(refusal.value)


def test_columns_may_be_separated_as_those_of_waypoints(tmp_path: Path) -> None:
    path = tmp_path / "wave.csv"
    path.write_text("t;q1;z\n0,0;0,5;1\n1,0;1,5;2\n")
    np.testing.assert_allclose(recorded(path, JOINTS, Rotations.of(JOINTS)).rows(np.zeros(2), np.array([0.5])), [[1.0, 1.5]])


def test_waypoints_are_told_from_outputs_over_time_by_their_header(tmp_path: Path) -> None:
    path = tmp_path / "path.csv"
    for text, timed in (("x,y\n0,0\n", False), ("t,q1\n", False), ("t,z,q1\n", True), ("0,0\n1,1\n", False), ("", False)):
        path.write_text(text)
        assert names_outputs(path, JOINTS) is timed
