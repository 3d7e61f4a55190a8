# SPDX-License-Identifier: Apache-2.0
"""Scenarios: references by roles in the plane, by outputs elsewhere; refusals use the names that users wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import End, Reference
from rti_mpc.errors import ConfigError
from rti_mpc.reference.trajectory import eight, rows
from rti_mpc.wire.cdr import encode
from rti_mpc.wire.layout import MAX_PAYLOAD_BYTES
from rti_mpc_service.config import signals_file
from rti_mpc_service.config.build import build_signals, with_initial_state
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.demo.demo import check_start
from rti_mpc_service.rig.scenario import configured, write_files
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import SHIPPED
from tests.robots import toml


def config_of(folder: Path, name: str, **changes: str) -> Config:
    path, text = folder / "robot.toml", toml(name)
    for right, wrong in changes.items():
        assert right in text
        text = text.replace(right, wrong)
    path.write_text(text)
    return load(path)


def test_robot_in_the_plane_follows_the_eight_any_other_one_sines_of_its_outputs(tmp_path: Path) -> None:
    pioneer, arm = find_scenario(load(SHIPPED)), find_scenario(config_of(tmp_path, "arm"))
    assert (pioneer.title, pioneer.duration_s, pioneer.path is None) == ("eight, heading consistent", eight().duration_s, False)
    np.testing.assert_array_equal(pioneer.y(np.zeros(5)), rows(eight(), 0.05, "consistent"))
    assert (arm.title, arm.duration_s, arm.path) == ("sines", 60.0, None)
    assert arm.y(np.array([0.3, -0.2]))[0] == pytest.approx([0.3, -0.2])


def test_robot_without_a_heading_is_said_to_have_none(tmp_path: Path) -> None:
    assert find_scenario(config_of(tmp_path, "glider")).title == "eight"


def test_outputs_over_time_in_a_file_are_followed_by_a_robot_in_the_plane_too(tmp_path: Path) -> None:
    path = tmp_path / "wave.csv"
    path.write_text("t,psi,x\n0,1,2\n10,2,4\n")  # what the glider calls its x and y
    scenario = find_scenario(config_of(tmp_path, "glider"), str(path))
    assert scenario.path is None
    np.testing.assert_allclose(scenario.y(np.zeros(2))[[0, -1]], [[1, 2], [2, 4]])
    path.write_text("x,y\n0,0\n1,0\n")
    assert find_scenario(config_of(tmp_path, "glider"), str(path)).path is not None


@pytest.mark.parametrize(
    ("robot", "scenario", "heading", "told"),
    [
        ("arm", "eight", None, "model arm: a path in the plane fills outputs whose role is x, y, heading, not x, elbow: give each its role"),
        ("arm", "sines", "tangent", "--heading is of paths in the plane, it must be left out for sines, got tangent"),
        (
            "arm",
            "spiral",
            None,
            "eight, circle, positioning, sines, steps or a FILE.csv of waypoints or of outputs over time",
        ),
        ("glider", "", None, "or a FILE.csv of waypoints or of outputs over time, got ''"),
        ("arm", "waypoints.csv", None, "waypoints.csv, line 1: the header must name t and every output of the model, t is missing, got x, y"),
        ("arm", "nowhere.csv", None, "nowhere.csv: must be a readable file"),
        ("glider", "nowhere.csv", None, "nowhere.csv: must be a readable file"),
    ],
)
def test_what_a_robot_cannot_follow_is_refused(robot: str, scenario: str, heading: str | None, told: str, tmp_path: Path) -> None:
    (tmp_path / "waypoints.csv").write_text("x,y\n0,0\n1,0\n")
    name = str(tmp_path / scenario) if scenario.endswith(".csv") else scenario
    with pytest.raises(ConfigError) as refusal:
        find_scenario(config_of(tmp_path, robot), name, heading)  # type: ignore[arg-type]
    assert told in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_axle_offset_behind_the_position_is_refused_by_the_name_of_its_parameter(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(SHIPPED.read_text().replace('name = "pioneer_3dx"', 'name = "pioneer_3dx"\nparameters = { a = -0.21 }'))
    config = load(path)
    with pytest.raises(ConfigError, match=r"model pioneer_3dx: a, the axle offset, must be at least 0 .* got -0\.21: choose --heading tangent"):
        find_scenario(config)
    assert find_scenario(config, heading="tangent").heading == "tangent"
    path.write_text(path.read_text().replace("-0.21", "0.0"))
    np.testing.assert_array_equal(find_scenario(load(path)).y(np.zeros(5)), rows(eight(), 0.05, "tangent"))


def test_no_more_outputs_move_than_there_are_inputs_and_those_without_weight_do_not(tmp_path: Path) -> None:
    arm = toml("arm").replace("x = 0.05, elbow", "x = 0.0, elbow")
    (tmp_path / "robot.toml").write_text(arm)
    assert np.ptp(find_scenario(load(tmp_path / "robot.toml")).y(np.zeros(2)), axis=0) == pytest.approx([0.0, 0.9], abs=0.01)


def test_robot_that_is_slow_follows_slow_references(tmp_path: Path) -> None:
    slow = find_scenario(config_of(tmp_path, "arm", **{"dt_s = 0.1": "dt_s = 10.0"}))
    assert slow.duration_s == 6 * 4 * 20 * 10.0


def test_run_with_a_guard_needs_every_bound_and_writes_what_the_guard_cannot_know_of_the_model(tmp_path: Path) -> None:
    config = config_of(tmp_path, "arm")
    guarded = configured(config, find_scenario(config), guard=True)
    write_files(tmp_path / "config.toml", guarded)
    assert signals_file.read(tmp_path / "config.toml", guarded) == build_signals(config)
    inputs = "inputs = { w_1 = [-1.0, 1.0], w_2 = [-1.0, 1.0] }"
    (tmp_path / "robot.toml").write_text(toml("arm").replace(inputs, "inputs = { w_2 = [-1, 1] }"))
    config = load(tmp_path / "robot.toml")
    with pytest.raises(ConfigError, match=r"ocp\.bounds\.inputs must bound every input where a guard is enabled, w_1 is missing"):
        configured(config, find_scenario(config), guard=True)


def test_start_at_which_an_output_is_no_number_is_refused_by_its_name(tmp_path: Path) -> None:
    """Where no start is given it is the nominal state, at which outputs are numbers; that need not be zero."""
    config = config_of(tmp_path, "polar")
    check_start(config)
    config = with_initial_state(config, ["east=0", "north=0"])
    with pytest.raises(ConfigError, match=r"sim\.x0 must be a state whose outputs are finite, direction is not, got \[0\.0, 0\.0\]"):
        check_start(config)


@pytest.mark.parametrize(("robot", "longest_s"), [("glider", 26_214), ("arm", 26_214)])
def test_scenario_that_no_message_holds_is_refused_before_its_rows_are_made(robot: str, longest_s: int, tmp_path: Path) -> None:
    """A session drops a longer message before it is put together: the controller would wait for it for ever."""
    config = config_of(tmp_path, robot)
    with pytest.raises(ConfigError, match=rf"must last at most {longest_s} s, .*, got 1e\+12 s: give it a shorter --duration"):
        find_scenario(config, duration_s=1e12)
    scenario = find_scenario(config, duration_s=float(longest_s))
    y = scenario.y(np.zeros(2))
    reference = Reference(1, 1, 0, 1, End.HOLD, y, np.empty((len(y), 0)))
    assert len(encode(reference)) <= MAX_PAYLOAD_BYTES[Reference]
