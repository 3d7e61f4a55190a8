# SPDX-License-Identifier: Apache-2.0
"""CSV files of waypoints: read as they are meant, or refused by file, line and column."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.errors import ConfigError
from rti_mpc.reference.trajectory import find_trajectory
from rti_mpc.reference.waypoint_file import read_csv

WANTED = [[1.0, 0.5], [3.0, -2.0], [2.0, 0.0]]


def read(folder: Path, text: str) -> Array:
    file = folder / "tour.csv"
    file.write_text(text)
    return read_csv(file)


@pytest.mark.parametrize(
    "text",
    [
        "1,0.5\n3,-2\n2,0\n",
        "1;0.5\n3;-2\n2;0\n",
        "1\t0.5\n3\t-2\n2\t0\n",
        "1 0.5\n3 -2\n2 0\n",
        "  1   0.5  \n  3  -2\n 2 0\n",
        "1, 0.5\n3, -2\n2, 0\n",
        "1,0;0,5\n3,0;-2,0\n2,0;0,0\n",
        "1,0\t0,5\n3\t-2\n2\t0\n",
        "\ufeff1,0.5\r\n3,-2\r\n\r\n2,0\r\n",
        "x,y\n1,0.5\n3,-2\n2,0\n",
        "# surveyed\nname, Y, X\na,0.5,1\n\nb,-2,3\nc,0,2\n",
        "t x y\n0 1 0.5\n1 3 -2\n2 2 0\n",
        "s_m,x_m,y_m\n0,1,0.5\n3.2,3,-2\n5.4,2,0\n",
        "# s_m; x_m; y_m; psi_rad; vx_mps\n0.0; 1.0; 0.5; 0.1; 3.0\n3.2; 3.0; -2.0; 0.2; 3.0\n5.4; 2.0; 0.0; 0.3; 3.0\n",
        "# by the survey of May; all in m\n# x_m,y_m,w_tr_right_m,w_tr_left_m\n1,0.5,1.1,1.1\n3,-2,1.1,1.1\n2,0,1.1,1.1\n",
        'X [m]\tY [m]\theading\n1\t0.5\t0\n"3"\t-2\t0\n2\t0\t0\n',
        "time,field.pose.position.x,field.pose.position.y,field.pose.orientation.z\n0,1,0.5,0\n1,3,-2,0\n2,2,0,0\n",
        "\tx\ty\n0\t1\t0.5\n1\t3\t-2\n2\t2\t0\n",
        "1,0.5,0.25\n3,-2,0.25\n2,0,0.25\n",
        "1,0.5\n3,-2 \n,\n2,0\n# end, of, it\n",
    ],
)
def test_waypoints_are_read_whatever_separates_them_and_wherever_x_and_y_stand(text: str, tmp_path: Path) -> None:
    np.testing.assert_array_equal(read(tmp_path, text), WANTED)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("x,y\n0,0\n1,one\n", "line 3, column y: must be a finite number in m, got 'one' as cell 2 between commas"),
        ("0,0\n1\n", "line 2, column y: must be a finite number in m, got '' as cell 2"),
        ("0,0\nnan,1\n", "line 2, column x: must be a finite number in m, got 'nan'"),
        ("0 0\n1,2\n", "line 2, column y: must be a finite number in m, got '' as cell 2 between spaces"),
        ("0;0\n1,2\n", "line 2, column y: must be a finite number in m, got '' as cell 2 between semicolons"),
        ("east,north\n0,0\n", "line 1, column x: the header must name the columns x and y, got east, north"),
        ("lat;lon\n0;0\n", "line 1, column x: the header must name the columns x and y, got lat, lon"),
        ("x_mm,y_mm\n0,0\n", "line 1, column x: the header must name the columns x and y, got x_mm, y_mm"),
        ("x,y,x\n0,0,1\n", "line 1, column x: the header must name the columns x and y, got x, y, x: x is there 2 times"),
        (
            "# a tour\n\n0.0,1,2\n0.1,1,3\n",
            "line 3, column 1: must be x where 3 columns have no names, but it always increases, as time or",
        ),
        ("0 0 0 7\n1 0 1 7\n", "line 1, column 1: must be x where 4 columns have no names"),
    ],
)
def test_columns_that_are_not_meant_are_refused_by_line_and_column(text: str, place: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refusal:
        read(tmp_path, text)
    assert str(refusal.value).startswith(f"{tmp_path / 'tour.csv'}, ")
    assert place in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("text", ["", "\n\n", "# x,y\n", "x,y\n", "1,2\n", "1,2\n1,2\n"])
def test_file_without_a_path_is_refused_by_name(text: str, tmp_path: Path) -> None:
    file = tmp_path / "tour.csv"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"tour\.csv: waypoints must be at least two distinct points, got [01]"):
        find_trajectory(file)


def test_trajectory_of_a_file_has_its_name_and_its_speed(tmp_path: Path) -> None:
    (tmp_path / "tour.csv").write_text("x;y\n0;0\n3;4\n")
    trajectory = find_trajectory(str(tmp_path / "tour.csv"), speed_m_s=0.5)
    assert (trajectory.name, trajectory.duration_s, trajectory.note) == ("tour", 10.0, "")
    np.testing.assert_allclose(trajectory.position(np.array([0.0, 1e3])), [[0, 0], [3, 4]])
