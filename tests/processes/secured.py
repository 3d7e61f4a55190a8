# SPDX-License-Identifier: Apache-2.0
"""Router with TLS on the loopback, certificates of all roles, and those that must not help anybody in. Needs the extra `certs`."""

from __future__ import annotations

import json
import subprocess
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest import mock

from cryptography.hazmat.primitives.serialization import load_pem_private_key

from rti_mpc.wire import session
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.certs.authority import Authority, pem
from rti_mpc_service.certs.folder import secured
from rti_mpc_service.certs.issue import issue, make_authority
from rti_mpc_service.certs.roles import ROLES, ROLES_OF_COMMAND, common_name
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.guarded import write_robot
from tests.processes.system import ROOT, command_line, environment, until

PROGRAMS: dict[str, tuple[object, ...]] = {
    "router": (),
    "sim": ("--x0", "x=0.5"),
    "guard": (),
    "run": (),
    "reference": ("--scenario", "eight", "--duration", 600),
}
COMMAND_OF = {roles[0]: command for command, roles in ROLES_OF_COMMAND.items()}  # which prefers that role to others in the same folder


def join_unchecked(settings: BusSettings, keys: Keys, timeout_s: float) -> Bus:
    """Join as a program of somebody else, which does not look at its own files before, so that the router has to."""
    with mock.patch.object(session, "check_credentials"):
        return Bus.join(settings, keys, timeout_s=timeout_s)


class Secured:
    """A router with TLS and its list for one robot, which `start` starts, and certificates of all roles."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config = write_robot(folder / "robot.toml")
        self.keys = Keys()
        self.endpoint = free_endpoint().replace("tcp/", "tls/")
        make_authority(folder / "authority", 10.0)
        self.authority = Authority.read(folder / "authority")
        self.tls = folder / "tls"
        issue(self.authority, self.keys, list(ROLES), self.endpoint, self.tls, self.tls, 1.0)
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Secured:
        """Start the router."""
        try:
            self.start("router")
            until(lambda: "routing" in self.said("router"), "the router routes")
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self, *commands: str) -> None:
        for command in commands:
            with (self.folder / f"{command}.log").open("ab") as log:
                line = command_line(command, self.config, "--tls", self.tls, *PROGRAMS[command])
                self.running[command] = subprocess.Popen(line, cwd=ROOT, env=environment(self.folder / "state"), stdout=log, stderr=subprocess.STDOUT)

    def said(self, command: str) -> str:
        return (self.folder / f"{command}.log").read_text(errors="replace")

    def join(self, role: str, folder: Path | None = None, keys: Keys | None = None, **changes: Any) -> Bus:
        """Join as a role, with the certificate of a folder."""
        return self._stack.enter_context(Bus.join(self.settings(role, folder, **changes), keys or self.keys, timeout_s=3.0))

    def settings(self, role: str, folder: Path | None = None, **changes: Any) -> BusSettings:
        """Return how to join as a role, with the certificate of a folder."""
        return replace(secured(BusSettings(), folder or self.tls, COMMAND_OF[role]), **changes)

    def bundle(self, name: str, keys: Keys | None = None, authority: Authority | None = None, **times: Any) -> Path:
        """Return a folder with another certificate of a controller, by any authority, and with ours to trust."""
        folder, keys = self.folder / name, keys or self.keys
        issue(authority or self.authority, keys, ["controller"], self.endpoint, folder, folder, 1.0)
        (folder / "authority.pem").write_bytes((self.tls / "authority.pem").read_bytes())
        if times:
            key = load_pem_private_key((folder / "controller.key").read_bytes(), None)
            (folder / "controller.pem").write_bytes(pem(self.authority.certify(common_name("controller", keys), key.public_key(), 1.0, **times)))
        return folder

    def outsiders(self) -> dict[str, BusSettings]:
        """Return how those try to join that the router must refuse."""
        bare: dict[str, Any] = {"authority": None, "certificate": None, "key": None, "connect": (self.endpoint,)}
        address = self.endpoint.removeprefix("tls/")
        anonymous = self.folder / "anonymous.json5"
        anonymous.write_text(json.dumps({"mode": "client", "transport": {"link": {"tls": {"root_ca_certificate": str(self.tls / "authority.pem")}}}}))
        return {
            "foreign": self.settings("controller", self.bundle("foreign", authority=Authority.make("foreign", 10.0))),
            "expired": self.settings("controller", self.bundle("expired", now=datetime.now(UTC) - timedelta(days=3))),
            "without a certificate": self.settings("controller", **bare | {"config": anonymous}),
            "plain TCP": self.settings("controller", **bare | {"config": None, "mode": "client", "connect": (f"tcp/{address}",)}),
        }

    def close(self) -> None:
        self._stack.close()
        for process in self.running.values():
            process.kill()
            process.wait()
