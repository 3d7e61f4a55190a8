# SPDX-License-Identifier: Apache-2.0
"""Every robot that ships, as the whole system, and with its controller killed."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from rti_mpc.model.find import find_model
from rti_mpc_service.config.config import load
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.shipped import ROBOTS
from tests.in_time import MS
from tests.processes.system import rti_mpc

pytestmark = pytest.mark.slow
pytest.importorskip("matplotlib")

# Robot time in s, and its speed: the shorter the period, the nearer to real time.
RUNS = {
    "quadrotor": (6, 0.5),
    "quadrotor_quaternion": (6, 0.5),
    "dynamic_bicycle": (6, 1),
    "two_link_arm": (6, 1),
    "kinematic_bicycle": (8, 2),
    "chain": (20, 8),
    "truck_trailer": (30, 10),
}
RUN = (12, 4)


@pytest.mark.parametrize("name", ROBOTS)
def test_robot_is_driven_by_the_whole_system(name: str, tmp_path: Path) -> None:
    duration_s, speed = RUNS.get(name, RUN)
    done = rti_mpc("demo", "--robot", name, "--duration", duration_s, "--speed", speed, "--out", tmp_path / "out", timeout_s=300.0)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["driven"]
    assert summary["commanded_inputs_in_bounds"]
    assert summary["commanded_increments_in_bounds"]
    assert list(summary["outputs"]) == [output.name for output in find_model(name).outputs]
    assert (tmp_path / "out" / "run.png").stat().st_size > 20_000


@pytest.mark.parametrize("name", ["kinematic_bicycle", "quadrotor", "cart_pole"])
def test_robot_bears_the_death_of_its_controller_as_its_class_promises(name: str) -> None:
    """One that drifts, one that falls, one that coasts; `test_faults` has one that holds at rest."""
    valid_ms = 1e3 * load(ROBOTS[name], with_model=False).timing.valid_s
    with Host() as host:
        since_ns = time.monotonic_ns()
        done = rti_mpc("faults", "--robot", name, "--only", "controller_killed", timeout_s=900.0)  # a busy host is waited for
        held_up_ms = host.worst_ms(since_ns, time.monotonic_ns(), round(2 * valid_ms * MS))
    if done.returncode != 0 and held_up_ms > valid_ms:
        pytest.skip(f"the host held processes up for {held_up_ms:.0f} ms, longer than a plan of {name} is valid: {done.stdout}")
    assert done.returncode == 0, done.stdout + done.stderr
