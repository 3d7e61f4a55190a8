# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from rti_mpc.errors import MessageError
from rti_mpc.rotation import Rotations
from rti_mpc.wire.info import Info, Label, Leader, Obstacle, bounds, labels, obstacles, parameters
from rti_mpc.wire.received import Received
from rti_mpc_service.config.build import build_ocp
from rti_mpc_service.config.config import load
from rti_mpc_service.description import controller_info
from tests.service.config.test_config import DISC, MINIMAL

PIONEER: dict[str, Any] = {
    "role": "controller",
    "model": "pioneer_3dx",
    "states": [
        {"name": n, "unit": u, "angle": u == "rad", "role": role}
        for n, u, role in [("east", "m", "x"), ("y", "m", "y"), ("turn", "rad", ""), ("psi", "rad", "heading"), ("omega", "rad/s", "")]
    ],
    "inputs": [{"name": "u_c", "unit": "m/s", "angle": False}, {"name": "omega_c", "unit": "rad/s", "angle": False}],
    "outputs": [{"name": "yaw", "unit": "rad", "angle": True, "role": "heading", "state": "psi"}, {"name": "y", "unit": "1", "angle": False}],
    "dt_s": 0.1,
    "lbu": [-0.2, None],
    "ubu": [0.5, None],
    "lbx": [None] * 5,
    "ubx": [None, None, None, 0.5, None],
}


def test_null_bounds_are_the_infinity_of_their_side() -> None:
    info = Info.from_json(PIONEER)
    assert info.lbu == (-0.2, -math.inf)
    assert info.ubu == (0.5, math.inf)
    assert info.ubx[3:] == (0.5, math.inf)


