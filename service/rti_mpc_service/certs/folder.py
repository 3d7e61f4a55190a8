# SPDX-License-Identifier: Apache-2.0
"""Folder with the certificates of one host, as `rti-mpc certs issue` writes it and processes read it."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rti_mpc.errors import ConfigError
from rti_mpc.wire.credentials import check
from rti_mpc_service.certs.roles import ROLES_OF_COMMAND

if TYPE_CHECKING:
    from rti_mpc.wire.session import BusSettings

AUTHORITY = "authority.pem"


def credentials() -> Path | None:
    """Return the folder of systemd's ``LoadCredential=``; None if there is none with certificates."""
    folder = Path(os.environ.get("CREDENTIALS_DIRECTORY", ""))
    return folder if folder.is_absolute() and (folder / AUTHORITY).exists() else None


def secured(settings: BusSettings, folder: Path, command: str) -> BusSettings:
    """
    Return the settings with which a command joins the bus by the certificate of its role.

    Args:
        settings: Settings without TLS; Zenoh's configuration is ``ROLE.json5`` of the folder, if it has one and the settings none.
        folder: Folder with ``authority.pem``, and ``ROLE.pem`` and ``ROLE.key`` of the roles that run on this host.
        command: Name of the command, such as ``run``.

    Raises:
        ConfigError: The folder has no certificate for the command, or others may read its private key.
    """
    roles = ROLES_OF_COMMAND[command]
    role = next((role for role in roles if (folder / f"{role}.pem").exists()), roles[0])
    for path in (folder / AUTHORITY, folder / f"{role}.pem", folder / f"{role}.key"):
        if not os.access(path, os.R_OK):
            raise ConfigError(f"tls: `{command}` needs {path}, as `rti-mpc certs issue` writes it, and the right to read it")
    key, zenoh = folder / f"{role}.key", folder / f"{role}.json5"
    if key.stat().st_mode & 0o007:
        raise ConfigError(f"tls: a private key must be for its owner alone (chmod 600), got {key}, which everybody may use")
    config = settings.config or (zenoh if zenoh.exists() else None)
    return replace(settings, config=config, authority=folder / AUTHORITY, certificate=folder / f"{role}.pem", key=key)


def renewal(path: Path) -> str:
    """Return how a certificate that ends is renewed."""
    return "make a new authority and new bundles" if path.name == AUTHORITY else "`rti-mpc certs renew`, then restart its process"


def misfit(path: Path) -> str:
    """Return why a certificate does not fit the private key and the authority beside it, as far as this user may read them; empty if it does."""
    authority, key = path.with_name(AUTHORITY), path.with_suffix(".key")
    try:
        check(authority if path != authority and authority.exists() else None, path, key if os.access(key, os.R_OK) else None)
    except ConfigError as error:
        return str(error).removeprefix("tls: ")
    return ""
