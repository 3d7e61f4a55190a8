# SPDX-License-Identifier: Apache-2.0
"""Reference trajectories: their curves, their headings, their rows."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import End
from rti_mpc.errors import ConfigError, OcpError
from rti_mpc.reference.heading import consistent, periodic
from rti_mpc.reference.trajectory import (
    HEADINGS,
    SCENARIOS,
    Heading,
    Trajectory,
    circle,
    eight,
    find_trajectory,
    followed_roles,
    positioning,
    rows,
    waypoints,
)
from rti_mpc.signals import Signal

SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0], [0.0, 0.0]])
ZIGZAG = np.array([[0.0, 0.0], [1.5, 0.0], [2.0, 1.0], [3.5, 1.0]])
A = 0.2


def square() -> Trajectory:
    return waypoints(SQUARE)


def zigzag() -> Trajectory:
    return waypoints(ZIGZAG)


@pytest.mark.parametrize("build", [circle, eight, positioning, square, zigzag])
def test_velocity_is_the_derivative_of_position(build) -> None:
    trajectory = build()
    t = np.linspace(0.003, 15.0, 4001)
    h = 1e-6
    difference = (trajectory.position(t + h) - trajectory.position(t - h)) / (2 * h)
    np.testing.assert_allclose(trajectory.velocity(t), difference, atol=1e-6)


@pytest.mark.parametrize("build", [circle, eight, positioning, square, zigzag])
def test_curves_take_a_single_time_as_well_as_many(build) -> None:
    trajectory = build()
    np.testing.assert_array_equal(trajectory.position(2.5), trajectory.position(np.array([2.5]))[0])
    assert trajectory.velocity(np.zeros((3, 4))).shape == (3, 4, 2)


@pytest.mark.parametrize("build", [circle, eight, square])
def test_closed_curves_repeat_every_lap(build) -> None:
    trajectory = build()
    t = np.linspace(0.0, 10.0, 101)
    np.testing.assert_allclose(trajectory.position(t + trajectory.lap_s), trajectory.position(t), atol=1e-12)
    assert trajectory.duration_s == pytest.approx(2 * trajectory.lap_s)


def test_circle_is_what_the_paper_prints_and_eight_what_it_draws() -> None:
    np.testing.assert_allclose(circle().position(np.array([0.0, 5 * np.pi])), [[0, 1], [1, 0]], atol=1e-12)
    np.testing.assert_allclose(eight().position(np.array([0.0, 2.5 * np.pi])), [[0, 0], [math.sin(math.pi / 4), 1]], atol=1e-12)


def test_positioning_rests_without_a_jump_at_the_papers_goal() -> None:
    stop = 5 * math.pi
    goal = [-0.4 * math.sqrt(2), -0.2 * math.sqrt(2)]
    trajectory = positioning()
    np.testing.assert_allclose(trajectory.position(np.array([stop - 1e-9, stop, 60.0])), [goal] * 3, atol=1e-9)
    np.testing.assert_array_equal(trajectory.velocity(np.array([stop, 60.0])), np.zeros((2, 2)))
    assert trajectory.end is End.HOLD


@pytest.mark.parametrize("build", [circle, eight, positioning, square, zigzag])
@pytest.mark.parametrize("heading", HEADINGS)
def test_headings_never_jump(build, heading) -> None:
    """Even where they cross pi, lap after lap."""
    y = rows(build().lasting(140.0), 0.02, heading)
    assert y.shape == (7001, 3)
    assert y.flags.c_contiguous
    assert np.abs(np.diff(y[:, 2])).max() < 0.05


def test_headings_go_on_turning_with_the_laps() -> None:
    y = rows(circle().lasting(3 * circle().lap_s), 0.1, "tangent")
    assert y[-1, 2] - y[0, 2] == pytest.approx(-6 * math.pi, abs=0.02)


@pytest.mark.parametrize("build", [circle, eight, square])
def test_consistent_heading_of_a_closed_curve_repeats_every_lap(build) -> None:
    trajectory = build()
    period_s = trajectory.lap_s / 1000
    y = rows(trajectory.lasting(2 * trajectory.lap_s), period_s, "consistent", A)
    turn = y[1000:2000, 2] - y[:1000, 2]
    np.testing.assert_allclose(turn, 2 * np.pi * np.round(turn[0] / (2 * np.pi)), atol=1e-9)


@pytest.mark.parametrize("build", [circle, eight, square])
def test_consistent_heading_satisfies_its_differential_equation(build) -> None:
    trajectory = build()
    h = 1e-3
    y = rows(trajectory.lasting(20.0), h, "consistent", A)
    t = h * np.arange(1, len(y) - 1)
    v = trajectory.velocity(t)
    psi = y[1:-1, 2]
    np.testing.assert_allclose((y[2:, 2] - y[:-2, 2]) / (2 * h), (-v[:, 0] * np.sin(psi) + v[:, 1] * np.cos(psi)) / A, atol=2e-3)


@pytest.mark.parametrize("build", [circle, eight, positioning, square])
def test_point_ahead_of_the_axle_follows_its_path_exactly_with_the_consistent_heading(build) -> None:
    """Speeds computed from path and heading alone drive the unicycle of equation (9) along both."""
    from scipy.integrate import solve_ivp

    trajectory = build().lasting(15.0)
    y = rows(trajectory, 0.01, "consistent", A)

    def kinematics(t: float, x: Array) -> Array:
        psi = np.interp(t, 0.01 * np.arange(len(y)), y[:, 2])
        v_x, v_y = trajectory.velocity(np.array(t))
        u, omega = v_x * np.cos(psi) + v_y * np.sin(psi), (-v_x * np.sin(psi) + v_y * np.cos(psi)) / A
        return np.array([u * np.cos(x[2]) - A * omega * np.sin(x[2]), u * np.sin(x[2]) + A * omega * np.cos(x[2]), omega])

    solution = solve_ivp(kinematics, (0.0, 15.0), y[0], t_eval=0.01 * np.arange(len(y)), max_step=0.02)
    np.testing.assert_allclose(solution.y.T, y, atol=1e-4)


def test_consistent_heading_of_an_open_path_starts_where_it_is_told() -> None:
    assert rows(positioning(), 0.1, "consistent", A, psi0=7 * math.pi / 6)[0, 2] == pytest.approx(7 * math.pi / 6)
    assert rows(positioning(), 0.1, "consistent", A)[0, 2] == pytest.approx(rows(positioning(), 0.1, "tangent")[0, 2])


@pytest.mark.parametrize("heading", HEADINGS)
@pytest.mark.parametrize("build", [positioning, zigzag])
def test_heading_stays_put_where_the_trajectory_rests(build, heading) -> None:
    y = rows(build().lasting(60.0), 0.1, heading)
    assert np.ptp(y[250:], axis=0) == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)


def test_a_path_that_never_moves_has_heading_zero() -> None:
    still = Trajectory("still", lambda t: np.zeros((*np.shape(t), 2)), lambda t: np.zeros((*np.shape(t), 2)), 1.0, End.HOLD, (0.0, 0.0, 0.0))
    np.testing.assert_array_equal(rows(still, 0.1, "tangent"), np.zeros((11, 3)))


def test_consistent_heading_of_a_circle_leads_into_it_by_the_known_angle() -> None:
    """On a circle of radius R the axle follows a circle of radius sqrt(R^2 - a^2)."""
    y = rows(circle(), 0.1, "consistent", A)
    lead = rows(circle(), 0.1, "tangent")[:, 2] - y[:, 2]
    np.testing.assert_allclose(np.abs(np.remainder(lead + np.pi, 2 * np.pi) - np.pi), math.asin(A), atol=1e-9)


def test_circle_narrower_than_the_point_is_ahead_has_no_consistent_heading() -> None:
    def velocity(t: Array) -> Array:
        return 0.1 * np.stack([np.cos(t), -np.sin(t)], axis=-1)

    with pytest.raises(OcpError, match="wide enough"):
        periodic(velocity, 2 * math.pi, 0.3, 0.0)


def test_consistent_heading_forgets_a_wrong_start() -> None:
    t = np.linspace(0.0, 62.8, 629)
    spread = consistent(eight().velocity, t, A, 0.3) - consistent(eight().velocity, t, A, -1.0)
    assert abs(math.remainder(spread[-1], math.tau)) < 1e-9


def test_scenarios_start_where_the_papers_robot_does() -> None:
    assert {name: build().pose0 for name, build in SCENARIOS.items()} == {
        "eight": (0.5, 0.0, 0.0),
        "circle": (0.5, 0.0, 0.0),
        "positioning": (1.4, 0.9, 7 * math.pi / 6),
    }


def test_waypoints_are_followed_at_the_speed_asked_for() -> None:
    trajectory = waypoints(ZIGZAG, speed_m_s=0.4)
    speed = np.linalg.norm(trajectory.velocity(np.linspace(0.0, trajectory.duration_s - 1e-6, 1000)), axis=1)
    np.testing.assert_allclose(speed, 0.4, rtol=1e-12)


def test_open_waypoints_begin_and_end_at_their_points() -> None:
    trajectory = zigzag()
    np.testing.assert_allclose(trajectory.position(np.array([0.0, trajectory.duration_s, 1e3])), ZIGZAG[[0, -1, -1]], atol=1e-12)
    assert trajectory.end is End.HOLD


@pytest.mark.parametrize("heading", HEADINGS)
@pytest.mark.parametrize("speed_m_s", [0.25, 0.3, 1.0, 3.0, 20.0])
@pytest.mark.parametrize("period_s", [0.05, 0.02, 0.7])
def test_rows_of_an_open_path_end_at_its_last_point_whatever_the_speed(speed_m_s: float, period_s: float, heading: Heading) -> None:
    """Its last row is held for ever; and its heading is the one it was reached with."""
    for length in (1.0, 2.0, 3.33, 10.0):
        y = rows(waypoints(np.array([[0.0, 0.0], [0.0, length]]), speed_m_s), period_s, heading)
        np.testing.assert_allclose(y[-1], [0.0, length, np.pi / 2], atol=1e-9)
        assert y[-2, 1] < length, "and no row more than that"


@pytest.mark.parametrize("build", [*SCENARIOS.values(), square])
@pytest.mark.parametrize("duration_s", [0.03, 2.0, 10.01, 0.3 + 1e-12])
def test_rows_last_for_the_whole_duration_and_less_than_a_period_longer(build: Callable[[], Trajectory], duration_s: float) -> None:
    y = rows(build().lasting(duration_s), 0.1, "tangent")
    assert duration_s - 1e-9 <= 0.1 * (len(y) - 1) < duration_s + 0.1 - 1e-9
    np.testing.assert_allclose(y[:, :2], build().position(0.1 * np.arange(len(y))))


@pytest.mark.parametrize("corner_m", [0.0, 0.02, 0.15])
def test_rounded_corners_pass_each_waypoint_within_the_distance_asked_for(corner_m: float) -> None:
    for points in (ZIGZAG, SQUARE):
        trajectory = waypoints(points, corner_m=corner_m)
        path = trajectory.position(np.linspace(0.0, trajectory.duration_s, 200_001))
        for corner in points[1:-1]:
            assert np.linalg.norm(path - corner, axis=1).min() == pytest.approx(corner_m, abs=1e-3)


def test_corners_never_eat_more_than_half_an_edge() -> None:
    trajectory = waypoints(ZIGZAG, corner_m=100.0)
    t = np.linspace(0.0, trajectory.duration_s, 20_001)
    for middle in 0.5 * (ZIGZAG[1:-2] + ZIGZAG[2:-1]):
        assert np.linalg.norm(trajectory.position(t) - middle, axis=1).min() < 1e-3


def test_closely_sampled_curve_stays_in_place_and_becomes_smooth() -> None:
    angle = np.linspace(0.0, 2 * np.pi, 101)
    trajectory = waypoints(np.column_stack([np.cos(angle), np.append(np.sin(angle[:-1]), 0.0)]))
    path = trajectory.position(np.linspace(0.0, trajectory.duration_s, 5001))
    np.testing.assert_allclose(np.linalg.norm(path, axis=1), 1.0, atol=1e-3)


def test_way_back_turns_at_the_waypoint_itself() -> None:
    there_and_back = waypoints(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]), speed_m_s=0.5)
    np.testing.assert_allclose(there_and_back.position(np.array([0.0, 2.0, 4.0])), [[0, 0], [1, 0], [0, 0]], atol=1e-12)


def test_repeated_points_count_once() -> None:
    np.testing.assert_array_equal(waypoints(np.repeat(ZIGZAG, 3, axis=0)).position(3.0), zigzag().position(3.0))


@pytest.mark.parametrize(
    ("points", "sentence"),
    [([[1.0, 1.0]], "two distinct"), ([[1.0, 1.0]] * 3, "two distinct"), ([[0.0, np.nan], [1.0, 1.0]], "finite"), ([1.0, 2.0], "shape")],
)
def test_points_that_make_no_path_are_refused(points, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        waypoints(np.array(points))


def test_missing_csv_and_unknown_scenario_are_refused_with_what_would_be_right(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.csv"):
        find_trajectory(str(tmp_path / "nowhere.csv"))
    with pytest.raises(ConfigError, match=r"eight, circle, positioning or a FILE\.csv"):
        find_trajectory("figure-eight")


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_periods_durations_and_speeds_must_be_positive(value: float) -> None:
    for call in (lambda: rows(eight(), value), lambda: eight().lasting(value), lambda: waypoints(ZIGZAG, value), lambda: rows(eight(), 0.1, a=value)):
        with pytest.raises(ConfigError, match="above 0"):
            call()


def test_rows_have_a_column_a_role_in_its_order() -> None:
    whole, turned = rows(eight(), 0.1), rows(eight(), 0.1, roles=("heading", "x", "y"))
    np.testing.assert_array_equal(turned, whole[:, [2, 0, 1]])
    np.testing.assert_array_equal(rows(eight(), 0.1, roles=("x", "y")), whole[:, :2])


def test_consistent_heading_of_a_point_on_the_axle_is_the_tangent() -> None:
    np.testing.assert_array_equal(rows(eight(), 0.1, "consistent", None), rows(eight(), 0.1, "tangent"))


def test_outputs_that_no_path_fills_are_refused_by_name() -> None:
    outputs = (Signal("x", "m", role="x"), Signal("v", "m/s"), Signal("elbow", "rad", angle=True))
    with pytest.raises(ConfigError, match=r"model crane: .* not v, elbow: give each its role"):
        followed_roles("crane", outputs)
