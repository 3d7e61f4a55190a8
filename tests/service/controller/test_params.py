# SPDX-License-Identifier: Apache-2.0
"""Parameters of a running controller: changes that are granted, and those that are refused, with the reason; none is granted in part."""

from __future__ import annotations

import json
from pathlib import Path
from threading import Condition
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.contract.status import QpStatus
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.errors import ConfigError
from rti_mpc.reference.trajectory import circle
from rti_mpc.rti.ocp import WEIGHTS_AND_BOUNDS
from rti_mpc.rti.rti import Rti
from rti_mpc.wire import document
from rti_mpc_service.config import toml
from rti_mpc_service.config.build import build_ocp, build_rti
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.controller.params import Params, changed_problem, parameter_values
from rti_mpc_service.parameter import from_json, to_json
from rti_mpc_service.request import parse_assignments
from rti_mpc_service.shipped import ROBOTS, SHIPPED
from tests.loop import drive, reference, robot
from tests.service.config.test_config import MINIMAL

pytestmark = pytest.mark.usefixtures("interpreted", "shared_problems")


def configuration(folder: Any, live: bool = True) -> Config:
    """The shipped robot, of a short horizon."""
    path = folder / "robot.toml"
    path.write_text(SHIPPED.read_text().replace("N = 20 ", "N = 5 ").replace("live = false", f"live = {str(live).lower()}"))
    config = load(path)
    assert (config.ocp.N, config.params.live) == (5, live)
    return config


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> tuple[Controller, Params, Config]:
    """A controller that has driven for a second, and its parameters."""
    config = configuration(tmp_path_factory.mktemp("params"))
    rti = build_rti(config)
    controller = Controller(rti, Timing())
    params = Params(config, controller, rti, Condition())
    controller.receive_reference(reference(circle()))
    drive(controller, robot(circle()), 1.0)
    return controller, params, config


def test_values_are_those_of_the_file_by_its_keys(running: tuple[Controller, Params, Config]) -> None:
    _, params, config = running
    answer = params.answer({"get": True})
    assert (answer["version"], answer["live"]) == (0, True)
    assert answer["values"] == parameter_values(config)
    assert answer["values"]["ocp.weights.Q.psi"] == 0.05
    assert answer["values"]["ocp.weights.lambda"] == (0.8,)
    assert answer["values"]["ocp.bounds.increments.omega_c"] == (-0.40, 0.40)
    assert len(answer["values"]) == 3 + 2 + 2 + 2 + 2 + 2 + 1


def test_change_is_told_with_its_version_and_its_first_command_and_acts_from_there(tmp_path: Any) -> None:
    config = configuration(tmp_path)
    rti = build_rti(config)
    controller, body = Controller(rti, Timing()), robot(circle())
    params = Params(config, controller, rti, Condition())
    controller.receive_reference(reference(circle()))
    last = drive(controller, body, 1.0).commands[-1]
    answer = params.answer({"set": {"ocp.bounds.inputs.u_c": [-0.05, 0.05], "ocp.weights.Q.psi": 0.0}})
    assert answer == {"version": 1, "from_seq": last.seq + 2}
    assert params.answer({"get": True})["values"]["ocp.bounds.inputs.u_c"] == (-0.05, 0.05)
    assert params.ocp.ubu.tolist() == [0.05, 0.745]
    assert max(command.u[:, 0].max() for command in drive(controller, body, 2.5).commands[-3:]) <= 0.05 + 1e-9  # rounding
    again = params.answer({"set": {"ocp.bounds.inputs.u_c": [-0.5, 0.5]}})
    assert again["version"] == 2
    assert params.changes == {"ocp.bounds.inputs.u_c": [-0.5, 0.5], "ocp.weights.Q.psi": 0.0}


