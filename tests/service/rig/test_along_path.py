# SPDX-License-Identifier: Apache-2.0
"""A drive along a path, from states made up by hand, whose figures are known."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.model.path_following import path_following
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.path import smooth_path
from rti_mpc_service.rig.along_path import AlongPath

RADIUS_M, RIGHT_M, LEFT_M = 5.0, 0.6, 0.5
POINTS = RADIUS_M * np.array([(np.cos(a), np.sin(a)) for a in np.linspace(0.0, 2 * np.pi, 72, endpoint=False)])
CIRCLE = smooth_path(np.vstack([POINTS, POINTS[:1]]), right=RIGHT_M, left=LEFT_M)
MODEL = path_following(pioneer_3dx())


def drive(turns: float, aside_m: float, lap_s: float = 20.0) -> AlongPath:
    """Drive around a circle, counter-clockwise, aside to the left of it, from a tenth of a turn on; its progress begins at 7 m."""
    angle = 2 * np.pi * np.linspace(0.1, 0.1 + turns, 400)
    t = lap_s / (2 * np.pi) * (angle - angle[0])
    position = (RADIUS_M - aside_m) * np.column_stack([np.cos(angle), np.sin(angle)])
    still = 0.0 * t
    progress = 7.0 + CIRCLE.length * t / lap_s
    return AlongPath.of(MODEL, [CIRCLE], t, np.column_stack([position, angle + np.pi / 2, still, still, progress, still + 1.0]))


def test_laps_and_the_distance_to_the_edges_are_those_that_were_driven() -> None:
    along = drive(turns=2.5, aside_m=0.2)
    told = along.summary()
    assert told["driven_m"] == pytest.approx(2.5 * 2 * np.pi * RADIUS_M, rel=1e-3)  # of a spline through points of a circle
    assert told["laps_s"] == pytest.approx([20.0, 20.0], rel=1e-6)
    assert along.left == pytest.approx(LEFT_M - 0.2, abs=2e-3)
    assert along.right == pytest.approx(RIGHT_M + 0.2, abs=2e-3)
    assert told["closest_to_edge_mm"] == pytest.approx(300.0, abs=2.0)
    assert np.hypot(*along.point.T) == pytest.approx(RADIUS_M, abs=2e-3)


def test_outputs_of_a_drive_are_those_of_its_path() -> None:
    """Contour: to the left of the path; nothing ahead of it; pace above a profile of 1 m/s."""
    along = drive(turns=1.0, aside_m=0.2)
    x = np.column_stack([along.position, np.zeros((400, 3)), 7.0 + along.driven, np.full(400, 1.5)])
    y = np.array(MODEL.h()(x.T, along.p.T))
    assert y[0] == pytest.approx(0.2, abs=2e-3)
    assert y[1] == pytest.approx(0.0, abs=2e-3)
    assert y[2] == pytest.approx(0.5)


def test_robot_beyond_an_edge_is_told() -> None:
    assert drive(turns=0.5, aside_m=LEFT_M + 0.1).summary()["closest_to_edge_mm"] == pytest.approx(-100.0, abs=2.0)


def test_edges_of_a_circle_are_circles() -> None:
    right, left = (np.hypot(*edge.T) for edge in drive(turns=0.5, aside_m=0.0).edges)
    assert right == pytest.approx(RADIUS_M + RIGHT_M, abs=2e-3)
    assert left == pytest.approx(RADIUS_M - LEFT_M, abs=2e-3)
