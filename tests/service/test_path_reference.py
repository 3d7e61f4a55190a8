# SPDX-License-Identifier: Apache-2.0
"""Tests of the source of a path: references around a robot, in lockstep with a controller; and what it refuses."""

from __future__ import annotations

from pathlib import Path as File

import numpy as np
import pytest

from rti_mpc.contract.message import End, State
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.errors import ConfigError
from rti_mpc.model.model import Model
from rti_mpc.model.path_following import path_following
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.path import Path, smooth_path
from rti_mpc.reference.speed_profile import SpeedLimits
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc_service.path_reference import LASTS_NS, PERIOD_NS, PathReferences, find_path
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import Run, drive

LIMITS = SpeedLimits(speed=0.4, lateral=0.3, acceleration=0.3, braking=0.3)
SLEW = np.array([2.5, 4.0, 2.5])  # 1/s


def controller(model: Model) -> Controller:
    bounds = {"lbu": [-0.5, -1.0, 0.0], "ubu": [0.5, 1.0, 0.5], "lbdu": -0.1 * SLEW, "ubdu": 0.1 * SLEW}
    ocp = Ocp(model, N=15, dt=0.1, Q=[5.0, 20.0, 1.0], R=[1.0, 1.0, 0.1], h_expr=model.h_expr[:2, 0], lh=0.1, **bounds)
    return Controller(Rti(ocp, compile=False), Timing(), compile=False)


def driven(path: Path, x0: list[float], duration_s: float, silent_from_s: float = np.inf) -> Run:
    """The paper's robot follows a path that is sent to it in references, with its delays, until these cease."""
    model = path_following(pioneer_3dx())
    control, references = controller(model), PathReferences(model, [path], 1)
    first = True

    def sees(state: State) -> State:
        nonlocal first
        if first:
            references.begin(state.x)
        first = False
        reference = references.answer(state.stamp_ns, state.x)
        if reference is not None and 1e-9 * state.stamp_ns < silent_from_s:
            control.receive_reference(reference)
        return state

    body = Lockstep(RobotSettings(model, np.array([*x0, *[0.0] * 4]), SLEW))
    return drive(control, body, duration_s, sees=sees)


def bend() -> Path:
    return smooth_path(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 1.0], [3.0, 1.0]]), right=0.3, left=0.3).limited(LIMITS)


def test_robot_follows_a_path_from_references_to_its_end_and_rests() -> None:
    path = bend()
    run = driven(path, [0.0, 0.05, 0.0], 16.0)
    x = np.array(run.x)
    assert np.hypot(*(x[-1, :2] - [3.0, 1.0])) < 0.06  # m: the window's speeds fall to zero within its last knots
    assert abs(x[-1, 3]) < 0.02  # m/s
    assert max(abs(path.offset(point)[1]) for point in x[::4, :2]) < 0.2  # m: the edges are 0.3 m away, 0.1 m is kept
    assert not run.refused


def test_robot_whose_path_is_sent_no_more_stops() -> None:
    x = np.array(driven(bend(), [0.0, 0.0, 0.0], 7.0, silent_from_s=3.0).x)
    assert x[:, 3].max() > 0.2  # m/s
    assert abs(x[-1, 3]) < 0.01


def test_path_begins_where_it_is_nearest_to_the_robot_whatever_its_progress_was() -> None:
    model, path = path_following(pioneer_3dx()), bend()
    references = PathReferences(model, [path], 1)
    point = path.position(np.array(1.5))
    x = np.array([*point, 0.0, 0.0, 0.0, 40.0, 0.0])
    references.begin(x)
    reference = references.answer(0, x)
    assert reference is not None
    contour, lag, _ = np.array(model.h()(x, reference.p[0])).ravel()
    assert (contour, lag) == (pytest.approx(0.0, abs=1e-6), pytest.approx(0.0, abs=1e-6))
    assert (reference.period_ns, reference.end, reference.y.any()) == (LASTS_NS, End.STOP, False)


def test_references_are_due_by_the_robots_time_and_again_after_its_clock_was_set_back() -> None:
    references = PathReferences(path_following(pioneer_3dx()), [bend()], 1)
    x = np.zeros(7)
    stamps = [0, PERIOD_NS - 1, PERIOD_NS, PERIOD_NS + 1, 5]
    assert [references.answer(stamp, x) is not None for stamp in stamps] == [True, False, True, False, True]


def test_model_that_follows_no_path_is_refused() -> None:
    with pytest.raises(ConfigError, match="model pioneer_3dx must be made by path_following for --path"):
        PathReferences(pioneer_3dx(), [bend()], 1)


def test_path_is_a_track_that_ships_or_a_file_inside_limits(tmp_path: File) -> None:
    (path,) = find_path("oval", 7.0, SpeedLimits(7.0, 5.0, 4.0, 5.0))
    assert 4.0 < path.speed.min() < path.speed.max() <= 7.0
    file = tmp_path / "line.csv"
    file.write_text("x,y,v\n0,0,0.2\n1,0,0.2\n2,0,0.2\n3,0.1,0.2\n")
    (line,) = find_path(str(file), 1.0, LIMITS)
    assert line.speed.max() == pytest.approx(0.2)
    with pytest.raises(ConfigError, match=r"--path must be one of hairpin, chicane, oval or a FILE\.csv of a path, got 'moon'"):
        find_path("moon", 1.0, None)
