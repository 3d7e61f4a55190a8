# SPDX-License-Identifier: Apache-2.0
"""Faults injected into real processes by the command that users run. Times are the robot's own, at speed 1."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from rti_mpc_service.config.config import load
from rti_mpc_service.faults.promise import BRAKING
from rti_mpc_service.faults.system import System, Wiring
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.shipped import SHIPPED
from tests.command import command
from tests.in_time import MS, SEEN
from tests.movers import CURRENT, path_file, toml
from tests.processes.system import CONFIG, rti_mpc

PERIOD_MS = 1e3 * CONFIG.ocp.dt_s
UNHEARD_MS = 500.0  # of the journal of one that is killed, its last tenths of a second


def matrix(path: Path, *names: str, robot: tuple[object, ...] = (), timeout_s: float = 180.0) -> dict[str, dict[str, Any]]:
    """Rows by name, as written to a file; the exit status agrees with them."""
    done = rti_mpc("faults", *robot, *(word for name in names for word in ("--only", name)), "--json", path, timeout_s=timeout_s)
    rows = json.loads(path.read_text())
    assert done.returncode == int(not all(row["kept"] for row in rows)), done.stdout + done.stderr
    assert f"{sum(row['kept'] for row in rows)} of {len(rows)} within their promise" in done.stdout
    return {row["name"]: row for row in rows}


@pytest.mark.parametrize(
    "names",
    [
        ("controller_killed",),
        ("guard_and_controller_killed",),
        ("link_cut",),
        ("state_nan",),
        ("stop_then_controller_killed",),
    ],
    ids="-".join,
)
@pytest.mark.slow
def test_robot_stops_in_time_and_drives_again(tmp_path: Path, names: tuple[str, ...]) -> None:
    rows = matrix(tmp_path / "faults.json", *names)
    assert tuple(rows) == names
    for row in rows.values():
        assert row["kept"], row
        assert 0.0 < row["brake_s"] <= row["zero_s"] < row["still_s"]
        assert row["excused"] or (row["brake_s"] <= BRAKING["brake_s"] == 0.3 and row["zero_s"] <= BRAKING["zero_s"] == 0.5 and row["still_s"] <= 2.5)
        assert row["recovery_s"] > 0.0
        assert row["robot"] == "braked, stood, drove again"


def test_unknown_fault_is_one_line_that_names_the_nearest() -> None:
    done = command("faults", "--only", "controller_kiled")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "perhaps controller_killed is meant" in done.stderr
    assert done.stderr.endswith("got 'controller_kiled'\n")


def test_scenario_that_comes_to_rest_is_one_line_before_anything_is_started() -> None:
    done = command("faults", "--scenario", "positioning")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "rti-mpc: --scenario must move the robot for at least 60 s, positioning does for 15.8 s\n"


def test_a_viewer_that_was_killed_is_followed_by_another_which_saves_to_a_file_of_its_own(tmp_path: Path) -> None:
    """As before each further fault of a viewer: a command that saves overwrites nothing."""
    pytest.importorskip("rerun")
    folder = tmp_path / "system"
    with System(load(SHIPPED), Wiring.PEERS, folder, Event()) as system:
        for saved in (1, 2):
            system.ensure("viewer")
            system.wait(lambda saved=saved: len(list(folder.glob("*.rrd"))) == saved, "a file of its own")
            system.kill("viewer")


@pytest.mark.slow
def test_robot_is_tested_on_waypoints(tmp_path: Path) -> None:
    """By a fault that waits for the robot to have come to its path, which it then follows at the speed that was asked for."""
    (tmp_path / "line.csv").write_text("x,y\n0,0\n0,30\n")
    rows = matrix(tmp_path / "faults.json", "solver_fails", robot=("--scenario", tmp_path / "line.csv", "--waypoint-speed", 0.4))
    assert rows["solver_fails"]["kept"], rows
    assert rows["solver_fails"]["speed_m_s"] == pytest.approx(0.4, abs=0.02)  # the eight is followed at 0.23 at most


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "files", "controllers"),
    [
        (("controller_killed", "clock_back"), ["00-peers.mcap", "01-sensor.mcap"], 3),
        (("link_cut", "state_late"), ["00-router.mcap", "01-link.mcap"], 2),
    ],
    ids=["peers", "links"],
)
def test_recordings_of_faults_replay_without_a_differing_bit(
    tmp_path: Path, names: tuple[str, ...], files: list[str], controllers: int, host: Host
) -> None:
    """A fault of each wiring: a controller killed, and its successor; a clock that jumps; a link that is cut; late states. Gaps are said."""
    pytest.importorskip("mcap")
    recordings = tmp_path / "recordings"
    begun_ns = time.monotonic_ns()
    rows = matrix(tmp_path / "faults.json", *names, robot=("--record", recordings))
    assert tuple(rows) == names
    assert sorted(path.name for path in recordings.iterdir()) == files
    accounts = replayed(host, recordings, tmp_path / "replay.json", begun_ns)
    assert len(accounts) == controllers


def replayed(host: Host, recordings: Path, told: Path, begun_ns: int) -> list[dict[str, Any]]:
    """Replay recordings of faults just made, and return what was compared: every command was repeated, but for those whose entries nobody heard."""
    made_ns = time.monotonic_ns()
    done = rti_mpc("replay", recordings, "--json", told, timeout_s=600.0)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
    accounts: list[dict[str, Any]] = json.loads(told.read_text())
    for account in accounts:
        assert (account["differing"], account["other"]) == (0, [])
        assert account["commands"] > 0
        unheard_ms = PERIOD_MS * account["commands_not_covered"]
        by_ms = unheard_ms - UNHEARD_MS
        assert by_ms <= 0.0 or host.worst_ms(begun_ns, made_ns, round(unheard_ms * MS)) >= SEEN * by_ms, account
    return accounts


@pytest.mark.slow
@pytest.mark.skipif("CI" in os.environ, reason="the rows above are its short form")
def test_whole_matrix_is_within_its_promises_and_its_recordings_replay_without_a_differing_bit(tmp_path: Path, host: Host) -> None:
    pytest.importorskip("mcap")
    begun_ns = time.monotonic_ns()
    rows = matrix(tmp_path / "faults.json", robot=("--record", tmp_path / "recordings"), timeout_s=1800.0)
    replayed(host, tmp_path / "recordings", tmp_path / "replay.json", begun_ns)
    assert {name: row["broken"] for name, row in rows.items() if not row["kept"]} == {}


@pytest.mark.slow
@pytest.mark.skipif("CI" in os.environ, reason="it takes half an hour; test_stops.py is the short form")
@pytest.mark.parametrize(("name", "more"), [("car", ""), ("quadrotor", ""), ("floating", CURRENT)])
def test_whole_matrix_of_a_robot_with_a_way_to_rest_is_within_its_promises(name: str, more: str, tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text(toml(name, more))
    rows = matrix(tmp_path / "faults.json", robot=(tmp_path / "robot.toml", "--scenario", path_file(name, tmp_path)), timeout_s=2400.0)
    assert {fault: row["broken"] for fault, row in rows.items() if not row["kept"]} == {}