@pytest.mark.parametrize("name", ["delta", "lambda_"])
def test_weights_of_no_stage_are_refused(name: str) -> None:
    said = {"Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[1.0, 0.0], [0.0, 1.0]], "delta": [1.0, 2.0], "lambda_": [3.0]}
    info = Info.from_json({**PIONEER, "weights": said})
    assert info.weights is not None
    assert (info.weights.delta, info.weights.lambda_) == ((1.0, 2.0), (3.0,))
    with pytest.raises(MessageError, match="factors of one stage or more expected"):
        Info.from_json({**PIONEER, "weights": {**said, name: []}})


def test_bounds_that_are_not_said_are_infinite() -> None:
    info = Info.from_json({name: value for name, value in PIONEER.items() if name not in ("lbu", "ubu", "dt_s")})
    assert info.lbu == (-math.inf, -math.inf)
    assert math.isnan(info.dt_s)


def test_rotations_are_the_angles_and_the_quaternions_of_which_all_parts_are_there() -> None:
    outputs = [{"name": name, "unit": "1", "angle": False} for name in "wijk"]
    info = Info.from_json({**PIONEER, "outputs": outputs, "quaternions": [["w", "i", "j", "k"]]})
    assert info.rotations("outputs") == Rotations(4, (), ((0, 1, 2, 3),))
    assert info.rotations("states") == Rotations(5, (2, 3))
    for wrong in (["wijk"], [["w", "i", "j"]], [["w", "i", "j", 1]], [3], 3):
        with pytest.raises(MessageError, match="info must be JSON"):
            Info.from_json({**PIONEER, "quaternions": wrong})


def test_position_heading_and_tracked_states_are_found_by_role_whatever_their_names() -> None:
    info = Info.from_json(PIONEER)
    assert info.position == (0, 1)
    assert info.heading == 3
    assert info.tracked == [(0, 3)]
    assert info.computed == [1]
    assert info.computed_position is None


def test_a_description_without_roles_has_neither_position_nor_heading() -> None:
    states = [{"name": name, "unit": "m", "angle": name == "psi"} for name in ("x", "y", "psi")]
    info = Info.from_json({"role": "controller", "states": states, "outputs": states})
    assert (info.position, info.heading, info.tracked) == (None, None, [])


@pytest.mark.parametrize(
    ("states", "commands", "expected"),
    [
        (["u", "omega"], ["u", "omega"], [0, 1]),
        (["vx", "vy"], ["vy"], [1]),
        (["vx", "vy"], [""], [None]),
        (["v"], ["gone"], [None]),
    ],
)
def test_a_command_is_shown_beside_the_state_that_follows_it(states: list[str], commands: list[str], expected: list[int | None]) -> None:
    document = {
        "role": "controller",
        "states": [{"name": name, "unit": "m/s", "angle": False} for name in states],
        "inputs": [{"name": f"input_{k}", "unit": "m/s", "angle": False, "state": state} for k, state in enumerate(commands)],
    }
    info = Info.from_json(document)
    assert [info.measured(i) for i in range(len(commands))] == expected


def test_what_is_written_of_vectors_bounds_and_obstacles_is_read_as_it_was() -> None:
    states, disc = (Label("x", "m", role="x", state="x"), Label("psi", "rad", angle=True)), (3, 1.0, 0.5, 0.4)
    written = {**labels({"states": ["x", ""]}, states=states), **bounds(lbx=[-1.0, -math.inf], ubx=[math.inf, 2.0]), **obstacles([disc])}
    info = Info.from_json(json.loads(json.dumps({"role": "robot", **written})))
    assert (info.states, info.lbx, info.ubx, info.obstacles) == (states, (-1.0, -math.inf), (math.inf, 2.0), (Obstacle(*disc),))


@pytest.mark.parametrize("wrong", [{"epoch": -1}, {"seq": True}, {"config_hash": "1"}, {"epoch": 11}, {"epoch": None}])
def test_leader_says_who_it_is_in_whole_numbers(wrong: dict[str, Any]) -> None:
    said = {"epoch": 10, "seq": 2, "config_hash": 7, **parameters(3, {"ocp.N": 5})}

    def read(document: dict[str, Any]) -> Leader | None:
        return Leader.from_received(Received(json.dumps(document).encode(), "application/json", "r/info/controller"), 10)

    assert read(said) == Leader(10, 2, 7, {"version": 3, "changes": {"ocp.N": 5}})
    assert read({**said, **wrong}) is None


def test_infos_that_label_alike_are_equal() -> None:
    assert Info.from_json(PIONEER) == Info.from_json({**PIONEER, "epoch": 7, "version": "2"})
    assert Info.from_json(PIONEER) != Info.from_json({**PIONEER, "ubu": [0.4, None]})


def test_a_robot_never_described_has_numbered_components() -> None:
    info = Info.unnamed(2, 1, 1)
    assert [str(label) for label in (*info.states, *info.inputs)] == ["state_0", "state_1", "input_0"]
    assert info.position is None


@pytest.mark.parametrize(
    "wrong",
    [
        {},
        [],
        None,
        {"role": "controller", "states": 3},
        {"role": "controller", "states": [{"name": "x"}]},
        {**PIONEER, "lbu": [1.0]},
        {**PIONEER, "lbu": ["low", None]},
        {**PIONEER, "dt_s": "soon"},
        {**PIONEER, "dt_s": 10**400},
        {**PIONEER, "states": 1000 * PIONEER["states"]},
        {**PIONEER, "states": [{"name": "x" * 65, "unit": "m", "angle": False}]},
        {**PIONEER, "states": [{"name": "a\x1b[31m", "unit": "m", "angle": False}]},
        {**PIONEER, "states": [{"name": 7, "unit": "m", "angle": False}]},
        {**PIONEER, "scale_u": [0.5]},
        {**PIONEER, "scale_u": [0.5, 0.0]},
        {**PIONEER, "obstacles": [{"at": -1, "x": 0.0, "y": 0.0, "r": 1.0}]},
        {**PIONEER, "obstacles": [{"at": float("inf"), "x": 0.0, "y": 0.0, "r": 1.0}]},
        {**PIONEER, "obstacles": [{"at": 0, "x": 1e300, "y": 0.0, "r": 1.0}]},
    ],
)
def test_a_description_that_is_none_is_refused(wrong: Any) -> None:
    with pytest.raises(MessageError, match="info must be"):
        Info.from_json(wrong)


def test_a_controller_lists_what_a_planner_sends_and_where_obstacles_are_in_it(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(MINIMAL + DISC + "radius_m = 0.3\nmargin_m = 0.1\n" + "[observer.disturbances]\nu_c = { drift = 0.1, limit = 0.2 }\n")
    model = (ocp := build_ocp(load(path))).model
    document = json.loads(json.dumps({"role": "controller", **controller_info(ocp, model.np_ - 1)}))
    assert [parameter["name"] for parameter in document["stage_parameters"][-4:]] == ["a", "disc_0_x", "disc_0_y", "disc_0_r"]
    assert document["p_nominal"] == list(model.p_nominal[:-1])
    info = Info.from_json(document)
    assert info.obstacles == (Obstacle(7, 1.0, 0.5, 0.4),)
    assert [label.name for label in info.disturbances] == ["d_u_c"]
