# SPDX-License-Identifier: Apache-2.0
"""Processes with certificates of other roles or robots, which say that they are not heard, beside others that are."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from rti_mpc.contract.message import Command
from rti_mpc.wire.keys import Keys
from tests.processes.system import ROOT, command_line, environment, heard, until

pytest.importorskip("cryptography", reason="the extra certs is not installed: certificates were NOT tried")

from rti_mpc_service.certs.issue import issue
from tests.processes.test_secured import Secured

pytestmark = pytest.mark.slow

UNHEARD = "connected, but not heard"


def disguised(system: Secured, source: Path, role: str, wanted: str) -> Path:
    """Return a folder in which the certificate of a role has the name of another role."""
    folder = system.folder / f"{role} as {wanted}"
    folder.mkdir()
    (folder / "authority.pem").write_bytes((system.tls / "authority.pem").read_bytes())
    for end in ("pem", "key", "json5"):
        (folder / f"{wanted}.{end}").write_bytes((source / f"{role}.{end}").read_bytes())
    (folder / f"{wanted}.key").chmod(0o600)
    return folder


def test_process_with_a_wrong_certificate_says_once_that_it_is_not_heard_and_others_never_do(tmp_path: Path) -> None:
    system = Secured(tmp_path)
    issue(system.authority, Keys(robot="other"), ["controller"], system.endpoint, tmp_path / "other", tmp_path, 1.0)
    wrong = {
        "reference": disguised(system, system.tls, "viewer", "planner"),
        "run": disguised(system, tmp_path / "other", "controller", "controller"),
        "sim": disguised(system, system.tls, "planner", "robot"),
    }
    intruders = []

    def intrude(command: str) -> None:
        with (tmp_path / f"wrong {command}.log").open("wb") as log:
            line = command_line(command, system.config, "--tls", wrong[command])
            state = environment(tmp_path / "another state")
            intruders.append(subprocess.Popen(line, cwd=ROOT, env=state, stdout=log, stderr=subprocess.STDOUT))

    try:
        system.start("router")
        until(lambda: "routing" in system.said("router"), "the router routes")
        intrude("reference")  # beside one that is heard it would not start
        until(lambda: UNHEARD in system.said("wrong reference"), "the wrong reference says that it is not heard")
        system.start("reference", "sim", "guard", "run")
        commands = system.join("viewer").subscriber(system.keys.actuation)
        heard(commands, Command, lambda command: command.mode.name == "TRACKING")
        intrude("run")
        intrude("sim")
        for command, role in (("reference", "reference"), ("run", "controller"), ("sim", "robot")):
            until(lambda command=command: UNHEARD in system.said(f"wrong {command}"), f"the wrong {command} says that it is not heard")
            said = [text for line in system.said(f"wrong {command}").splitlines() if UNHEARD in (text := json.loads(line)["text"])]
            assert len(said) == 1
            assert said[0].startswith(f"{UNHEARD} as {role}: see the router's log; is {wrong[command]}/")
        heard(commands, Command, lambda command: command.mode.name == "TRACKING")
        for command in ("reference", "sim", "guard", "run"):  # which have looked before
            assert UNHEARD not in system.said(command), command
        for name in ("viewer@rti_mpc/pioneer", "controller@rti_mpc/other", "planner@rti_mpc/pioneer"):
            assert f'"{name} at 127.0.0.1:' in system.said("router"), "its log names who it was"
    finally:
        for process in intruders:
            process.kill()
            process.wait()
        system.close()
