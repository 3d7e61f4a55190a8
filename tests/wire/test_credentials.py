# SPDX-License-Identifier: Apache-2.0
"""Files of TLS that this host can know to be wrong: each is named before a process joins."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.credentials import check
from rti_mpc.wire.keys import Keys
from rti_mpc_service.rig.endpoint import free_endpoint

pytest.importorskip("cryptography", reason="the extra certs is not installed: certificates were NOT tried")

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa

from rti_mpc_service.certs.authority import Authority, new_key, pem
from rti_mpc_service.certs.issue import issue

KEYS = Keys(robot="test")
AUTHORITY = Authority.make("ours", 10.0)
NAMES = ("authority.pem", "planner.pem", "planner.key")


def bundle(folder: Path, authority: Authority = AUTHORITY) -> Path:
    issue(authority, KEYS, ["router", "planner", "viewer"], "tls/127.0.0.1:7447", folder, folder, 1.0)
    return folder


def at(folder: Path, begin: timedelta) -> None:
    """Give the planner a certificate for a day that begins at a time from now on."""
    key = new_key()
    certificate = AUTHORITY.certify("planner@rti_mpc/test", key.public_key(), 1.0, now=datetime.now(UTC) + begin)
    (folder / "planner.pem").write_bytes(pem(certificate))
    (folder / "planner.key").write_bytes(pem(key))


def damage(folder: Path) -> None:
    lines = (folder / "planner.pem").read_text().splitlines(keepends=True)
    (folder / "planner.pem").write_text("".join((*lines[:4], lines[4].swapcase(), *lines[5:])))


def lock(folder: Path) -> None:
    shape = serialization.PrivateFormat.PKCS8
    (folder / "planner.key").write_bytes(
        new_key().private_bytes(serialization.Encoding.PEM, shape, serialization.BestAvailableEncryption(b"password"))
    )


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "certificate that is none": (
        lambda folder: (folder / "planner.pem").write_text("junk"),
        "{folder}/planner.pem: must be a certificate, PEM, got: no lines -----BEGIN CERTIFICATE-----",
    ),
    "key in the place of the certificate": (
        lambda folder: (folder / "planner.pem").write_bytes((folder / "planner.key").read_bytes()),
        "{folder}/planner.pem: must be a certificate, PEM, got: no lines -----BEGIN CERTIFICATE-----",
    ),
    "certificate that is damaged": (damage, "{folder}/planner.pem: must be a certificate, PEM, got"),
    "key that is none": (
        lambda folder: (folder / "planner.key").write_text("junk"),
        "tls: {folder}/planner.key must be a private key, PEM, without a password, got a file of something else",
    ),
    "key with a password": (lock, "tls: {folder}/planner.key must be a private key, PEM, without a password, got a file of something else"),
    "key of another certificate": (
        lambda folder: (folder / "planner.key").write_bytes((folder / "viewer.key").read_bytes()),
        "tls: {folder}/planner.key must be the private key of {folder}/planner.pem, got that of another certificate",
    ),
    "key of another type": (
        lambda folder: (folder / "planner.key").write_bytes(pem(rsa.generate_private_key(65537, 2048))),
        "tls: {folder}/planner.key must be the private key of {folder}/planner.pem, got that of another certificate",
    ),
    "folder in the place of the key": (
        lambda folder: ((folder / "planner.key").unlink(), (folder / "planner.key").mkdir()),
        "tls: {folder}/planner.key must be a private key, PEM, that can be read: Is a directory",
    ),
    "authority that is none": (
        lambda folder: (folder / "authority.pem").write_text("junk"),
        "{folder}/authority.pem: must be a certificate, PEM, got: no lines -----BEGIN CERTIFICATE-----",
    ),
    "authority that has not issued it": (
        lambda folder: (folder / "authority.pem").write_bytes(pem(Authority.make("theirs", 10.0).certificate)),
        "tls: {folder}/planner.pem must be issued by the authority of {folder}/authority.pem, got one of another authority",
    ),
    "authority of the same name": (
        lambda folder: (folder / "authority.pem").write_bytes(pem(Authority.make("ours", 10.0).certificate)),
        "tls: {folder}/planner.pem must be issued by the authority of {folder}/authority.pem, got one of another authority",
    ),
    "certificate that has ended": (
        lambda folder: at(folder, timedelta(days=-3)),
        "tls: {folder}/planner.pem must be a certificate that is valid, it has ended on ",
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_process_with_a_wrong_file_is_refused_before_it_waits_for_a_router(what: str, tmp_path: Path) -> None:
    """It waited for a router for ever. Here it would wait for a second, and name the router."""
    (spoil, said), folder = WRONG[what], bundle(tmp_path / "tls")
    spoil(folder)
    authority, certificate, key = (folder / name for name in NAMES)
    endpoint = free_endpoint().replace("tcp/", "tls/")
    for mode, side in (("client", "connect"), ("router", "listen")):
        ends = {"connect": (), "listen": ()} | {side: (endpoint,)}
        settings = BusSettings(mode=mode, authority=authority, certificate=certificate, key=key, **ends)
        with pytest.raises(ConfigError) as refused:
            Bus.join(settings, KEYS, timeout_s=1.0).close()
        assert str(refused.value).startswith(said.format(folder=folder))
        assert "\n" not in str(refused.value)


def test_good_files_and_those_that_only_others_can_judge_are_taken(tmp_path: Path) -> None:
    folder = bundle(tmp_path / "tls")
    authority = folder / "authority.pem"
    for role in ("router", "planner"):
        check(authority, folder / f"{role}.pem", folder / f"{role}.key")
    check(authority, None, None)
    check(None, folder / "planner.pem", folder / "planner.key")
    at(folder, timedelta(days=3))
    check(authority, folder / "planner.pem", folder / "planner.key")  # the clock of a robot may be set later
    authority.write_bytes(pem(Authority.make("theirs", 10.0).certificate) + pem(AUTHORITY.certificate))
    check(authority, folder / "planner.pem", folder / "planner.key")  # two authorities, while one takes the other's place


def test_authority_of_routers_alone_is_taken_outside_of_a_bundle(tmp_path: Path) -> None:
    """As in a Zenoh configuration of the user's own: clients and routers may have certificates of two authorities."""
    folder = bundle(tmp_path / "tls")
    authority = folder / "authority.pem"
    authority.write_bytes(pem(Authority.make("theirs", 10.0).certificate))
    check(authority, folder / "planner.pem", folder / "planner.key", bundled=False)
    (folder / "planner.key").write_bytes((folder / "viewer.key").read_bytes())
    with pytest.raises(ConfigError, match="must be the private key of"):
        check(authority, folder / "planner.pem", folder / "planner.key", bundled=False)