REFUSED: list[tuple[dict[str, Any], list[str]]] = [
    ({"ocp.N": 7}, ["ocp.N (horizon, in stages)", "fixed while the controller runs", "restart", "got 7"]),
    ({"ocp.dt_s": 0.05}, ["ocp.dt_s", "fixed while the controller runs"]),
    ({"model.parameters.a": 0.3}, ["model.parameters.a", "fixed while the controller runs"]),
    ({"observer.disturbances.x.drift": 0.3}, ["observer.disturbances.x.drift (intensity of its random walk", "fixed while the controller runs"]),
    ({"ocp.weigths.Q.x": 1.0}, ["ocp.weigths.Q.x", "none of", "ocp.weights.Q"]),
    ({"ocp.weights.Q.phi": 1.0}, ["ocp.weights.Q.phi", "no output", "psi [rad]"]),
    ({"ocp.weights.Q.psi": -1.0}, ["ocp.weights.Q.psi", "at least 0", "-1.0"]),
    ({"ocp.weights.Q.psi": "1"}, ["ocp.weights.Q.psi", "must be a number", "'1'"]),
    ({"ocp.weights.R_u.u_c": 0.5}, ["ocp.weights.R_u.u_c", "only where the controller's file has a weight of R_u above 0", "restart", "got 0.5"]),
    ({"ocp.weights.R_u": {"u_c": 0.5}}, ["ocp.weights.R_u can be set only where"]),
    ({"ocp.weights.delta": [1.0, 2.0]}, ["ocp.weights.delta", "a list of 5", "[1.0, 2.0]"]),
    ({"ocp.bounds.inputs.u_c": [-0.6, 0.5]}, ["ocp.bounds.inputs.u_c", "inside the file's [-0.5, 0.5]", "guard", "[-0.6, 0.5]"]),
    ({"ocp.bounds.inputs.u_c": [0.3, 0.2]}, ["ocp.bounds.inputs.u_c", "lower < upper"]),
    ({"ocp.bounds.inputs.u_c": 0.3}, ["ocp.bounds.inputs.u_c", "[lower, upper]", "0.3"]),
    *(
        ({"ocp.bounds.increments.u_c": increments}, ["ocp.bounds.increments.u_c", "lower < 0 < upper"])
        for increments in ([0.1, 0.2], [-0.2, -0.1], [0.0, 0.25], [-0.25, 0.0])
    ),
    ({"ocp.bounds.increments.u_c": [0.0, 0.0]}, ["ocp.bounds.increments.u_c", "lower < upper"]),
    ({"ocp.bounds.inputs.u_c": [0.2, 0.3]}, ["ocp.bounds", "input u_c must hold its rest, 0 m/s", "[0.2, 0.3]"]),
    ({"ocp.bounds.inputs.u_c": [-0.5, 0.5], "ocp.bounds.inputs.omega_c": [-0.3, -0.2]}, ["omega_c must hold its rest, 0 rad/s", "[-0.3, -0.2]"]),
    ({"ocp.bounds.inputs.u_c": [float("nan"), 0.3]}, ["ocp.bounds.inputs.u_c", "lower < upper"]),
    ({"ocp.bounds.inputs.u_c": [-0.5, float("inf")]}, ["ocp.bounds.inputs.u_c", "inside the file's [-0.5, 0.5]"]),
    ({"ocp.bounds.inputs.u_c": [-(10**400), 0.5]}, ["ocp.bounds.inputs.u_c"]),
    ({"ocp.bounds.states.x": [-1.0, 1.0]}, ["ocp.bounds.states.x", "not in the controller's file", "no bound can be added"]),
    ({"ocp.bounds.states.u": [-float("inf"), 0.5]}, ["ocp.bounds.states.u", "inside the file's [-0.5, 0.5]"]),
    ({"ocp.weights.Q.x": 1e200}, ["ocp.weights.Q.x", "at most 1000000000000000", "1e+200"]),
    ({}, ["params", '"set"']),
]


@pytest.mark.parametrize(("change", "words"), REFUSED, ids=[next(iter(change), "nothing") + str(k) for k, (change, _) in enumerate(REFUSED)])
def test_change_that_does_not_fit_is_refused_in_one_line_and_nothing_of_it_is_taken(
    running: tuple[Controller, Params, Config], change: dict[str, Any], words: list[str]
) -> None:
    controller, params, config = running
    with pytest.raises(ConfigError) as refusal:
        params.answer({"set": {"ocp.weights.R.u_c": 2.0, **change} if change else {}})
    assert "\n" not in str(refusal.value)
    for word in words:
        assert word in str(refusal.value)
    assert (params.version, params.changes, params.answer({"get": True})["values"]) == (0, {}, parameter_values(config))
    assert controller.telemetry(prepare_us=0, feedback_us=0, latency_us=0, slack_s=0).parameter_version == 0


