# SPDX-License-Identifier: Apache-2.0
"""Tests of path following: the augmented model, its geometry, and robots that follow short paths."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.errors import ConfigError, OcpError
from rti_mpc.model.model import Model, Signal
from rti_mpc.model.path_following import KNOTS, path_following, window_place, with_drift
from rti_mpc.model.robots.dynamic_bicycle import dynamic_bicycle
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.path import Path, pieces, smooth_path
from rti_mpc.reference.path_source import PathSource
from rti_mpc.reference.speed_profile import SpeedLimits
from rti_mpc.reference.tracks import track
from rti_mpc.rti.construction import FORMULATIONS
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import BUILT_IN_SOLVERS, Rti
from rti_mpc.rti.simulation import Simulation, simulate
from tests.slow import slow_but

LIMITS = SpeedLimits(speed=1.5, lateral=1.0, acceleration=1.0, braking=1.0)
FREE = np.inf


def car() -> Model:
    """A kinematic bicycle that drives either way."""
    x, u = ca.SX.sym("x", 5), ca.SX.sym("u", 2)
    pose = (Signal("x", "m", role="x"), Signal("y", "m", role="y"), Signal("psi", "rad", angle=True, role="heading"))
    psi, v, delta = x[2], x[3], x[4]
    return Model(
        name="car",
        x=x,
        u=u,
        f_expl_expr=ca.vertcat(v * ca.cos(psi), v * ca.sin(psi), v * ca.tan(delta) / 0.3, (u[0] - v) / 0.1, (u[1] - delta) / 0.1),
        y_expr=x[:3],
        states=(*pose, Signal("v", "m/s"), Signal("delta", "rad")),
        inputs=(Signal("v_c", "m/s", commands="v"), Signal("delta_c", "rad", commands="delta")),
        outputs=pose,
    )


def source(model: Model, *parts: Path) -> PathSource:
    return PathSource(parts, model.p_nominal, *window_place(model) or (0, 0))


def followed(parts: tuple[Path, ...], x0: list[float], samples: int, *, contour: float = 5.0, edges: float = 0.0, **changes: Any) -> Simulation:
    """The car follows a path from rest, without a compiler."""
    model = path_following(car())
    ocp = Ocp(
        model,
        N=20,
        dt=0.05,
        Q=[contour, 50.0, 1.0],
        R=[0.05, 0.05, 0.05],
        lbu=[-2.0, -0.5, 0.0],
        ubu=[2.0, 0.5, 2.0],
        h_expr=model.h_expr[:2, 0],
        **{"lh": edges} | changes,
    )
    around = source(model, *parts)
    return simulate(
        Rti(ocp, compile=False),
        ocp.phi(),
        lambda t: np.zeros((len(t), 3)),
        x0=[*x0, 0.0, 0.0],
        samples=samples,
        parameters=lambda x: around.parameters(x[-2], x[-1]),
    )


def test_augmented_model_has_progress_and_pace_behind_its_own_states() -> None:
    model = path_following(dynamic_bicycle())
    assert [state.name for state in model.states][-2:] == ["progress", "pace"]
    assert [signal.name for signal in model.inputs] == ["a", "omega_delta", "pace_c"]
    assert [signal.name for signal in model.outputs] == ["contour", "lag", "pace_error"]
    assert [signal.name for signal in model.constraints] == ["alpha_f", "alpha_r", "left", "right", "lateral_acceleration"]
    assert window_place(model) == (len(dynamic_bicycle().parameters), KNOTS)
    assert window_place(dynamic_bicycle()) is None


@pytest.mark.parametrize("at", [0.0, 7.3, 31.0, 90.0])
def test_outputs_and_edges_are_those_of_the_path(at: float) -> None:
    path = replace(track("hairpin").limited(LIMITS), right=np.full(111, 0.6))
    model = path_following(car())
    p = source(model, path).parameters(at)
    point, tangent = path.position(np.array(at)), path.tangent(np.array(at))
    normal = np.array([-tangent[1], tangent[0]])
    x = np.array([*(point + 0.2 * normal + 0.05 * tangent), 0.3, 1.2, 0.1, at, 0.9])
    contour, lag, pace_error = np.array(model.h()(x, p)).ravel()
    speed = float(path.at(path.speed, np.array(at)))
    assert (contour, lag) == (pytest.approx(0.2, abs=1e-9), pytest.approx(0.05, abs=1e-9))
    assert pace_error == pytest.approx(0.9 - speed, abs=1e-9)
    h = ca.Function("h", [model.x, model.u, model.p], [model.h_expr])
    left, right, lateral = np.array(h(x, np.zeros(3), p)).ravel()
    assert left == pytest.approx(0.75 - 0.2, abs=1e-9)
    assert right == pytest.approx(0.6 + 0.2, abs=1e-9)
    assert lateral == pytest.approx(1.2**2 * np.tan(0.1) / 0.3, rel=1e-9)


def test_dynamics_do_not_contain_the_path() -> None:
    model = path_following(car())
    assert not ca.depends_on(model.f_expl_expr, model.p)


def test_model_without_position_or_in_discrete_time_is_refused() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    tank = Model(name="tank", x=x, u=u, f_expl_expr=u - x, y_expr=x, states=("level",), inputs=("flow",), outputs=("level",))
    with pytest.raises(OcpError, match=r"model tank: two states must be a position, with role x and role y, got \['level'\]"):
        path_following(tank)
    with pytest.raises(OcpError, match="knots must be a whole number of at least 6"):
        path_following(pioneer_3dx(), knots=3)
    with pytest.raises(OcpError, match="lag_s must be a positive number of seconds, got 0"):
        path_following(pioneer_3dx(), lag_s=0.0)


def test_closed_piece_before_another_is_refused() -> None:
    model = path_following(car())
    with pytest.raises(ConfigError, match="only the last may be closed"):
        source(model, track("oval"), track("oval"))


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("left", [0.1, -FREE])
def test_constraints_without_bounds_are_left_alone(left: float, formulation: str) -> None:
    """Also if none of them has one."""
    ocp = Ocp(path_following(pioneer_3dx()), N=4, dt=0.1, Q=[1, 1, 1], R=[1, 1, 1], lbu=-0.5, ubu=0.5, lh=[left, -FREE, -FREE])
    for solver in BUILT_IN_SOLVERS:
        rti = Rti(ocp, formulation=formulation, solver=solver, compile=False)
        rti.prepare(np.zeros((4, 3)))
        assert rti.feedback(np.zeros(7)).usable
        assert rti.violation == 0.0


def test_car_follows_a_straight_at_the_speed_of_its_profile_and_rests_at_the_end() -> None:
    path = smooth_path(np.array([[0.0, 0.0], [6.0, 0.0]])).limited(LIMITS)
    run = followed((path,), [0.0, 0.2, 0.0, 0.0, 0.0], 160)
    assert run.x[:, 3].max() == pytest.approx(LIMITS.speed, abs=0.1)
    np.testing.assert_allclose(run.x[-1, :4], [6.0, 0.0, 0.0, 0.0], atol=0.05)  # m, rad and m/s


def test_edges_of_a_track_that_narrows_lead_in_a_car_without_weight_on_the_contour() -> None:
    points = np.column_stack([np.linspace(0.0, 6.0, 25), np.zeros(25)])
    path = smooth_path(points, left=np.where(points[:, 0] < 2.5, 1.0, 0.3)).limited(LIMITS)
    free, kept = (followed((path,), [0.0, 0.5, 0.0, 0.0, 0.0], 100, contour=0.0, edges=edges).x for edges in (-5.0, 0.1))
    narrow = kept[:, 0] > 3.0
    assert free[free[:, 0] > 3.0, 1].min() > 0.4  # m to the left
    assert kept[narrow].size and kept[narrow, 1].max() < 0.21  # 0.3 less 0.1, and a centimetre between nodes


def changes_of_iterates(model: Model, Q: list[float], speed: float) -> Array:
    """Return by how much each step changes the steering rate, rad/s: a race car begins beside a straight, by 1 nm, far below its profile."""
    path = smooth_path(np.array([[0.0, 0.0], [60.0, 0.0]])).limited(SpeedLimits(speed=7.0, lateral=5.0, acceleration=40.0, braking=40.0))
    steering = {"lbx": [-FREE] * 6 + [-0.42, -FREE, -FREE], "ubx": [FREE] * 6 + [0.42, FREE, FREE]}
    rti = Rti(Ocp(model, N=40, dt=0.02, Q=Q, R=[0.02] * 3, lbu=[-6, -6, 0], ubu=[5, 6, 9], **steering), compile=False, iterations=1)
    x0 = np.array([5.0, 1e-9, 0.0, speed, 0.0, 0.0, 0.0, 5.0, speed])
    rti.reset(x0, np.zeros(3))
    p = np.tile(source(model, path).parameters(5.0), (41, 1))
    found = []
    for _ in range(20):
        before = rti.u.copy()
        rti.prepare(np.zeros((40, model.ny)), p, shift=False)
        rti.feedback(x0)
        found.append(float(np.abs(rti.u - before)[:, 1].max()))
    return np.array(found)


@pytest.mark.parametrize("speed", slow_but([0.0, 1.0, 3.0], 0.0))
def test_steps_of_a_car_below_its_profile_converge_where_its_drift_has_a_weight(speed: float) -> None:
    """Without, steering that costs progress in second order alone goes too far in each step, from rounding on to its bounds; also at 3 m/s."""
    model = path_following(dynamic_bicycle())
    assert changes_of_iterates(model, [0.02, 20.0, 4.0], speed)[-5:].max() > 1.0  # rad/s, of 6
    assert changes_of_iterates(with_drift(model), [0.02, 20.0, 4.0, 8.0], speed)[-5:].max() < 1e-6  # of rounding


def test_drift_is_the_velocity_to_the_left_of_the_path() -> None:
    path = track("hairpin").limited(LIMITS)
    model = with_drift(path_following(car()))
    p = source(model, path).parameters(7.3)
    tangent = path.tangent(np.array(7.3))
    x = np.array([0.0, 0.0, np.arctan2(tangent[1], tangent[0]) + 0.3, 1.2, 0.1, 7.3, 0.9])
    assert float(model.h()(x, p)[3]) == pytest.approx(1.2 * np.sin(0.3), abs=1e-9)
    assert model.outputs[3] == Signal("drift", "m/s")
    with pytest.raises(OcpError, match="model car must be made by path_following to have a drift"):
        with_drift(car())


def reversing() -> tuple[Path, ...]:
    """Forwards along a quarter of a circle, then backwards along another: a turn in three points, of which these are two."""
    turn = np.linspace(0.0, np.pi / 2, 25)
    forwards = 1.5 * np.column_stack([np.sin(turn), 1.0 - np.cos(turn)])
    backwards = forwards[-1] + 1.5 * np.column_stack([np.cos(turn) - 1.0, -np.sin(turn)]) * [-1.0, 1.0]
    return tuple(piece.limited(LIMITS) for piece in pieces(np.vstack([forwards, backwards[1:]])))


@pytest.mark.slow
def test_car_drives_to_a_cusp_and_on_backwards() -> None:
    parts = reversing()
    assert len(parts) == 2
    run = followed(parts, [0.0, 0.0, 0.0, 0.0, 0.0], 200)
    assert run.x[:, 3].max() > 0.5  # m/s, forwards
    assert run.x[:, 3].min() < -0.5  # backwards
    end: Array = parts[1].position(np.array(parts[1].length))
    assert np.hypot(*(run.x[-1, :2] - end)) < 0.05
    assert run.x[-1, -2] == pytest.approx(sum(part.length for part in parts), abs=0.05)
    first, second = (max(abs(part.offset(point)[1]) for point in run.x[rows, :2]) for part, rows in zip(parts, on_pieces(run, parts), strict=True))
    assert max(first, second) < 0.05  # m beside the path; the steering turns by a radian at the cusp
    assert np.abs(run.x[-1, 3]) < 0.05


def on_pieces(run: Simulation, parts: tuple[Path, ...]) -> tuple[slice, slice]:
    """Return the samples on either piece."""
    cusp = int(np.argmax(run.x[:, -2] > parts[0].length))
    return slice(0, cusp), slice(cusp, None)


def test_progress_counts_on_from_piece_to_piece_once_the_robot_rests() -> None:
    model, parts = path_following(car()), reversing()
    around = source(model, *parts)
    end = parts[0].length
    around.parameters(end - 0.01, 0.5)
    assert around.piece == 0
    around.parameters(end - 0.01, 0.02)
    assert (around.piece, around.passed_m) == (1, end)
