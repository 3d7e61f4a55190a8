# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import zenoh
from typer.testing import CliRunner

from rti_mpc.errors import ConfigError
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.session import BusSettings, open_endpoints, zenoh_config
from rti_mpc.wire.streams import PING, PONG, RELAY, STREAMS, Kind
from rti_mpc_service.certs.access import access_control, zenoh_configuration
from rti_mpc_service.certs.folder import credentials, secured
from rti_mpc_service.certs.roles import ROLES, ROLES_OF_COMMAND, common_name
from rti_mpc_service.cli import app
from rti_mpc_service.config.config import load
from rti_mpc_service.shipped import SHIPPED

pytest.importorskip("cryptography", reason="the extra certs is not installed: certificates were NOT tried")

from cryptography.hazmat.primitives import serialization

from rti_mpc_service.certs.authority import Authority, addresses_of, days_left, name_of, pem, read_certificate
from rti_mpc_service.certs.issue import issue, make_authority, renew

KEYS = Keys()
ROUTER = "tls/robot.local:7447"


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    make_authority(tmp_path / "authority", 100.0)
    return Authority.read(tmp_path / "authority")


def key_of(path: Path) -> Any:
    """Return the public half of a private key."""
    return serialization.load_pem_private_key(path.read_bytes(), None).public_key()


def make(authority: Authority, folder: Path, *roles: str, days: float = 10.0) -> Path:
    issue(authority, KEYS, roles, ROUTER, folder, folder, days)
    return folder


def test_private_keys_are_for_their_owner_alone_and_nothing_is_overwritten(authority: Authority, tmp_path: Path) -> None:
    host = make(authority, tmp_path / "host", "router", "guard")
    for key in (tmp_path / "authority" / "authority.key", host / "router.key", host / "guard.key"):
        assert key.stat().st_mode & 0o777 == 0o600
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(ConfigError, match=r"must not be overwritten, got .*guard\.key"):
        make(authority, host, "robot", "guard")
    with pytest.raises(ConfigError, match=r"must not be overwritten, got .*authority\.pem"):
        make_authority(tmp_path / "authority", 1.0)
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    make(authority, host, "robot")  # a further role of the same host
    with pytest.raises(ConfigError, match="must be a folder of this authority"):
        make(Authority.make("another", 1.0), host, "viewer")


def test_renewal_keeps_name_and_key_and_needs_no_private_key(authority: Authority, tmp_path: Path) -> None:
    host = make(authority, tmp_path / "host", "router", days=1.0)
    (host / "router.key").unlink()
    before = read_certificate(host / "router.pem")
    assert renew(authority, host, 50.0) == [host / "router.pem"]
    after = read_certificate(host / "router.pem")
    assert (name_of(after), after.public_key()) == (name_of(before), before.public_key())
    assert addresses_of(after) == addresses_of(before) == ["robot.local", "localhost", "127.0.0.1", "::1"]
    assert days_left(before) < 1.0
    assert days_left(after) == pytest.approx(50.0, abs=0.1)  # a test does not last two hours
    with pytest.raises(ConfigError, match="got another one"):
        renew(Authority.make("another", 1.0), host, 1.0)


def test_no_certificate_outlives_its_authority(authority: Authority, tmp_path: Path) -> None:
    host = make(authority, tmp_path / "host", "viewer", days=1000.0)
    assert days_left(read_certificate(host / "viewer.pem")) == pytest.approx(100.0, abs=0.1)


def test_commands_make_bundles_and_show_what_ends_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = CliRunner()

    def status(*words: object) -> int:
        return run.invoke(app, ["certs", *map(str, words)]).exit_code

    assert status("authority") == 0
    assert status("issue", SHIPPED, "controller", "--router", ROUTER, "--out", "desk", "--days", 90) == 0
    assert status("show", "desk") == 0
    assert status("renew", "desk", "--days", 29) == 0
    assert status("show", "desk") == 1
    shown = run.invoke(app, ["certs", "show", "desk"]).output
    assert f"desk/controller.pem: {common_name('controller', load(SHIPPED, with_model=False).keys())}, valid for 29.0 days" in shown


