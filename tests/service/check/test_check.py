# SPDX-License-Identifier: Apache-2.0
"""`rti-mpc check`: what it compares, and what it lets pass."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import ConfigError
from rti_mpc.rti.rest import Rest, RestClass, assess
from rti_mpc_service import compiling
from rti_mpc_service.check import check, rest
from rti_mpc_service.check.agreement import Agreement
from rti_mpc_service.check.rest import rest_line
from rti_mpc_service.config.build import build_rti
from rti_mpc_service.config.config import load
from rti_mpc_service.shipped import SHIPPED
from tests.movers import law_of, ocp_of
from tests.problems import pioneer
from tests.service.config.test_config import MINIMAL
from tests.slow import slow_but

pytestmark = pytest.mark.usefixtures("interpreted")


def checked(path: Path) -> check.CheckReport:
    config = load(path)
    return check.check(config, build_rti(config))


@pytest.mark.parametrize(("first", "second"), slow_but([("riccati", "daqp"), ("osqp", "daqp"), ("daqp", "osqp")], ("osqp", "daqp")))
def test_two_solvers_are_compared_tightly_whatever_the_controllers_tolerance(first: str, second: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    loose = "eps = 0.01\n" if first != "daqp" else ""
    path.write_text(MINIMAL + f"[ocp.bounds]\ninputs = {{ u_c = [-0.2, 0.2] }}\n[solver]\nname = '{first}'\n{loose}")
    report = checked(path)
    assert report.second == second
    assert len(report.opinions) > check.COMPARED_WAVE_SAMPLES, "those at the bounds are asked about, too"
    assert report.agree
    assert report.difference < 1e-6
    assert (report.deviation > 1e-4) is (first == "osqp"), "what the tolerance costs is told apart from whether the QP is right"


def test_a_qp_that_is_not_the_other_formulations_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(MINIMAL + "[ocp.bounds]\ninputs = { u_c = [-1, 1], omega_c = [-1, 1] }\n")
    right = check.solution
    monkeypatch.setattr(check, "solution", lambda one, *sample: right(one, *sample) + (1e-4 if one.formulation == "simultaneous" else 0.0))
    report = checked(path)
    assert not report.agree
    np.testing.assert_allclose(report.difference, 1e-4, rtol=0.01)


def test_signals_that_cannot_be_written_fail_the_check_only_where_a_guard_is_to_read_them(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(MINIMAL)
    config = load(path)
    file = tmp_path / "robot.signals.json"
    assert check.written(path, config) == str(file)
    file.unlink()
    file.mkdir()  # as where a folder cannot be written, which nothing keeps root from
    assert check.written(path, config).startswith(f"not written, {file} must be a file that can be written")
    assert check.written(path, config).endswith("check a copy of robot.toml in a folder of your own")
    guarded = config.model_copy(update={"guard": config.guard.model_copy(update={"enabled": True})})
    with pytest.raises(ConfigError, match=r"check a copy of robot\.toml in a folder of your own$"):
        check.written(path, guarded)


CART = """
robot = "cart"
model = { name = "tests.problems:cart" }
ocp.N = 20
ocp.dt_s = 0.1
ocp.integrator = "rk4"
ocp.weights = { Q = { r = 1 }, R = { F = 1e-7 }, delta = 1, lambda = 1 }
[ocp.bounds]
inputs = { F = [-5000, 5000] }
increments = { F = [-2000, 2000] }
states = { v = [-3, 3] }
"""


def test_every_bound_is_driven_to(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(CART)
    report = checked(path)
    assert (report.bounds, report.missed) == (6, [])
    assert report.agree


def test_a_bound_that_gives_way_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With far too small a penalty on bounds; samples along a wave of the reference alone never reach a bound."""
    path = tmp_path / "robot.toml"
    path.write_text(CART)
    monkeypatch.setattr("rti_mpc.rti.places.PENALTY", 10.0)
    monkeypatch.setattr("rti_mpc.rti.active_set.MAX_STEPS", 0)  # of the interior point, which would hold them
    report = checked(path)
    assert not report.agree or sum(report.statuses.values()) > report.statuses[QpStatus.SOLVED]


TANK = """
robot = "tank"
model = { name = "tests.problems:tank" }
ocp.N = 20
ocp.dt_s = 0.5
ocp.integrator = "rk4"
ocp.weights = { Q = { h = 1 }, R = { q = 0.01 }, delta = 1, lambda = 1 }
[ocp.bounds]
inputs = { q = [0, 2] }
"""


