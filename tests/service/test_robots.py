# SPDX-License-Identifier: Apache-2.0
"""Robots that ship, on the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rti_mpc.errors import ConfigError
from rti_mpc_service.commands.arguments import file_of
from rti_mpc_service.config.config import load
from rti_mpc_service.robots import main
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import ROBOTS


def test_robots_are_listed_with_what_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    main()
    lines = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines() if line.strip()}
    assert set(ROBOTS) <= set(lines)
    assert lines["quadrotor"][1:8] == ["12", "4", "10", "ms", "50", "falls", "flown_eight"]


def test_robot_is_one_that_ships_or_a_file_not_both() -> None:
    assert file_of(ROBOTS["pioneer_3dx"], "boat") == ROBOTS["boat"]
    with pytest.raises(ConfigError, match=r"--robot must be one of pioneer_3dx, .*, perhaps quadrotor is meant, got 'quadrotr'"):
        file_of(ROBOTS["pioneer_3dx"], "quadrotr")
    with pytest.raises(ConfigError, match=r"CONFIG or --robot must be left out, got car\.toml and boat"):
        file_of(Path("car.toml"), "boat")


@pytest.mark.parametrize("name", ROBOTS)
def test_scenario_moves_for_long_enough_to_inject_a_fault_and_has_no_jump(name: str) -> None:
    config = load(ROBOTS[name])
    scenario = find_scenario(config, duration_s=70.0)
    y = scenario.y(np.zeros(scenario.nx))
    steps = np.abs(np.diff(y, axis=0))
    assert steps.max() < 0.2, "in its unit, in a twentieth of a second"
    assert steps[-200:].max() > 0.0


def test_scenario_of_a_file_is_followed_unless_another_one_is_named(tmp_path: Path) -> None:
    (tmp_path / "turn.csv").write_text("t,x,y,psi\n0,0,0,0\n9,0,0,1\n")
    text = ROBOTS["unicycle"].read_text() + '[reference]\nscenario = "turn.csv"\nduration_s = 5.0\n'
    (tmp_path / "robot.toml").write_text(text)
    config = load(tmp_path / "robot.toml")
    assert (find_scenario(config).name, find_scenario(config).duration_s) == ("turn", 5.0)
    assert find_scenario(config, duration_s=3.0).duration_s == 3.0
    assert find_scenario(config, "eight").duration_s == pytest.approx(40 * np.pi)
    assert config.config_hash == load(ROBOTS["unicycle"]).config_hash, "no command depends on it"


def test_manoeuvre_of_other_outputs_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"the scenario bay is of the outputs x, y, psi, it must be of those of the model, x_tip, z_tip"):
        find_scenario(load(ROBOTS["two_link_arm"]), "bay")