def test_certificate_that_no_process_can_use_is_told_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    host, other = Path("host"), Path("other")
    authority = Authority.make("authority", 100.0)
    make(authority, host, "router", "guard", "robot", "controller", days=90.0)
    make(Authority.make("another", 100.0), other, "controller", days=90.0)
    (host / "guard.key").write_bytes((host / "robot.key").read_bytes())
    (host / "robot.pem").write_bytes(pem(authority.certify(common_name("viewer", KEYS), key_of(host / "robot.key"), 90.0)))
    for name in ("controller.pem", "controller.key"):
        (host / name).write_bytes((other / name).read_bytes())
    (host / "router.key").unlink()  # on the authority's computer there are no private keys
    result = CliRunner().invoke(app, ["certs", "show", "host"])
    lines = dict(line.split(": ", 1) for line in result.output.splitlines())
    until = f"until {read_certificate(host / 'guard.pem').not_valid_after_utc:%Y-%m-%d at %H:%M} UTC"
    assert result.exit_code == 1
    assert lines["host/router.pem"] == f"router@rti_mpc/pioneer, valid for 90.0 days, {until}"
    assert lines["host/guard.pem"].endswith(f"{until}: host/guard.key must be the private key of host/guard.pem, got that of another certificate")
    assert lines["host/robot.pem"].endswith(f"{until}: it is for another role than robot")
    assert lines["host/controller.pem"].endswith(
        f"{until}: host/controller.pem must be issued by the authority of host/authority.pem, got one of another authority"
    )


@pytest.mark.parametrize(("days", "told"), [(12.0, "valid for 12.0 days, until "), (-0.01, "has ended on ")])
def test_end_of_a_certificate_is_told_with_its_day_and_what_to_do(days: float, told: str, authority: Authority, tmp_path: Path) -> None:
    host = make(authority, tmp_path / "host", "viewer", days=days)
    result = CliRunner().invoke(app, ["certs", "show", str(host)])
    end = read_certificate(host / "viewer.pem").not_valid_after_utc
    assert result.exit_code == 1
    assert (
        f"viewer.pem: viewer@rti_mpc/pioneer, {told}{end:%Y-%m-%d at %H:%M} UTC: `rti-mpc certs renew`, then restart its process\n" in result.output
    )


