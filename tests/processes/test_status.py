# SPDX-License-Identifier: Apache-2.0
"""Status of two robots on one bus, as a table and for scripts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.shipped import SHIPPED
from tests.processes.system import System, rti_mpc, until

pytestmark = pytest.mark.slow


def test_status_shows_two_robots_and_who_leads_each(tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_text(SHIPPED.read_text().replace('robot = "pioneer"', 'robot = "other"'))
    listen = ("-l", "tcp/127.0.0.1:0")
    with System(tmp_path) as system:
        system.start("robot", "controller", "reference")
        for role, words in (("other robot", ("sim", *listen)), ("other controller", ("run",))):
            system.config, system.arguments = other, system.arguments | {role: words}
            system.start(role)
        system.tracking()

        def seen() -> dict | None:
            done = rti_mpc("status", other, "-e", system.endpoint, "--json")
            robots = json.loads(done.stdout)["robots"]
            there = set(robots) == {"other", "pioneer"} and all(robot["leader"] for robot in robots.values())
            return robots if there and robots["pioneer"]["mode"] == "TRACKING" and done.returncode == 0 else None

        robots = until(seen, "both are seen", pause_s=0.2)
        assert robots["pioneer"]["error"]["position"]["unit"] == "mm"
        assert robots["other"]["reference_left_s"] is None
        assert robots["pioneer"]["versions"].keys() == {"controller", "robot"}
        assert robots["pioneer"]["leader"]["owner"] != robots["other"]["leader"]["owner"]
        printed = rti_mpc("status", "-e", system.endpoint, "--once")
        assert printed.returncode == 0
        assert "pioneer" in printed.stdout
        assert "tracking" in printed.stdout
        assert "other" in printed.stdout


def test_status_of_a_bus_that_is_not_there_is_exit_status_1_and_says_so() -> None:
    endpoint = free_endpoint()
    done = rti_mpc("status", "-e", endpoint, "--once", "--timeout", 0.5)
    assert done.returncode == 1
    assert done.stdout.startswith(f"no process of any robot is present at rti_mpc/*: no process answers at {endpoint}")
