# SPDX-License-Identifier: Apache-2.0
"""
From empty hosts to a secured robot, by the three commands of each page that has them, as they stand there.

Robot and desk are network namespaces, where root and `ip` are there. The commands run on
a computer that is neither; its bundles are copied, and the roles that they were issued
for say which processes run where.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rti_mpc_service.certs.roles import ROLES_OF_COMMAND
from rti_mpc_service.scenario import find_trajectory
from tests.guarded import GUARDED
from tests.processes.network import Network, missing
from tests.processes.overheard import Overheard
from tests.processes.system import ANSWERED, ROOT, command_line, until

pytest.importorskip("cryptography", reason="the extra certs is not installed: three commands were NOT tried")

pytestmark = pytest.mark.slow

PAGES = {"runbook": ("deploy/runbook.md", "Secure the bus"), "security": ("docs/security.md", "In three commands")}
PROGRAMS = ("router", "sim", "guard", "run", "reference")
NEAR_M, DRIVEN_M = 0.1, 0.5  # of the path, and along it


@pytest.fixture
def network() -> Iterator[Network]:
    if reason := missing():
        pytest.skip(reason)
    with Network("robot", "desk") as network:
        yield network


@pytest.mark.parametrize("page", PAGES)
def test_three_commands_of_a_page_secure_a_robot_that_a_desk_drives_and_stops_over_the_network(page: str, network: Network, tmp_path: Path) -> None:
    path, heading = PAGES[page]
    section = (ROOT / path).read_text().partition(f"## {heading}\n")[2].partition("\n## ")[0]
    commands = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)[0].splitlines()
    assert len(commands) == 3
    toml = re.findall(r"```toml\n(.*?)```", section, re.DOTALL)
    robot = next(word for word in commands[1].split() if word.endswith(".toml"))

    (office := tmp_path / "office").mkdir()
    (office / robot).write_text((ROOT / "deploy" / "pioneer_3dx.toml").read_text() + GUARDED)
    bundles: dict[str, list[str]] = {}  # roles, by host
    for line in commands:
        _, *words = shlex.split(line)
        run(office, *words)
        if "issue" in words:
            bundles[words[words.index("--out") + 1]] = words[words.index(robot) + 1 : words.index("--router")]
    assert bundles.keys() == {"robot", "desk"}
    run(office, "check", robot)

    for host in bundles:
        (folder := tmp_path / host).mkdir()
        shutil.move(office / host, folder / "tls")
        (folder / robot).write_text((office / robot).read_text() + "".join(toml))
        shutil.copy(office / f"{Path(robot).stem}.signals.json", folder)
    assert [found.parent.parent.name for found in tmp_path.rglob("authority.key")] == ["office"]
    network.names = tmp_path / "names"
    network.names.write_text(f"127.0.0.1 localhost\n{network.address('robot')} {re.findall(r'tls/([^:]+):', commands[1])[0]}\n")

    meeting = () if toml else ("--tls", "tls")
    heard = Overheard(tmp_path / "heard.jsonl")
    heard.path.touch()
    hosts = {command: next(host for host, roles in bundles.items() if {*ROLES_OF_COMMAND[command]} & {*roles}) for command in (*PROGRAMS, "stop")}
    for command in PROGRAMS:
        network.start(command, hosts[command], "rti_mpc_service.cli", command, robot, *meeting, folder=tmp_path, cwd=tmp_path / hosts[command])
    network.start("heard", "desk", "tests.processes.overheard", tmp_path / "desk" / "tls", heard.path, folder=tmp_path)
    on_the_eight = find_trajectory("eight", 0.25).position(np.linspace(0.0, 60.0, 6000))

    def driven() -> bool:
        states = np.array([state["x"] for state in heard.listen().streams["state"]])
        if len(states) < 2 or np.hypot(*np.diff(states[:, :2], axis=0).T).sum() < DRIVEN_M:
            return False
        return bool(np.hypot(*(states[-1, :2] - on_the_eight).T).min() < NEAR_M)

    until(driven, "the robot is driven along its path", pause_s=0.1)
    assert asked(network, "stop", robot, *meeting, cwd=tmp_path / hosts["stop"])["role"] == "guard"
    until(lambda: np.abs(heard.listen().streams["state"][-1]["x"][3:]).max() < 1e-3, "the robot stands", pause_s=0.1)
    assert asked(network, "enable", robot, *meeting, cwd=tmp_path / hosts["stop"])["ok"] is True
    until(lambda: np.abs(heard.listen().streams["state"][-1]["x"][3]) > 0.05, "the robot drives again", pause_s=0.1)
    for command in PROGRAMS:
        assert network.running[command].poll() is None, (tmp_path / f"{command}.log").read_text()


def run(folder: Path, *words: str) -> None:
    """Run a command in a folder, without a network of its own."""
    done = subprocess.run(command_line(*words), cwd=folder, capture_output=True, text=True, timeout=120.0)
    assert done.returncode == 0, done.stderr


def asked(network: Network, *words: str, cwd: Path) -> dict[str, Any]:
    """Return the answer to an operator on the desk."""
    done = network.run("desk", "rti_mpc_service.cli", *words, *ANSWERED, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))