@pytest.mark.parametrize("command", ["show", "renew"])
def test_folder_without_certificates_is_refused_by_name(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A timer that looks for certificates in a misspelt folder must not be told that they live."""
    monkeypatch.chdir(tmp_path)
    run = CliRunner()
    assert run.invoke(app, ["certs", "authority"]).exit_code == 0
    refusal = run.invoke(app, ["certs", command, "dsek"]).exception
    assert str(refusal) == "certs: a folder must hold certificates, ROLE.pem, got none in dsek"


@pytest.mark.parametrize(
    ("role", "router", "keys", "words"),
    [
        ("driver", ROUTER, KEYS, "a role must be one of router, robot, controller"),
        ("robot", "tcp/robot.local:7447", KEYS, "must be an endpoint of TLS, such as tls/robot.local:7447"),
        ("robot", "tls/robot.local", KEYS, "must be an endpoint of TLS"),
        ("robot", ROUTER, Keys(robot="r" * 60), "must fit into the 64 characters"),
    ],
)
def test_what_no_certificate_can_be_for_is_refused(role: str, router: str, keys: Keys, words: str, authority: Authority, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=words):
        issue(authority, keys, [role], router, tmp_path / "host", tmp_path, 1.0)
    assert not (tmp_path / "host").exists()


def allowed(role: str, message: str, key: str) -> bool:
    """Whether the list lets a role send a kind of message on a key."""
    access = access_control(KEYS)
    (policy,) = [policy for policy in access["policies"] if policy["subjects"] == [role]]
    rules = [rule for rule in access["rules"] if rule["id"] in policy["rules"] and rule["flows"] == ["ingress"] and message in rule["messages"]]
    return any(zenoh.KeyExpr(text).includes(zenoh.KeyExpr(key)) for rule in rules for text in rule["key_exprs"])


SENT = {Kind.MESSAGE: "put", Kind.QUERY: "declare_queryable", Kind.TOKEN: "liveliness_token"}


@pytest.mark.parametrize("stream", STREAMS, ids=lambda stream: stream.name)
def test_a_role_writes_and_asks_what_the_table_of_streams_says_and_nothing_else(stream: Any) -> None:
    for role in (role for role in ROLES if role != "router"):
        for publisher in {name for other in STREAMS for name in other.publishers} if stream.by_role else {""}:
            key = str(KEYS.of(stream, publisher))
            may = publisher in stream.publishers and publisher in ROLES[role] if stream.by_role else bool(set(ROLES[role]) & set(stream.publishers))
            assert allowed(role, SENT[stream.kind], key) is may, f"{role} on {key}"
            assert allowed(role, "query", key) is bool(set(ROLES[role]) & set(stream.askers)), f"{role} asks {key}"
            cache = f"{key}/@adv/pub/1/2/_"
            assert allowed(role, "query", cache), f"{role} as a late joiner at {key}"
            for message in ("put", "declare_queryable", "liveliness_token"):
                assert allowed(role, message, cache) is bool(may and stream.qos.cached), f"{role} on {cache}"


def test_page_on_security_says_what_the_table_of_streams_says() -> None:
    page = (Path(__file__).parents[3] / "docs" / "security.md").read_text(encoding="utf-8")
    rows = {row[0]: row[1:] for row in re.findall(r"^\| `(\w+)` \| (?:[^|]*) \| ([^|]*) \|([^|]*)\|$", page, re.MULTILINE)}
    assert rows.keys() == ROLES.keys()
    streams = [stream for stream in STREAMS if stream not in (RELAY, PING, PONG)]  # those are for measurements only
    for role, (writes, asks) in rows.items():
        mine = [stream for stream in streams if set(stream.publishers) & set(ROLES[role])]
        written, _, answered = writes.partition("answers")
        assert set(re.findall("`(.*?)`", asks)) == {stream.name for stream in streams if set(stream.askers) & set(ROLES[role])}, role
        if role == "conformance":
            assert set(re.findall("`(.*?)`", writes)) == set(ROLES[role]) - {"operator"}  # it refers to their rows
            continue
        assert set(re.findall("`(.*?)`", written)) == {s.name for s in mine if s.kind is Kind.MESSAGE and not s.by_role}, role
        assert set(re.findall("`(.*?)`", answered)) == {stream.name for stream in mine if stream.kind is Kind.QUERY}, role


@pytest.mark.parametrize("key", ["rti_mpc/pioneer/**", "rti_mpc/*/command", "**", "rti_mpc/other/command", "@/router/local/config"])
def test_no_role_writes_by_wildcards_or_elsewhere(key: str) -> None:
    assert not any(allowed(role, message, key) for role in ROLES if role != "router" for message in ("put", "delete", "query", "declare_queryable"))


@pytest.mark.parametrize("role", ROLES)
def test_everything_but_the_router_is_a_client_and_speaks_tls_alone(role: str, tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text(json.dumps(zenoh_configuration(role, KEYS, ROUTER, tmp_path)))
    config = zenoh_config(BusSettings(config=path))
    assert json.loads(config.get_json("mode")) == ("router" if role == "router" else "client")
    assert json.loads(config.get_json("transport/link/protocols")) == ["tls"]
    assert json.loads(config.get_json("scouting/gossip/enabled")) is False
    assert json.loads(config.get_json("access_control"))["enabled"] is (role == "router")
    assert json.loads(config.get_json("listen/endpoints")) == (["tls/[::]:7447"] if role == "router" else [])


def test_a_command_takes_the_certificate_of_its_role_and_is_refused_without(authority: Authority, tmp_path: Path) -> None:
    host = make(authority, tmp_path / "host", *(role for role in ROLES if role not in ("guard", "viewer")))
    for command, roles in ROLES_OF_COMMAND.items():
        if command != "guard":
            role = "recorder" if command == "view" else roles[0]
            config = zenoh_config(secured(BusSettings(), host, command))
            assert json.loads(config.get_json("transport/link/tls/connect_certificate")) == str(host / f"{role}.pem")
            assert json.loads(config.get_json("transport/link/tls/enable_mtls")) is True
    with pytest.raises(ConfigError, match=r"`guard` needs .*guard\.pem, as `rti-mpc certs issue` writes it"):
        secured(BusSettings(), host, "guard")
    (host / "controller.key").chmod(0o644)
    with pytest.raises(ConfigError, match=r"for its owner alone \(chmod 600\), got .*controller\.key"):
        secured(BusSettings(), host, "run")


def test_folder_of_certificates_is_beside_the_file_or_with_systemd_s_credentials(
    authority: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "robot.toml").write_text(SHIPPED.read_text() + '\n[bus]\ntls = "tls"\n')
    assert load(tmp_path / "robot.toml", with_model=False).bus.tls == tmp_path / "tls"
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    assert credentials() is None
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(make(authority, tmp_path / "given", "guard")))
    assert credentials() == tmp_path / "given"


def test_tls_needs_all_three_files(authority: Authority, tmp_path: Path) -> None:
    host = make(authority, tmp_path / "host", "robot")
    with pytest.raises(ConfigError, match="TLS needs authority, certificate and key, each a file that can be read, got key None"):
        zenoh_config(BusSettings(authority=host / "authority.pem", certificate=host / "robot.pem"))


def test_router_names_endpoints_that_are_open_beyond_the_loopback() -> None:
    closed = ("tcp/127.0.0.1:7447", "tcp/localhost:7447", "tcp/[::1]:7447", "tls/0.0.0.0:7447", "quic/[::]:7447", "unixsock-stream//run/z")
    for endpoint in closed:
        assert open_endpoints(BusSettings(mode="router", listen=(endpoint,))) == []
    for endpoint in ("tcp/0.0.0.0:7447", "tcp/[::]:7447", "udp/192.0.2.1:7447", "ws/robot.local:7447"):
        assert open_endpoints(BusSettings(mode="router", listen=(endpoint, *closed))) == [endpoint]
