# SPDX-License-Identifier: Apache-2.0
"""Roles that certificates are issued for, each with the roles in the table of streams that it may act in."""

from __future__ import annotations

from rti_mpc.errors import ConfigError
from rti_mpc.wire.keys import Keys

ROLES: dict[str, tuple[str, ...]] = {
    "router": (),
    "robot": ("robot",),
    "controller": ("controller", "standby"),
    "guard": ("guard",),
    "planner": ("reference",),
    "operator": ("operator",),
    "viewer": ("viewer",),
    "recorder": ("viewer", "recorder"),
    "conformance": ("controller", "guard", "robot", "operator"),  # takes the place of all but the one that it judges
}
# Roles whose certificate a command uses: the first one that the host's folder has.
ROLES_OF_COMMAND: dict[str, tuple[str, ...]] = {
    "conformance": ("conformance",),
    "run": ("controller",),
    "guard": ("guard",),
    "sim": ("robot",),
    "reference": ("planner",),
    "view": ("viewer", "recorder"),
    "record": ("recorder",),
    "status": ("operator", "viewer", "recorder"),
    "router": ("router",),
    "stop": ("operator",),
    "enable": ("operator",),
    "params": ("operator",),
    "snapshot": ("operator",),
    "why": ("recorder",),
}
MAX_NAME_CHARS = 64  # of a common name in a certificate


def common_name(role: str, keys: Keys) -> str:
    """
    Return the name in the certificate of a role of one robot, by which a router knows it.

    Raises:
        ConfigError: There is no such role, or the name does not fit into a certificate.
    """
    if role not in ROLES:
        raise ConfigError(f"certs: a role must be one of {', '.join(ROLES)}, got {role!r}")
    name = f"{role}@{keys.prefix}/{keys.robot}"
    if len(name) > MAX_NAME_CHARS:
        raise ConfigError(f"certs: role, prefix and robot must fit into the {MAX_NAME_CHARS} characters of a certificate's name, got {name!r}")
    return name
