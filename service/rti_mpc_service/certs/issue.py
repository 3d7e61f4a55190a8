# SPDX-License-Identifier: Apache-2.0
"""Files of `rti-mpc certs`: an authority, bundles for hosts, and their renewal. Private keys are for their owner alone, and never overwritten."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from rti_mpc.errors import ConfigError, reason
from rti_mpc.whole_file import replaced
from rti_mpc.wire.certificate import WARN_DAYS
from rti_mpc.wire.keys import Keys
from rti_mpc_service.certs.access import host_and_port, zenoh_configuration
from rti_mpc_service.certs.authority import Authority, days_left, name_of, new_key, pem, read_certificate
from rti_mpc_service.certs.folder import AUTHORITY, misfit, renewal
from rti_mpc_service.certs.roles import common_name

LOCAL = ("localhost", "127.0.0.1", "::1")  # at which processes on the router's own host reach it
NOTE = "// Made from the table of streams by `rti-mpc certs issue`: make it anew where a robot, a role or the router's address changes.\n"


def make_authority(folder: Path, days: float) -> list[Path]:
    """
    Make an authority, ``authority.pem`` and ``authority.key`` in a folder of its own.

    Returns:
        The files that were written.

    Raises:
        ConfigError: A file exists, or cannot be written.
    """
    authority = Authority.make("rti-mpc authority", days)
    return write(folder, {AUTHORITY: pem(authority.certificate), "authority.key": pem(authority.key)})


def issue(authority: Authority, keys: Keys, roles: Sequence[str], router: str, folder: Path, at: Path, days: float) -> list[Path]:
    """
    Make the bundle of one host: the authority, and certificate, private key and Zenoh's configuration of each role.

    Args:
        authority: Signs the certificates.
        keys: Keys of the robot.
        roles: Roles that run on the host.
        router: Endpoint of the router, such as ``tls/robot.local:7447``; its certificate is for that host, and for the loopback.
        folder: Folder to write.
        at: Folder of the bundle on its host, for programs that read Zenoh's configuration by themselves.
        days: Time for which the certificates are valid.

    Returns:
        The files that were written.

    Raises:
        ConfigError: A role or the router is wrong, a file exists, or cannot be written.
    """
    host = host_and_port(router)[0].strip("[]")
    files: dict[str, bytes] = {}
    for role in dict.fromkeys(roles):
        key, name = new_key(), common_name(role, keys)
        addresses = dict.fromkeys((host, *LOCAL)) if role == "router" else ()
        files[f"{role}.key"] = pem(key)
        files[f"{role}.pem"] = pem(authority.certify(name, key.public_key(), days, addresses))
        files[f"{role}.json5"] = (NOTE + json.dumps(zenoh_configuration(role, keys, router, at), indent=1) + "\n").encode()
    trusted = folder / AUTHORITY
    if not trusted.exists():
        files[AUTHORITY] = pem(authority.certificate)
    elif trusted.read_bytes() != pem(authority.certificate):
        raise ConfigError(f"certs: {folder} must be a folder of this authority, got {trusted} of another one")
    return write(folder, files)


def write(folder: Path, files: Mapping[str, bytes]) -> list[Path]:
    """
    Write new files, private keys with mode 600; none of them if one exists.

    Raises:
        ConfigError: One exists, or cannot be written.
    """
    if existing := [path for name in files if (path := folder / name).exists() or path.is_symlink()]:
        raise ConfigError(f"certs: a file must not be overwritten, got {existing[0]}, which exists")
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, content in files.items():
            mode = 0o600 if name.endswith(".key") else 0o644
            with os.fdopen(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
                file.write(content)
    except OSError as error:
        raise ConfigError(f"certs: {folder} must be a folder that can be written: {reason(error)}") from error
    return [folder / name for name in files]


def renew(authority: Authority, folder: Path, days: float) -> list[Path]:
    """
    Renew all certificates of a bundle; names and private keys stay, and no private key is needed.

    Returns:
        The files that were replaced.

    Raises:
        ConfigError: There is no certificate, one is of another authority, or cannot be replaced.
    """
    paths = [path for path in certificates_in(folder) if path.name != AUTHORITY]
    contents = {path: pem(authority.renewed(read_certificate(path), days)) for path in paths}
    try:
        for path, content in contents.items():
            with replaced(path) as fresh:
                fresh.write(content)
    except OSError as error:
        raise ConfigError(f"certs: {folder} must be a folder that can be written: {reason(error)}") from error
    return paths


def shown(folder: Path) -> list[tuple[str, bool]]:
    """
    Return a line about each certificate in a folder, and whether it is to be replaced: it ends soon, or does not fit its key, authority or role.

    Raises:
        ConfigError: There is none, or one is none.
    """
    lines = []
    for path in certificates_in(folder):
        certificate = read_certificate(path)
        name, days = name_of(certificate), days_left(certificate)
        when = f"{certificate.not_valid_after_utc:%Y-%m-%d at %H:%M} UTC"
        left = f"valid for {days:.1f} days, until {when}" if days > 0.0 else f"has ended on {when}"
        role = "" if path.name == AUTHORITY or name.startswith(f"{path.stem}@") else f"it is for another role than {path.stem}"
        soon = "" if days >= WARN_DAYS else renewal(path)
        faults = [fault for fault in (role, misfit(path) if days > 0.0 else "", soon) if fault]
        lines.append((": ".join((f"{path}: {name}, {left}", *faults)), bool(faults)))
    return lines


def certificates_in(folder: Path) -> list[Path]:
    """
    Return the certificates in a folder.

    Raises:
        ConfigError: There is none: a timer that asks how long certificates live must not be told by silence that all is well.
    """
    paths = sorted(folder.glob("*.pem"))
    if not paths:
        raise ConfigError(f"certs: a folder must hold certificates, ROLE.pem, got none in {folder}")
    return paths
