# SPDX-License-Identifier: Apache-2.0
"""Measures of faults for any robot, and promises for robots that follow no path or that coast."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import End, Reference
from rti_mpc.errors import ConfigError
from rti_mpc.rti.rest import standing_s
from rti_mpc_service.config.build import build_ocp
from rti_mpc_service.config.config import load
from rti_mpc_service.faults.measure import STANDSTILL_SPEED_M_S, Incident
from rti_mpc_service.faults.motion import Motion
from rti_mpc_service.faults.promise import ALWAYS, HOLDS, KEEPS_ON, PAUSES, RECOVERY, STOPS, WAITS
from rti_mpc_service.faults.report import MatrixRow
from rti_mpc_service.faults.run import MIN_REFERENCE_S, by_way, error_before, moving_s, of_robot, prepared
from rti_mpc_service.faults.table import FAULTS
from rti_mpc_service.rig.robot_log import RobotLog
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import ROBOTS
from tests import movers
from tests.robots import SHIPPED, arm, glider, polar, shuffled, toml
from tests.units import with_units

X = np.arange(5.0)


def test_robot_in_the_plane_is_measured_by_its_position_wherever_it_is_among_states_and_outputs() -> None:
    motion = Motion(shuffled())
    assert motion.unit == "m"
    assert motion.position(X) == pytest.approx([3.0, 4.0])
    assert motion.position(np.stack([X, X + 1])) == pytest.approx(np.array([[3.0, 4.0], [4.0, 5.0]]))
    reference = Reference(1, 1, 0, 10, End.HOLD, np.array([[0.0, 1.0, 2.0], [0.0, 2.0, 4.0]]), np.zeros((2, 0)))
    assert motion.wanted(reference, np.array([0, 5, 99])) == pytest.approx(np.array([[1.0, 2.0], [1.5, 3.0], [2.0, 4.0]]))
    assert np.isnan(motion.wanted(None, np.array([0]))).all()
    assert motion.distance(np.array([3.0, 4.0]), np.zeros(2)) == pytest.approx(5.0)


def test_any_other_robot_is_measured_by_its_outputs_in_their_unit_angles_within_pi() -> None:
    motion = Motion(arm())
    assert motion.unit == "rad"
    assert motion.position(np.array([0.1, 0.2])) == pytest.approx([0.1, 0.2])
    assert motion.distance(np.array([0.3, 2 * np.pi]), np.array([0.0, 0.4])) == pytest.approx(0.5)
    assert Motion(polar()).unit == "1"


def test_robot_in_other_units_is_measured_in_si_units_as_its_promises_are() -> None:
    """An arm in degrees counted as driven at 0.02 degrees per second, and had to be within 0.01 degrees of its reference."""
    plain, other = Motion(arm()), Motion(with_units(arm(), {"x": "deg"}))
    x, sizes = np.array([0.3, 2 * np.pi]), np.array([np.pi / 180, 1.0])
    assert (other.unit, other.driven_speed) == (plain.unit, plain.driven_speed) == ("rad", 0.02)
    np.testing.assert_allclose(other.position(x / sizes), plain.position(x), rtol=1e-12)
    assert other.distance(other.position(x / sizes), np.array([0.0, 0.4])) == pytest.approx(0.5)
    reference = Reference(1, 1, 0, 10, End.HOLD, np.array([[0.1, 0.2], [0.2, 0.3]]) / sizes, np.zeros((2, 0)))
    np.testing.assert_allclose(other.wanted(reference, np.array([0, 10])), [[0.1, 0.2], [0.2, 0.3]], rtol=1e-12)
    assert Motion(with_units(glider(), {"psi": "km"})).unit == "m", "km and m have one SI unit"


def test_error_that_a_robot_has_without_a_fault_is_not_held_against_it() -> None:
    log = RobotLog(10**9 * np.arange(8), np.arange(8), np.zeros((8, 1)), np.zeros((8, 1)), np.zeros(8), {})
    error = np.array([9.0, 0.1, 0.2, 0.3, 0.2, 0.1, 0.1, 5.0])
    assert error_before(log, error, Incident(6 * 10**9, 7 * 10**9, 8 * 10**9)) == 0.3
    assert KEEPS_ON.eased(0.3).at_most["error_m"] == pytest.approx(0.31)
    assert KEEPS_ON.eased(0.3).at_most["missed"] == 0.0


def test_robot_that_coasts_promises_nothing_of_its_standstill_but_where_it_is_held() -> None:
    assert STOPS.without_standstill().at_most.keys() == STOPS.at_most.keys() - {"still_s"}
    assert WAITS.without_standstill().at_most.keys() == WAITS.at_most.keys() - {"distance_m"}
    assert HOLDS.without_standstill() == HOLDS


def test_robot_with_a_way_to_rest_is_to_stand_in_its_own_time_whatever_its_inputs_do() -> None:
    fault, missing = (next(fault for fault in FAULTS if fault.name == name) for name in ("controller_killed", "reference_missing"))
    borne = by_way(fault, 5.0, disturbed=False)
    assert borne.promise.at_most == {**ALWAYS, **RECOVERY, "still_s": 5.0}
    assert borne.hold_s > 5.0
    assert by_way(missing, 5.0, disturbed=False) == missing
    assert by_way(missing, 5.0, disturbed=True).promise.at_most == {**ALWAYS, **RECOVERY}, "it drifts until then"
    assert PAUSES.by_way(5.0).at_most == {**ALWAYS, **RECOVERY}
    assert HOLDS.by_way(5.0) == HOLDS


@pytest.mark.parametrize(("name", "zero_s"), [("pioneer_3dx", 0.5), ("omnidirectional", 0.7), ("unicycle", 0.8)])
def test_inputs_are_to_be_zero_when_the_slew_limits_of_the_robot_allow_it_and_not_before(name: str, zero_s: float) -> None:
    config = load(ROBOTS[name])
    borne = {fault.name: fault for fault in of_robot(FAULTS, config, None)}
    for fault in (borne["controller_killed"], borne["commands_lost"]):
        assert fault.promise.at_most["zero_s"] == pytest.approx(zero_s)
        assert fault.promise.at_most["brake_s"] == 0.3, "it begins to brake as soon as any other"
        assert fault.hold_s >= zero_s + 0.3 - 1e-9, "and is seen at rest"
    assert borne["viewer_hung"].promise == KEEPS_ON


def test_time_to_stand_begins_when_the_last_plan_has_ended_and_is_that_of_the_robot(tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text(movers.toml("car"))
    config, law = load(tmp_path / "robot.toml"), movers.law_of("car")
    assert law is not None
    (borne,) = of_robot([fault for fault in FAULTS if fault.name == "controller_killed"], config, law)
    ocp = build_ocp(config)
    stands_s = standing_s(ocp, law, Motion(ocp.model).position, STANDSTILL_SPEED_M_S)
    assert borne.promise.at_most["still_s"] == pytest.approx(config.timing.valid_s + stands_s)
    assert of_robot(FAULTS, config, None) == list(FAULTS)


def test_row_is_told_in_the_unit_of_the_robot() -> None:
    assert MatrixRow(FAULTS[0], None, ["it was not there"], unit="rad").to_json()["unit"] == "rad"


@pytest.mark.parametrize("name", ["arm", "glider", "rover", "shuffled"])
def test_faults_are_prepared_for_any_robot_behind_a_guard(name: str, tmp_path: Path) -> None:
    """The glider has a parameter `a` that is no axle's offset, the rover none at all, and the arm no position."""
    path = tmp_path / "robot.toml"
    path.write_text(toml(name))
    config = load(path)
    config = prepared(config, find_scenario(config))
    assert config.guard.enabled
    assert config.debug.inject


@pytest.mark.parametrize(("name", "lasts_s"), [(None, 120.0), ("circle", 120.0), ("waypoints.csv", 80.0)])
def test_scenario_is_followed_for_as_long_as_it_moves_the_robot(
    name: str | None, lasts_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("waypoints.csv").write_text("x,y\n0,0\n20,0\n")
    config = load(SHIPPED)
    assert moving_s(config, find_scenario(config, name, duration_s=120.0)) == pytest.approx(lasts_s, abs=0.1)


def test_scenario_that_ends_before_a_fault_would_is_one_line() -> None:
    config = load(SHIPPED)
    with pytest.raises(ConfigError, match=rf"^--scenario must move the robot for at least {MIN_REFERENCE_S:g} s, positioning does for 15\.8 s$"):
        moving_s(config, find_scenario(config, "positioning", duration_s=120.0))
