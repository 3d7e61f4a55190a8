# SPDX-License-Identifier: Apache-2.0
"""A quadrotor whose attitude is a quaternion, as a service: whatever sign it is measured, referred or planned with, it is one attitude."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import Command, End, Reference, State
from rti_mpc.contract.status import Mode
from rti_mpc.contract.way import Way
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.observer import Disturbance, Observer, ObserverSettings
from rti_mpc.control.track import Track
from rti_mpc.errors import OcpError, RtiMpcError
from rti_mpc.model.robots.quadrotor_quaternion import quadrotor_quaternion
from rti_mpc.reference.manoeuvres import turning_flight
from rti_mpc.rti.nominal import nominal_state
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.operation import states_of_operation
from rti_mpc.rti.rest import find_stop_law
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.terminal import lqr_weight
from rti_mpc.rti.way_to_rest import StopLaw, WayToRest
from rti_mpc_service.config.config import load
from rti_mpc_service.shipped import ROBOTS
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, drive

ATTITUDE = slice(3, 7)
SPEEDS = [3.0, 3.0, 2.0, 2.0, 2.0, 2.0]


@cache
def hummingbird() -> Ocp:
    """Its problem with a horizon of half a second in coarser stages than the one that ships."""
    free = 4 * [np.inf]
    ubx = np.array([*free, 0.25, 0.25, np.inf, *SPEEDS])
    return Ocp(
        quadrotor_quaternion(), N=12, dt=0.04, Q=[1, 1, 1, 0, 0.1, 0.1, 0.1], R=[0.002] * 4, lbu=0, ubu=6, lbdu=-3, ubdu=3, lbx=-ubx, ubx=ubx
    )  # fmt: skip


@cache
def law() -> StopLaw:
    """What its way to rest is made with; rates and ranges as `find_stop_law` finds them, in round numbers."""
    rates = np.array([3.0, 3.0, 2.0, 1.5, 1.2, 1.2, 0.9, 17.0, 17.0, 17.0, 150.0, 150.0, 16.0])
    scale_x = np.array([1.0, 1.0, 1.0, 0.5, 0.25, 0.25, 1.0, *SPEEDS])
    return StopLaw(122, 100, 0.04, 1, 0.1, rates, scale_x, np.full(4, 3.0))


def flight(*, signs: bool) -> Reference:
    """Turns while flying; with rows of either sign, or without jumps."""
    y = turning_flight(0.02 * np.arange(300))
    hummingbird().model.rotations("outputs").unwrap(y)
    if signs:
        y[:, ATTITUDE] *= np.random.default_rng(3).choice([-1.0, 1.0], (len(y), 1))
    return Reference(1, 1, 0, 20 * MS, End.HOLD, y, np.zeros((len(y), 0)))


def flown(reference: Reference, seed: int | None) -> list[Command]:
    """Commands of two seconds of flight to states whose attitudes are of either sign, or as the robot sends them."""
    rng = np.random.default_rng(seed)
    ocp = hummingbird()
    controller = Controller(Rti(ocp, compile=False), Timing(), compile=False)
    controller.receive_reference(reference)
    settings: dict[str, Any] = {"slew": np.full(4, 75.0), "lbu": ocp.lbu, "ubu": ocp.ubu, "state_period_s": ocp.dt}
    body = Lockstep(RobotSettings(ocp.model, np.array([0, 0, 1, 1] + [0] * 9, dtype=float), **settings))

    def measured(state: State) -> State:
        x = state.x.copy()
        x[ATTITUDE] *= 1.0 if seed is None else rng.choice([-1.0, 1.0])
        return replace(state, x=x)

    run = drive(controller, body, 2.0, sees=measured)
    assert controller.mode is Mode.TRACKING
    return run.commands


def test_commands_are_the_same_bit_for_bit_whatever_signs_states_and_reference_have() -> None:
    plain = flown(flight(signs=False), None)
    assert len(plain) > 40
    for commands in (flown(flight(signs=False), 1), flown(flight(signs=True), 2)):
        assert len(commands) == len(plain)
        for a, b in zip(commands, plain, strict=True):
            np.testing.assert_array_equal(a.u, b.u)


def test_state_whose_attitude_was_never_measured_is_refused_by_name_and_the_next_one_is_not() -> None:
    ocp = hummingbird()
    controller = Controller(Rti(ocp, compile=False), Timing(), compile=False)
    controller.receive_reference(flight(signs=False))
    hovering = np.array([0, 0, 1, 1] + [0] * 9, dtype=float)
    unwritten = np.where(np.arange(13) == 3, 0.0, hovering)
    assert controller.receive_state(State(1, 1, 0, unwritten), 0) is None
    (notice,) = [notice for notice in controller.notices() if notice.code == "state_refused"]
    assert notice.text == "a state is refused: a quaternion must have length 1, got [0.0, 0.0, 0.0, 0.0]"
    assert controller.mode is Mode.IDLE
    controller.receive_state(State(1, 2, 40 * MS, hovering), 40 * MS)
    assert controller.mode is Mode.WAITING


def test_way_to_rest_is_corrected_alike_by_both_signs_of_the_measured_attitude() -> None:
    rng = np.random.default_rng(1)
    rotations = hummingbird().model.rotations("states")
    states = rng.normal(size=(3, 13))
    states[:, ATTITUDE] = [[0.9, 0.1, 0.0, 0.42], [-0.8, 0.0, -0.1, -0.6], [0.6, 0.0, 0.0, 0.8]]  # its rows are of either sign, too
    states[:, ATTITUDE] /= np.linalg.norm(states[:, ATTITUDE], axis=1, keepdims=True)
    way = Way(0, 100 * MS, np.zeros((3, 4)), states, rng.normal(size=(4, 13)), np.zeros(4))
    x = states[0] + 0.01 * rng.normal(size=13)
    other = x.copy()
    other[ATTITUDE] *= -1.0
    for t_ms in (0, 50, 130):
        corrections = [way.corrected(state, t_ms * MS, rotations).correction for state in (x, other)]
        np.testing.assert_array_equal(*corrections)
    np.testing.assert_allclose(way.corrected(other, 0, rotations).correction, -way.K @ (x - states[0]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("yaw", [0.0, 1.0, 3.0])
def test_regulators_do_not_feed_the_length_of_an_attitude_back_and_turn_with_the_body(yaw: float) -> None:
    way = WayToRest(hummingbird(), law(), compile=False)
    x = np.array([0, 0, 1, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)] + [0] * 6, dtype=float)
    assert way.aim(x, np.array(hummingbird().model.u_rest))
    np.testing.assert_allclose(way.x_e, x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(way.K[:, ATTITUDE] @ x[ATTITUDE], 0.0, rtol=0, atol=1e-9)
    upright = WayToRest(hummingbird(), law(), compile=False)
    upright.aim(np.array([0, 0, 1, 1] + [0] * 9, dtype=float), np.array(hummingbird().model.u_rest))
    np.testing.assert_allclose(way.K[:, 10:], upright.K[:, 10:], rtol=0, atol=1e-6)  # of body rates, which do not know the yaw


def test_equilibrium_near_a_tilted_state_is_level_of_length_1_and_keeps_the_yaw() -> None:
    way = WayToRest(hummingbird(), law(), compile=False)
    tilted = np.array([1.0, 2.0, 3.0, 0.8, 0.2, -0.15, 0.54, 1, -1, 0.5, 1, 1, -1])
    tilted[ATTITUDE] /= np.linalg.norm(tilted[ATTITUDE])
    assert way.aim(tilted, np.array(hummingbird().model.u_rest))
    q = way.x_e[ATTITUDE]
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose([q[1], q[2], *way.x_e[7:]], 0.0, rtol=0, atol=1e-6)
    assert 2 * np.arctan2(q[3], q[0]) == pytest.approx(2 * np.arctan2(0.54, 0.8), abs=0.1)


@pytest.mark.slow
def test_robot_comes_to_rest_from_every_attitude_inside_its_bounds() -> None:
    found = find_stop_law(hummingbird())
    assert found is not None
    assert not found.holds


def test_terminal_weight_does_not_depend_on_the_yaw_nor_on_the_sign() -> None:
    ocp = hummingbird()
    hovering = np.array(ocp.model.u_rest)
    weights = []
    for yaw, sign in ((0.0, 1.0), (2.0, 1.0), (2.0, -1.0)):
        x = np.array([0, 0, 1, sign * np.cos(yaw / 2), 0, 0, sign * np.sin(yaw / 2)] + [0] * 6, dtype=float)
        weights.append(np.diag(lqr_weight(ocp, x, hovering)))
    np.testing.assert_allclose(weights[1:], [weights[0]] * 2, rtol=1e-6, atol=1e-9)
    assert weights[0][3] == 0.0, "that of w"
    assert np.delete(weights[0], 3).min() > 0.0


def test_states_of_operation_are_attitudes_inside_the_bounds() -> None:
    ocp = hummingbird()
    states, _ = states_of_operation(ocp, 60)
    np.testing.assert_allclose(np.linalg.norm(states[:, ATTITUDE], axis=1), 1.0, rtol=0, atol=1e-12)
    assert np.abs(states[:, 4:6]).max() <= 0.25
    np.testing.assert_array_equal(nominal_state(ocp)[ATTITUDE], [1.0, 0.0, 0.0, 0.0])


def test_nominal_state_must_have_an_attitude() -> None:
    model = replace(quadrotor_quaternion(), x_nominal=(0.0,) * 13)
    with pytest.raises(OcpError, match=r"x_nominal must be a state of model quadrotor_quaternion: a quaternion must have length 1, got \[0\.0"):
        nominal_state(Ocp(model, N=2, dt=0.1, Q=[1] * 7, R=[1] * 4))


def test_reference_of_either_sign_is_interpolated_between_attitudes_that_are_near() -> None:
    looked_up = []
    for signs in (False, True):
        track = Track(hummingbird().model, 5, 30 * MS, compile=False)
        reference = flight(signs=signs)
        track.arriving = reference, track.lay_out(reference)
        track.anchor(0)
        track.look_up(10 * MS)
        looked_up.append(track.y_ref.copy())
    sign = np.sign(looked_up[0][0, 3] * looked_up[1][0, 3])
    looked_up[1][:, ATTITUDE] *= sign
    np.testing.assert_allclose(looked_up[1], looked_up[0], rtol=0, atol=1e-12)


def test_estimate_keeps_the_length_of_an_attitude_which_must_be_measured_as_a_whole() -> None:
    wind = {"v_x": Disturbance(drift=0.1, limit=1.0)}
    observer = Observer(quadrotor_quaternion(), ObserverSettings(wind), compile=False)
    x = np.array([0, 0, 1, 1] + [0] * 9, dtype=float)
    observer.reset(x)
    rng = np.random.default_rng(1)
    for _ in range(20):
        observer.predict(np.array(hummingbird().model.u_rest), 0.04)
        measured = x + 0.02 * rng.normal(size=13)
        hummingbird().model.rotations("states").normalize(measured)
        observer.correct(measured)
        assert np.linalg.norm(observer.x[ATTITUDE]) == pytest.approx(1.0, abs=1e-12)
    with pytest.raises(OcpError, match="measured must have all of a quaternion, q_w, q_x, q_y, q_z, got x, q_w"):
        Observer(quadrotor_quaternion(), ObserverSettings(wind, ("x", "q_w")), compile=False)


@pytest.mark.parametrize(
    ("bounds", "said"),
    [
        ({"lbx": -0.3, "ubx": 0.5}, "bounds of state {} of a quaternion must be as far from 0 on both sides, such as [-0.3, 0.3], "),
        ({"ubx": 0.5}, "since q and -q are one attitude, got [-inf, 0.5]"),
        ({"lbx": [-0.5, -0.5, -0.4], "ubx": [0.5] * 3}, "such as [-0.4, 0.4], since q and -q are one attitude, got [-0.4, 0.5]"),
        ({"lbx_e": -0.1, "ubx_e": 0.2}, "terminal bounds of state {} of a quaternion must be as far from 0 on both sides, such as [-0.1, 0.1]"),
    ],
)
@pytest.mark.parametrize("name", ["q_w", "q_x", "q_z"])
def test_bounds_that_an_attitude_keeps_with_one_sign_and_breaks_with_the_other_are_refused(name: str, bounds: dict[str, Any], said: str) -> None:
    model, N = quadrotor_quaternion(), 3
    j = [state.name for state in model.states].index(name)
    symmetric = Ocp(model, N=N, dt=0.04, Q=[1, 1, 1, 0, 0.1, 0.1, 0.1], R=[0.002] * 4, lbu=0, ubu=6, lbx=-0.5, ubx=0.5, lbx_e=-0.2, ubx_e=0.2)
    changed = {key: np.full((N, 13) if np.ndim(bound) else 13, np.inf if key.startswith("u") else -np.inf) for key, bound in bounds.items()}
    for key, bound in bounds.items():
        changed[key][..., j] = bound
    free = {"lbx": -np.inf, "ubx": np.inf, "lbx_e": -np.inf, "ubx_e": np.inf}
    for make in (lambda **values: replace(symmetric, **values), symmetric.retuned):
        with pytest.raises(OcpError, match=re.escape(said.format(name))):
            make(**{**free, **changed})


def test_file_whose_bounds_an_attitude_breaks_with_the_other_sign_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    text = ROBOTS["quadrotor_quaternion"].read_text()
    assert re.search(r"q_x = \[[^]]*\]", text)
    path.write_text(re.sub(r"q_x = \[[^]]*\]", "q_x = [-0.2, 0.3]", text, count=1))
    with pytest.raises(RtiMpcError, match=r"bounds of state q_x of a quaternion must be as far from 0 on both sides, such as \[-0\.2, 0\.2\]"):
        load(path)
