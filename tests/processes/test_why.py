# SPDX-License-Identifier: Apache-2.0
"""Explanation of what a running controller has just done."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.in_time import on_time
from tests.processes.system import CONFIG, SPEED, System, rti_mpc, until

pytestmark = pytest.mark.slow
pytest.importorskip("mcap")

PERIOD_MS = 1e3 * CONFIG.ocp.dt_s / SPEED


def test_running_controller_is_explained_while_it_drives_on(tmp_path: Path, host: Host) -> None:
    """Beside another recorder, as in a demo."""
    with System(tmp_path, recorder=("record", "--out", tmp_path / "run.mcap")) as system:
        system.start("robot", "controller", "reference", "recorder")
        until(lambda: "recorder" in system.lives, "another one records")
        system.tracking()
        begun_ns = time.monotonic_ns()
        done = rti_mpc("why", "-e", system.endpoint, "--json")
        assert done.returncode == 0, done.stdout + done.stderr
        first = json.loads(done.stdout)
        assert first["replayed"] == "0 bits differ"
        assert first["robot"] == "pioneer"
        assert first["mode"] == "TRACKING" or not on_time(host, "the sample that is explained", PERIOD_MS, begun_ns)
        assert set(first["inputs"]) == {"u_c", "omega_c"}
        assert first["times"]["feedback_us"] > 0
        system.tracking()
        done = rti_mpc("why", "-e", system.endpoint, "--json")
        assert done.returncode == 0, done.stdout + done.stderr
        assert json.loads(done.stdout)["seq"] > first["seq"]
        assert rti_mpc("why", "-e", system.endpoint).stdout.startswith("command ")
        other = rti_mpc("why", "-e", system.endpoint, "--controller", "1")
        assert other.stderr.startswith("rti-mpc: the last 4 s of pioneer must hold the journal of a robot, controller 1, got --robot pioneer ")


def test_controller_that_does_not_run_is_explained_by_one_line() -> None:
    endpoint = free_endpoint()
    done = rti_mpc("why", "-e", endpoint)
    assert (done.returncode, done.stdout.count("INFO")) == (2, 0)
    needed = "rti-mpc: why needs a running controller, or a recording, RUN.mcap: in 4 s none of rti_mpc/pioneer was heard at "
    assert done.stderr == f"{needed}{endpoint}\n"
