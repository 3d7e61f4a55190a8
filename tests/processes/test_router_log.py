# SPDX-License-Identifier: Apache-2.0
"""Log of a real router about those whom it refuses, and its silence about all others."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from rti_mpc.contract.message import Command, State
from rti_mpc.errors import ConfigError
from rti_mpc.wire.keys import Keys
from tests.processes.system import ANSWERED, PATIENCE_S, heard, rti_mpc, until

pytest.importorskip("cryptography", reason="the extra certs is not installed: certificates were NOT tried")

from rti_mpc_service.certs.authority import Authority, new_key, pem
from rti_mpc_service.certs.issue import issue
from tests.processes.test_secured import Secured, join_unchecked

pytestmark = pytest.mark.slow


@pytest.fixture
def system(tmp_path: Path) -> Iterator[Secured]:
    """A router that is up."""
    secured = Secured(tmp_path)
    try:
        secured.start("router")
        until(lambda: "routing" in secured.said("router"), "the router routes")
        yield secured
    finally:
        secured.close()


def warnings(system: Secured) -> list[str]:
    """Lines of the router's log beside those about its own certificate, and about clients that left during a handshake, as on a busy host."""
    lines = (json.loads(line) for line in system.said("router").splitlines())
    return [line["text"] for line in lines if line["level"] != "INFO" and not re.search("ends in|handshake eof", line["text"])]


def test_refused_connections_and_denials_are_a_line_each(system: Secured, tmp_path: Path) -> None:
    for name in ("ended", "foreign", "other"):
        signer = Authority.make("foreign", 10.0) if name == "foreign" else system.authority
        robot = Keys(robot="other") if name == "other" else system.keys
        issue(signer, robot, ["robot", "controller"], system.endpoint, tmp_path / name, tmp_path / name, 1.0)
    key = new_key()
    ended = system.authority.certify("robot@rti_mpc/pioneer", key.public_key(), 1.0, now=datetime.now(UTC) - timedelta(days=3))
    for file, content in (("robot.pem", pem(ended)), ("robot.key", pem(key))):
        (tmp_path / "ended" / file).write_bytes(content)
    (tmp_path / "foreign" / "authority.pem").write_bytes((system.tls / "authority.pem").read_bytes())
    for folder in ("ended", "foreign"):
        with pytest.raises(ConfigError, match="none has answered"):
            join_unchecked(system.settings("robot", tmp_path / folder), system.keys, 3.0)
    plain = {"connect": (system.endpoint.replace("tls/", "tcp/"),), "mode": "client", "config": None}
    with pytest.raises(ConfigError, match="none has answered"):
        system.join("robot", **plain, authority=None, certificate=None, key=None)
    reasons = ("its certificate has ended", "its certificate is of another authority", "it does not speak TLS")
    asked = "a connection was refused: it has no certificate"  # by the process without TLS, to find out why it is refused
    said = until(lambda: len(told := [text for text in warnings(system) if text != asked]) > 2 and told, "the router says why")
    assert said == [f"a connection was refused: {reason}" for reason in reasons]
    viewer = system.join("viewer")
    for _ in range(500):  # more than a pipe would hold: nothing else gets into the log, every line of which is read here
        viewer.publisher(system.keys.command).put_bytes(b"forged")
    system.join("controller", tmp_path / "other", keys=system.keys).publisher(system.keys.command).put_bytes(b"forged")
    told = until(lambda: len(told := [text for text in warnings(system) if "denied" in text]) > 1 and told, "the router says whom it denies")
    unknown, denied = sorted(told)  # the router may take what the viewer has sent after the controller has joined
    assert denied.startswith("viewer@rti_mpc/pioneer at 127.0.0.1:")
    assert denied.endswith(" is denied what its role may not write")
    assert unknown.startswith("controller@rti_mpc/other at 127.0.0.1:")
    assert unknown.endswith(" is denied everything: the access control list does not have its name")


def test_router_has_nothing_to_say_about_a_system_in_which_each_process_has_its_own_role(system: Secured) -> None:
    system.start("reference", "sim", "guard", "run")
    viewer = system.join("viewer")
    commands = viewer.subscriber(viewer.keys.actuation)
    heard(commands, Command, lambda command: command.mode.name == "TRACKING")
    for request in ("stop", "enable"):
        done = rti_mpc(request, system.config, "--tls", system.tls, *ANSWERED)
        assert done.returncode == 0, done.stderr
    heard(commands, Command, lambda command: command.mode.name == "TRACKING")
    heard(viewer.subscriber(viewer.keys.state), State, lambda _: True)
    for name in ("run", "guard", "reference", "sim"):
        system.running[name].terminate()
        system.running[name].wait(PATIENCE_S)
    assert warnings(system) == []
