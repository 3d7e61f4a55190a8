# SPDX-License-Identifier: Apache-2.0
"""Reasons for which a router does not answer, each from a real listener of Zenoh."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from threading import Event

import pytest

from rti_mpc.wire import handshake
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.handshake import obstacle, obstacles, openness
from rti_mpc.wire.keys import Keys
from rti_mpc_service.rig.endpoint import free_endpoint

pytest.importorskip("cryptography", reason="the extra certs is not installed: certificates were NOT tried")

from rti_mpc_service.certs.authority import Authority, new_key, pem
from rti_mpc_service.certs.issue import issue

KEYS = Keys(robot="test")
FILES = ("authority.pem", "planner.pem", "planner.key")


def bundle(folder: Path, authority: Authority, endpoint: str) -> Path:
    issue(authority, KEYS, ["router", "planner"], endpoint, folder, folder, 1.0)
    return folder


def listening(folder: Path, role: str, endpoint: str) -> Bus:
    files = {"authority": folder / "authority.pem", "certificate": folder / f"{role}.pem", "key": folder / f"{role}.key"}
    return Bus.join(BusSettings(mode="router", listen=(endpoint,), **files), KEYS)


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Authority, Path, str]]:
    """An authority, its bundle, and the endpoint of a router that has a certificate of it."""
    authority, endpoint = Authority.make("ours", 10.0), free_endpoint().replace("tcp/", "tls/")
    folder = bundle(tmp_path_factory.mktemp("ours") / "tls", authority, endpoint)
    with listening(folder, "router", endpoint):
        yield authority, folder, endpoint


def said(endpoint: str, folder: Path) -> str:
    return obstacle(endpoint, *(folder / name for name in FILES))


def test_certificate_that_has_ended_or_is_of_another_authority_or_missing_is_named_as_the_reason(
    ours: tuple[Authority, Path, str], tmp_path: Path
) -> None:
    authority, folder, endpoint = ours
    for name in ("ended", "foreign", "strange"):
        bundle(tmp_path / name, authority if name == "ended" else Authority.make("theirs", 10.0), endpoint)
    key = new_key()
    ended = authority.certify("planner@rti_mpc/test", key.public_key(), 1.0, now=datetime.now(UTC) - timedelta(days=3))
    for name, content in (("planner.pem", ended), ("planner.key", key)):
        (tmp_path / "ended" / name).write_bytes(pem(content))
    (tmp_path / "foreign" / "authority.pem").write_bytes((folder / "authority.pem").read_bytes())
    assert (
        said(endpoint, tmp_path / "ended") == f"the router refuses {tmp_path / 'ended' / 'planner.pem'}, which has ended: see `rti-mpc certs renew`"
    )
    foreign = tmp_path / "foreign" / "planner.pem"
    assert said(endpoint, tmp_path / "foreign") == f"the router refuses {foreign}, which is of another authority than its own"
    strange = tmp_path / "strange" / "authority.pem"
    assert said(endpoint, tmp_path / "strange") == f"the router's certificate is of another authority than {strange}"
    assert obstacle(endpoint, folder / "authority.pem") == "the router wants a certificate, and got none: see --tls"
    assert said(endpoint, folder) == "what listens there does not answer", "nothing is wrong with a good certificate"


def test_wrong_protocol_on_either_side_is_named_as_the_reason(ours: tuple[Authority, Path, str]) -> None:
    _, folder, endpoint = ours
    assert obstacle(endpoint.replace("tls/", "tcp/")) == "what listens there speaks TLS: see --tls"
    plain = free_endpoint()
    with Bus.join(BusSettings(mode="router", listen=(plain,)), KEYS):
        assert said(plain.replace("tcp/", "tls/"), folder) == "what listens there does not speak TLS"
        assert obstacle(plain) == "what listens there does not answer"
        assert openness("127.0.0.1", int(plain.rpartition(":")[2])) == "without TLS"
    assert openness("127.0.0.1", int(endpoint.rpartition(":")[2])) == ""


def test_router_at_another_address_or_process_that_is_no_router_is_named_as_the_reason(ours: tuple[Authority, Path, str]) -> None:
    _, folder, _ = ours
    elsewhere = free_endpoint().replace("tcp/127.0.0.1", "tls/127.0.0.2")
    with listening(folder, "router", elsewhere):
        assert said(elsewhere, folder) == "the router's certificate is not for this address: issue it with this one as --router"
    false = free_endpoint().replace("tcp/", "tls/")
    with listening(folder, "planner", false):
        assert said(false, folder) == "what listens there has no certificate of a router"


def test_certificates_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    """Python's own error says `[SSL] PEM lib`, and not of which file."""
    authority = Authority.make("authority", 1.0)
    folder = bundle(tmp_path / "desk", authority, "tls/127.0.0.1:7447")
    (folder / FILES[1]).write_text("junk")
    files = ", ".join(str(folder / name) for name in FILES)
    assert said("tls/127.0.0.1:7447", folder).startswith(f"the certificates of this process cannot be used, {files}: ")


def test_endpoints_are_tried_side_by_side_and_one_whose_name_server_hangs_keeps_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    hanging, going = "tcp/hangs.invalid:7447", Event()
    monkeypatch.setattr(handshake, "DEADLINE_S", 0.5)
    monkeypatch.setattr(handshake, "obstacle", lambda endpoint, *_: going.wait(60.0) and "" if endpoint == hanging else "closed")
    assert obstacles([hanging, "tcp/127.0.0.1:9"]) == {"tcp/127.0.0.1:9": "closed"}
    going.set()


@pytest.mark.parametrize("host", ["a" * 64 + ".invalid", "a..invalid"])
def test_name_that_no_host_can_have_is_one_that_this_host_does_not_know(host: str) -> None:
    """Python raises an error of its own, which would end the thread that looks, with a traceback."""
    assert obstacle(f"tcp/{host}:7447") == "this host does not know that name"
