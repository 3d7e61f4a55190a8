# SPDX-License-Identifier: Apache-2.0
"""
Units and drop-ins of a robot with TLS, started as systemd does, without it.

Each process has what `LoadCredential=` gives it, and nothing else: a folder of its own
with those files, which the process may read and not write, below `CREDENTIALS_DIRECTORY`.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest

from rti_mpc.contract.message import Command
from rti_mpc_service.shipped import DEPLOY
from tests.processes.system import command_line, environment, heard, until

pytest.importorskip("cryptography", reason="the extra certs is not installed: units with certificates were NOT started")

from tests.processes.secured import Secured

pytestmark = pytest.mark.slow

UNITS = {  # each with its drop-ins
    "router": ("rti-mpc-router@.service",),
    "guard": ("rti-mpc-guard@.service", "tls-guard.conf"),
    "run": ("rti-mpc@.service", "tls-controller.conf"),
    "standby": ("rti-mpc@.service", "tls-controller.conf", "standby.conf"),
}


def settings(command: str, etc: Path, instance: str) -> tuple[list[str], dict[str, Path]]:
    """Return the words of a unit's command and its credentials by their names; the last ExecStart= behind an empty one is the command."""
    text = "\n".join((DEPLOY / "systemd" / file).read_text() for file in UNITS[command])
    text = text.replace("%i", instance).replace("/etc/rti-mpc", str(etc))
    start = re.findall(r"^ExecStart=(.*)$", text, re.MULTILINE)
    assert start[1::2] == [""] * (len(start) // 2)
    program, *words = start[-1].split()
    assert program == "/opt/rti-mpc/bin/rti-mpc"
    return words, {name: Path(path) for name, path in re.findall(r"^LoadCredential=(\S+?):(\S+)$", text, re.MULTILINE)}


def test_processes_of_the_units_drive_the_robot_with_the_credentials_that_systemd_gives_them(tmp_path: Path) -> None:
    etc, bus = tmp_path / "etc", Secured(tmp_path)
    shutil.copytree(bus.tls, etc / "tls")
    for file in ("robot.toml", "robot.signals.json"):
        shutil.copy(tmp_path / file, etc)
    with ExitStack() as stack:

        def start(command: str) -> None:
            words, loaded = settings(command, etc, "robot")
            (folder := tmp_path / f"credentials-{command}").mkdir()
            for name, path in loaded.items():
                shutil.copy(path, folder / name)
                (folder / name).chmod(0o400)
            folder.chmod(0o500)
            env = {**environment(tmp_path / command), "CREDENTIALS_DIRECTORY": str(folder)}
            with (tmp_path / f"{command}.log").open("wb") as log:
                process = subprocess.Popen(command_line(*words), cwd="/", env=env, stdout=log, stderr=subprocess.STDOUT)
            stack.callback(process.wait)
            stack.callback(process.kill)
            bus.running[command] = process

        stack.callback(bus.close)
        for command in ("router", "guard", "run"):
            start(command)
        bus.start("sim", "reference")
        lives: set[str] = set()
        until(lambda: "routing" in bus.said("router"), "the router routes")
        viewer = bus.join("viewer")
        viewer.watch_alive(lambda role, present: (lives.add if present else lives.discard)(role.partition(".")[0]))
        command = heard(viewer.subscriber(bus.keys.actuation), Command, lambda command: command.mode.name == "TRACKING")
        start("standby")
        until(lambda: "standby" in lives, "a standby")
        bus.running["run"].kill()
        heard(viewer.subscriber(bus.keys.command), Command, lambda other: other.epoch > command.epoch and other.mode.name == "TRACKING")
