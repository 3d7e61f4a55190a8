# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from collections.abc import Iterator
from ipaddress import ip_address
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rti_mpc.wire.keys import Keys
from rti_mpc_service.cli import app
from rti_mpc_service.doctor import security
from rti_mpc_service.shipped import SHIPPED

pytest.importorskip("cryptography", reason="the extra certs is not installed: certificates were NOT tried")

from rti_mpc_service.certs.authority import Authority
from rti_mpc_service.certs.issue import issue

ROUTER = "tls/127.0.0.1:17447"


@pytest.fixture(autouse=True)
def nothing_listens(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever else runs on the host of the tests."""
    monkeypatch.setattr(security, "listening", lambda: iter(()))


@pytest.fixture
def secured(tmp_path: Path) -> Path:
    """A robot's TOML file, and certificates of its host beside it."""
    issue(Authority.make("ours", 100.0), Keys(), ["router", "guard"], ROUTER, tmp_path / "tls", tmp_path / "tls", 90.0)
    (tmp_path / "state").mkdir(mode=0o700)
    path = tmp_path / "robot.toml"
    path.write_text(SHIPPED.read_text() + '\n[bus]\ntls = "tls"\n')
    path.chmod(0o644)
    return path


def examine(path: Path) -> tuple[int, str, list[dict[str, str]]]:
    """Exit status, output and findings."""
    report = path.with_name("found.json")
    done = CliRunner().invoke(app, ["doctor", str(path), "--security", "--state", str(path.parent / "state"), "--json", str(report)])
    return done.exit_code, done.output, json.loads(report.read_text())["open"]


def opened(path: Path) -> Iterator[str]:
    yield from (f"{finding['what']}: {finding['here']}" for finding in examine(path)[2])


def test_bundle_as_it_is_issued_leaves_nothing_open(secured: Path) -> None:
    assert examine(secured) == (0, f"{secured}: nothing is open here\n", [])


def test_folder_without_certificates_is_a_finding(secured: Path) -> None:
    """A misspelt folder was told, by status 0, that nothing is open."""
    secured.write_text(secured.read_text().replace('tls = "tls"', 'tls = "tsl"'))
    status, _, found = examine(secured)
    told = [finding["here"] for finding in found if finding["what"] == "certificates"]
    assert (status, told) == (1, [f"{secured.parent / 'tsl'} has none: no process of this host starts with it"])


def test_each_thing_that_is_open_is_a_finding_of_its_own_with_what_to_do(secured: Path) -> None:
    tls, state = secured.parent / "tls", secured.parent / "state"
    text = secured.read_text().replace("live = false", "live = true") + 'listen = ["tcp/0.0.0.0:7447"]\n\n[debug]\ninject = true\n'
    secured.write_text(text)
    (tls / "router.json5").write_text((tls / "router.json5").read_text().replace('"default_permission": "deny"', '"default_permission": "allow"'))
    issue(Authority.make("ours", 100.0), Keys(), ["viewer"], ROUTER, tls.parent / "soon", tls, 29.0)
    (tls / "viewer.pem").write_bytes((tls.parent / "soon" / "viewer.pem").read_bytes())
    (tls / "guard.key").chmod(0o640)
    secured.chmod(0o666)
    state.chmod(0o770)
    (state / "stop.json").touch()
    (state / "stop.json").chmod(0o646)
    status, printed, found = examine(secured)
    assert [f"{finding['what']}: {finding['here']}" for finding in found] == [
        "configured listener: tcp/0.0.0.0:7447, beyond the loopback without TLS",
        f"access control list: {tls / 'router.json5'} has none that denies by default",
        "live parameters: params.live = true",
        "fault injection: debug.inject = true",
        f"certificate: {tls / 'viewer.pem'} ends in 29.0 days",
        f"private key: {tls / 'guard.key'} is for its group, too",
        f"configuration: everybody may write {secured}",
        f"state directory: its group may write {state}",
        f"stop of an operator: everybody may write {state / 'stop.json'}",
    ]
    assert (status, printed.splitlines()[-1]) == (1, f"{secured}: 9 findings")
    assert all(finding["do"] for finding in found)
    assert f"chmod 600 {tls / 'guard.key'}" in "".join(finding["do"] for finding in found)


def test_bus_without_certificates_is_open_also_on_the_loopback(secured: Path) -> None:
    secured.write_text(SHIPPED.read_text())
    assert list(opened(secured)) == ["TLS: none: whoever reaches the bus commands the robot"]


def test_bus_with_a_configuration_of_zenoh_whose_endpoints_are_all_of_tls_is_not_called_open(secured: Path) -> None:
    secured.write_text(SHIPPED.read_text() + '\n[bus]\nconfig = "zenoh.json5"\n')
    client = secured.with_name("zenoh.json5")
    client.write_text('{mode: "client", connect: {endpoints: ["tls/robot.local:7447"]}}')
    assert list(opened(secured)) == []
    client.write_text('{mode: "client", connect: {endpoints: ["tcp/robot.local:7447"]}}')
    assert list(opened(secured)) == ["TLS: none: whoever reaches the bus commands the robot"]


def test_certificate_that_has_ended_and_one_that_cannot_be_read_are_told(secured: Path) -> None:
    (secured.parent / "tls" / "guard.pem").write_text("-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n")
    issue(Authority.make("ours", 100.0), Keys(), ["viewer"], ROUTER, secured.parent / "ended", secured.parent, -0.01)
    (secured.parent / "tls" / "viewer.pem").write_bytes((secured.parent / "ended" / "viewer.pem").read_bytes())
    ended, unreadable = sorted(opened(secured), reverse=True)
    assert ended == f"certificate: {secured.parent / 'tls' / 'viewer.pem'} has ended"
    assert unreadable.startswith(f"certificate: {secured.parent / 'tls' / 'guard.pem'}: must be a certificate, PEM")


def test_certificate_of_another_private_key_is_told(secured: Path) -> None:
    tls = secured.parent / "tls"
    (tls / "guard.key").write_bytes((tls / "router.key").read_bytes())
    told = f"certificate: {tls / 'guard.key'} must be the private key of {tls / 'guard.pem'}, got that of another certificate"
    assert list(opened(secured)) == [told]


def test_process_of_ours_that_takes_everybody_beyond_the_loopback_is_a_finding_and_others_are_none(
    secured: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, int]] = []
    found = [("0.0.0.0", 7447, "rti-mpc (12)"), ("10.0.0.2", 17447, ""), ("127.0.0.1", 7447, "rti-mpc (13)"), ("0.0.0.0", 22, "")]
    monkeypatch.setattr(security, "listening", lambda: ((ip_address(address), port, program) for address, port, program in found))
    monkeypatch.setattr(security, "openness", lambda host, port: asked.append((host, port)) or "without TLS")
    assert list(opened(secured)) == [
        "listener: rti-mpc (12) on 0.0.0.0, port 7447, without TLS",
        "listener: a process of another user on 10.0.0.2, port 17447, without TLS",
    ]
    assert asked == [("127.0.0.1", 7447), ("10.0.0.2", 17447)]
