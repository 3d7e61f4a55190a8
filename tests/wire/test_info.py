# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from rti_mpc.errors import MessageError
from rti_mpc.wire.info import Info, Label, Leader, Obstacle, bounds, labels, obstacles, parameters
from rti_mpc.wire.received import Received
from service.build import build_ocp
from service.config import load
from service.daemon import describe
from tests.service.test_config import DISC, MINIMAL

PIONEER: dict[str, Any] = {
    "role": "controller",
    "model": "pioneer_3dx",
    "states": [{"name": n, "unit": u, "angle": n == "psi"} for n, u in [("x", "m"), ("y", "m"), ("psi", "rad"), ("u", "m/s"), ("omega", "rad/s")]],
    "inputs": [{"name": "u_c", "unit": "m/s", "angle": False}, {"name": "omega_c", "unit": "rad/s", "angle": False}],
    "outputs": [{"name": "psi", "unit": "rad", "angle": True}, {"name": "z", "unit": "1", "angle": False}],
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


def test_bounds_that_are_not_said_are_infinite() -> None:
    info = Info.from_json({name: value for name, value in PIONEER.items() if name not in ("lbu", "ubu", "dt_s")})
    assert info.lbu == (-math.inf, -math.inf)
    assert math.isnan(info.dt_s)


def test_position_heading_and_tracked_states_are_found_by_name_and_mark() -> None:
    info = Info.from_json(PIONEER)
    assert info.position == (0, 1)
    assert info.heading == 2
    assert info.tracked == [(0, 2)]


@pytest.mark.parametrize(
    ("states", "inputs", "expected"),
    [
        ([("u", "m/s"), ("omega", "rad/s")], [("u_c", "m/s"), ("omega_c", "rad/s")], [0, 1]),
        ([("vx", "m/s"), ("vy", "m/s")], [("vy_c", "m/s")], [1]),
        ([("vx", "m/s"), ("vy", "m/s")], [("speed", "m/s")], [None]),
        ([("q", "1")], [("duty", "1")], [None]),
        ([("x", "m")], [("force", "N")], [None]),
    ],
)
def test_a_command_is_shown_beside_the_one_state_it_is_about(states: Any, inputs: Any, expected: list[int | None]) -> None:
    vectors = {name: [{"name": n, "unit": u, "angle": False} for n, u in pairs] for name, pairs in (("states", states), ("inputs", inputs))}
    info = Info.from_json({"role": "controller", **vectors})
    assert [info.measured(i) for i in range(len(inputs))] == expected


def test_what_is_written_of_vectors_bounds_and_obstacles_is_read_as_it_was() -> None:
    states, disc = (Label("x", "m"), Label("psi", "rad", angle=True)), (3, 1.0, 0.5, 0.4)
    written = {**labels(states=states), **bounds(lbx=[-1.0, -math.inf], ubx=[math.inf, 2.0]), **obstacles([disc])}
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
    document = json.loads(json.dumps({"role": "controller", **describe(ocp, model.np_ - 1)}))
    assert [parameter["name"] for parameter in document["parameters"][-4:]] == ["a", "disc_0_x", "disc_0_y", "disc_0_r"]
    assert document["p_nominal"] == list(model.p_nominal[:-1])
    info = Info.from_json(document)
    assert info.obstacles == (Obstacle(7, 1.0, 0.5, 0.4),)
    assert [label.name for label in info.disturbances] == ["d_u_c"]