def test_model_that_ends_near_its_bounds_is_driven_to_them_from_where_it_is_regular(tmp_path: Path) -> None:
    """Half a range below the lower level there is none, and no inflow at all empties the tank within the horizon."""
    path = tmp_path / "robot.toml"
    path.write_text(TANK + "states = { h = [0.2, 3] }\n")
    report = checked(path)
    assert report.statuses == Counter({QpStatus.SOLVED: 216})
    assert (report.missed, report.failed_at) == ([], None)
    assert report.agree


def test_sample_without_a_plan_is_told_with_the_state_it_began_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing keeps the wave from the bottom of the tank."""
    path = tmp_path / "robot.toml"
    path.write_text(TANK)
    monkeypatch.setattr(check, "check_period", lambda config: None)
    monkeypatch.setattr(check, "check_stop", lambda config: None)
    monkeypatch.setattr(check, "stop_from_everywhere", lambda ocp, law, **options: "")
    assert check.main(path) == 1
    line = next(line for line in capsys.readouterr().out.splitlines() if "without a plan" in line)
    assert re.match(r"the first sample without a plan began at h = [\d.]+ m: .*, bound in ocp.bounds.states where the robot operates$", line)


def test_no_number_is_cut_off_in_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    times = np.array([123456789.0])
    report = check.CheckReport(times, times, Counter({QpStatus.SOLVED: 1}), "daqp", [Agreement(0.0, 0.0)], 0.0, 0, [])
    monkeypatch.setenv("COLUMNS", "20")
    monkeypatch.setattr(check, "check_stop", lambda config: None)
    monkeypatch.setattr(check, "check", lambda *_: report)
    assert check.main(SHIPPED) == 0
    assert capsys.readouterr().out.count("123456789") == 6


def test_rest_is_described_in_one_line() -> None:
    car = ocp_of("car")
    line = rest_line(car.model, law_of("car"), assess(car, law_of("car"), 20, compile=False))
    assert line.startswith("a stop: at rest it drifts without feedback (b); from 20 states within ")
    assert "x by " in line
    assert " v by " not in line, "it is zero wherever the car rests"
    assert "rows of 0.05 s to rest, and a gain that keeps it there: without it, " in line
    assert re.search(r" s after a stop (y|psi|x) changes by up to 0\.0\d* (m|rad) per second$", line)
    robot = pioneer()
    line = rest_line(robot.model, None, assess(robot, None, 20))
    assert "holds without feedback (a)" in line
    assert line.endswith("its inputs ramp to rest")


def test_robot_whose_observer_estimates_what_may_be_a_current_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rest, "assess", lambda *_: Rest(RestClass.HOLDS, 0.0, 1.0, np.zeros(5), 1000))
    robot = pioneer()
    assert rest.stop_from_everywhere(robot, None).endswith("its inputs ramp to rest")
    told = "its disturbances are taken to end where it stands: if they are wind or current, observer.at_rest must say so"
    assert rest.stop_from_everywhere(robot, None, disturbed=True).endswith(told)
    law = law_of("car")
    assert law is not None
    line = rest.stop_from_everywhere(robot, replace(law, disturbances=np.ones(2)), disturbed=True)
    assert "from 1000 states, disturbed up to its observer's limits, within 1 s" in line
    assert told not in line


def test_what_is_waited_for_is_said_where_no_terminal_shows_it(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The quadrotor took a minute and a half at its first check, in a silence that looked like a hang."""
    times = np.array([1.0])
    report = check.CheckReport(times, times, Counter({QpStatus.SOLVED: 1}), "daqp", [Agreement(0.0, 0.0)], 0.0, 0, [])
    monkeypatch.setattr(compiling, "Timer", At)
    monkeypatch.setattr(check, "check", lambda *_: report)
    monkeypatch.setattr(check, "check_stop", lambda config: None)
    monkeypatch.setattr(check, "stop_from_everywhere", lambda ocp, law, **options: "")
    assert check.main(SHIPPED) == 0
    assert capsys.readouterr().err.splitlines() == [
        "finding how the robot comes to rest",
        "stopping it from wherever it operates",
        "solving samples along a wave and at all bounds, some by a second solver",
    ]


class At:
    """Timer that is over at once."""

    daemon = False

    def __init__(self, interval: float, function: Callable[[str], object], args: tuple[str]) -> None:
        self._call = partial(function, *args)

    def start(self) -> None:
        self._call()

    def cancel(self) -> None:
        pass