def test_change_without_a_solution_on_the_present_sample_is_refused(
    running: tuple[Controller, Params, Config], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, params, config = running
    monkeypatch.setattr(Rti, "feedback", lambda *_: QpStatus.FAILED)
    with pytest.raises(ConfigError, match="present sample must have a solution with the new values, its QP is failed"):
        params.answer({"set": {"ocp.weights.R.u_c": 2.0}})
    assert (params.version, params.answer({"get": True})["values"]) == (0, parameter_values(config))


def test_weights_of_inputs_are_set_like_those_of_outputs_and_increments(tmp_path: Any) -> None:
    config = configuration(tmp_path)
    weighed = config.model_copy(
        update={"ocp": config.ocp.model_copy(update={"weights": config.ocp.weights.model_copy(update={"R_u": {"omega_c": 0.1}})})}
    )
    rti = build_rti(weighed)
    controller = Controller(rti, Timing())
    params = Params(weighed, controller, rti, Condition())
    assert params.answer({"get": True})["values"]["ocp.weights.R_u.omega_c"] == 0.1
    controller.receive_reference(reference(circle()))
    body = robot(circle())
    assert abs(drive(controller, body, 2.0).commands[-1].u[0, 0]) > 0.1, "m/s"
    params.answer({"set": {"ocp.weights.R_u.u_c": 1e4, "ocp.weights.R_u.omega_c": 0.0}})
    np.testing.assert_array_equal(params.ocp.R_u, [1e4, 0.0])
    assert abs(drive(controller, body, 5.0).commands[-1].u[0, 0]) < 1e-3, "m/s: to drive costs more than to stay behind"
    params.answer({"set": {"ocp.weights.R_u.u_c": 0.0}})  # none is left, but the compiled problem has them
    assert abs(drive(controller, body, 9.0).commands[-1].u[0, 0]) > 0.02, "m/s: it follows again"
    assert params.answer({"set": {"ocp.weights.R_u.u_c": 0.5}})["version"] == 3


def test_nothing_changes_unless_the_file_allows_it(tmp_path: Any) -> None:
    config = configuration(tmp_path, live=False)
    rti = build_rti(config)
    params = Params(config, Controller(rti, Timing()), rti, Condition())
    assert params.answer({"get": True})["live"] is False
    with pytest.raises(ConfigError, match=r"params\.live must be true"):
        params.answer({"set": {"ocp.weights.Q.psi": 0.0}})


def test_one_that_stands_by_has_what_the_leader_has(running: tuple[Controller, Params, Config]) -> None:
    controller, _, config = running
    params = Params(config, controller, build_rti(config), Condition())
    params.adopt(4, {"ocp.weights.Q.psi": 0.7})
    assert (params.version, params.ocp.Q[2, 2]) == (4, 0.7)
    params.adopt(0, {})  # a leader that was started anew
    assert (params.version, params.ocp.Q[2, 2]) == (0, 0.05)


def test_a_bound_on_one_side_stays_on_that_side(tmp_path: Any) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(MINIMAL + "ocp.bounds.inputs = { u_c = [-inf, 0.5] }\nparams.live = true\n")
    config = load(path)
    with pytest.raises(ConfigError, match="finite where that is"):
        changed_problem(config, build_ocp(config), {"ocp.bounds.inputs.u_c": [-1.0, 0.5]})
    assert changed_problem(config, build_ocp(config), {"ocp.bounds.inputs.u_c": [-float("inf"), 0.4]})[1].ubu[0] == 0.4


@pytest.mark.parametrize("path", ROBOTS.values(), ids=ROBOTS)
def test_values_of_every_shipped_robot_travel_to_an_operator_and_back(path: Path) -> None:
    config = load(path)
    values = parameter_values(config)
    told = from_json(document.read(json.dumps(to_json(values)).encode()))
    assert {key: toml.text(value) for key, value in told.items()} == {key: toml.text(value) for key, value in values.items()}
    printed = [f"{key}={toml.text(value)}" for key, value in told.items() if value is not None and "R_u" not in key]
    asked = from_json(document.read(json.dumps(to_json(parse_assignments(printed))).encode()))
    assert parameter_values(changed_problem(config, build_ocp(config), asked)[0]) == values


@pytest.mark.parametrize("words", ["u_c=[inf, 0.5]", "u_c=[-0.5, -inf]", "u_c=inf", "u_c=[nan, 0.5]"])
def test_infinity_that_stands_for_no_bound_is_refused_with_what_would(words: str) -> None:
    with pytest.raises(ConfigError, match=r"u_c must be finite, except for an absent bound, \[-inf, upper\] or \[lower, inf\], got"):
        parse_assignments([f"ocp.bounds.inputs.{words}"])


def test_absent_bound_is_null_for_operators_and_standbys(tmp_path: Any) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(MINIMAL + "ocp.bounds.states = { u = [-inf, 0.5] }\nparams.live = true\n")
    config = load(path)
    rti = build_rti(config)
    leader, standby = (Params(config, Controller(rti, Timing()), rti, Condition()) for _ in range(2))
    assert leader.answer({"get": True})["values"]["ocp.bounds.states.u"] == (None, 0.5)
    assert leader.answer({"set": {"ocp.bounds.states.u": [None, 0.4]}})["version"] == 1
    said = document.read(json.dumps(to_json(leader.changes)).encode())
    assert said == {"ocp.bounds.states.u": [None, 0.4]}
    standby.adopt(1, said)
    assert standby.changes == leader.changes == {"ocp.bounds.states.u": [-float("inf"), 0.4]}
    with pytest.raises(ConfigError, match="finite where that is"):
        leader.answer({"set": {"ocp.bounds.states.u": [None, None]}})


FILES = {
    "plain": "",
    "soft": "ocp.bounds = { states = { u = [-0.5, 0.5] }, soft_weight = 7.0 }\n",
    "regulator": "[ocp.terminal.lqr]\nstates = { u = 0.25 }\ninputs = { u_c = 0.25 }\n",
    "obstacle": "[[ocp.obstacles]]\ncentre_m = [1.0, 0.5]\nradius_m = 0.3\n",
    "disturbance": "[observer.disturbances]\nu_c = { drift = 0.1, limit = 0.3 }\n",
}
CHANGES: dict[str, Any] = {"ocp.weights.Q.psi": 0.3, "ocp.weights.R.u_c": 2.0, "ocp.weights.lambda": 0.9, "ocp.bounds.soft_weight": None}


@pytest.mark.parametrize("file", FILES.values(), ids=FILES)
def test_problem_after_changes_is_the_one_its_file_would_have_built(tmp_path: Any, file: str) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(MINIMAL + file)
    config = load(path)
    built = build_ocp(config)
    _, before = changed_problem(config, built, {"ocp.bounds.soft_weight": 9.0, "ocp.weights.Q.x": 5.0})
    now, ocp = changed_problem(config, before, CHANGES)
    wanted = build_ocp(now)
    for name in WEIGHTS_AND_BOUNDS:
        np.testing.assert_array_equal(getattr(ocp, name), getattr(wanted, name), err_msg=name)
    assert ocp.model is built.model
    assert ocp.h_expr is built.h_expr


def test_change_builds_no_expression(running: tuple[Controller, Params, Config], monkeypatch: pytest.MonkeyPatch) -> None:
    """That would take ten times as long, while the thread that controls wants the interpreter, too."""
    _, params, config = running

    def refuse(*_: Any) -> None:
        raise AssertionError("an expression is built")

    monkeypatch.setattr(ca, "Function", refuse)
    monkeypatch.setattr(ca.SX, "sym", refuse)
    assert changed_problem(config, params.ocp, {"ocp.weights.Q.psi": 0.3})[1].Q[2, 2] == 0.3


def test_change_is_tried_when_a_sample_has_just_ended(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    class Samples(Condition):
        def wait(self, timeout: float | None = None) -> bool:
            seen.append(f"waits {timeout:g} s")
            return True

    config = configuration(tmp_path)
    rti = build_rti(config)
    params = Params(config, Controller(rti, Timing()), rti, Samples())
    monkeypatch.setattr(Rti, "feedback", lambda *_: seen.append("tries") or QpStatus.SOLVED)
    params.answer({"set": {"ocp.weights.R.u_c": 2.0}})
    assert seen == ["waits 0.2 s", "tries"]
