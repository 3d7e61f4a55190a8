# SPDX-License-Identifier: Apache-2.0
"""
Zenoh configurations of a robot's router and of its clients, made from the table of streams.

The router denies whatever no rule allows. Each role may read all of its robot's streams,
and write those of which `rti_mpc.wire.streams` names it a publisher. Rules match keys
that they include, and ``**`` does not include ``@adv``, below which Zenoh keeps the
caches for late joiners: without rules of their own, references would silently not arrive.
"""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path
from typing import Any

from rti_mpc.errors import ConfigError
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.session import CLIENT_TIMEOUT_MS, MAX_MESSAGE_BYTES, ZENOH_DEFAULTS
from rti_mpc.wire.streams import STREAMS, Kind
from rti_mpc_service.certs.roles import ROLES, common_name

CACHE = "@adv/**"  # keys of caches, below that of their stream
READS = ("declare_subscriber", "liveliness_query", "declare_liveliness_subscriber")
ALL = (*READS, "put", "query", "reply", "declare_queryable", "liveliness_token")
WRITES: dict[Kind, tuple[str, ...]] = {Kind.MESSAGE: ("put",), Kind.QUERY: ("declare_queryable", "reply"), Kind.TOKEN: ("liveliness_token",)}
CACHED: dict[str, tuple[str, ...]] = {"": ("reply",), f"/{CACHE}": ("put", "declare_queryable", "liveliness_token")}  # by what follows the key
ENDPOINT = re.compile(r"tls/(\[[^]]+\]|[^:\[\]/]+):(\d+)")


def grants(role: str, keys: Keys) -> dict[str, set[str]]:
    """Return what a role may send to the router besides reading: the key expressions for each kind of message of Zenoh."""
    granted: dict[str, set[str]] = defaultdict(set)
    for stream in STREAMS:
        for acts_as in ROLES[role]:
            own = [str(keys.of(stream, name)) for name in ((acts_as, f"{acts_as}.$*") if stream.by_role else ("",))]  # .$*: numbered
            after: dict[str, tuple[str, ...]] = {"": ("query",)} if acts_as in stream.askers else {}
            if acts_as in stream.publishers:
                after = {"": WRITES[stream.kind]}
                if stream.qos.cached:
                    after = {end: (*after.get(end, ()), *messages) for end, messages in CACHED.items()}
            for end, messages in after.items():
                for message in messages:
                    granted[message] |= {key + end for key in own}
    return granted


def access_control(keys: Keys) -> dict[str, Any]:
    """Return Zenoh's access control list of a router for one robot, which knows roles by the names in their certificates."""
    everything, caches = keys.below("**"), keys.below(f"**/{CACHE}")
    rules = [
        _rule("read", "ingress", READS, [everything, caches]),
        _rule("late joiners", "ingress", ("query",), [caches]),
        _rule("receive", "egress", ALL, [everything, caches]),
    ]
    common, policies = [rule["id"] for rule in rules], []
    roles = [role for role in ROLES if role != "router"]
    for role in roles:
        own = [_rule(f"{role} {message}", "ingress", (message,), sorted(granted)) for message, granted in grants(role, keys).items()]
        rules += own
        policies.append({"id": role, "subjects": [role], "rules": common + [rule["id"] for rule in own]})
    subjects = [{"id": role, "cert_common_names": [common_name(role, keys)], "link_protocols": ["tls"]} for role in roles]
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def zenoh_configuration(role: str, keys: Keys, router: str, folder: Path) -> dict[str, Any]:
    """
    Return Zenoh's configuration of a role.

    Args:
        role: Role of the process.
        keys: Keys of the robot.
        router: Endpoint of the router, such as ``tls/robot.local:7447``.
        folder: Folder of the certificates on its host.

    Raises:
        ConfigError: The endpoint is none of TLS.
    """
    host, port = host_and_port(router)
    side = "listen" if role == "router" else "connect"
    files = {"root_ca_certificate": "authority.pem", f"{side}_certificate": f"{role}.pem", f"{side}_private_key": f"{role}.key"}
    tls: dict[str, Any] = {name: str(folder / file) for name, file in files.items()}
    tls |= {"enable_mtls": True, "verify_name_on_connect": True, "close_link_on_expiration": True}
    link = {
        "protocols": ["tls"],
        "tls": tls,
        "tx": {"lease": ZENOH_DEFAULTS["transport/link/tx/lease"]},
        "rx": {"max_message_size": MAX_MESSAGE_BYTES},
    }
    shared: dict[str, Any] = {
        # Without gossip, no two processes that are connected to the router learn of each other and link past its list.
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"link": link, "shared_memory": {"enabled": False}},
    }
    if role == "router":
        listen = f"tls/{host}:{port}" if _is_local(host) else f"tls/[::]:{port}"
        return {"mode": "router", "listen": {"endpoints": [listen]}, "connect": {"endpoints": []}, **shared, "access_control": access_control(keys)}
    connect = {"endpoints": [router], "timeout_ms": CLIENT_TIMEOUT_MS, "retry": ZENOH_DEFAULTS["connect/retry"]}
    return {"mode": "client", "connect": connect, **shared}


def host_and_port(router: str) -> tuple[str, str]:
    """
    Return host, with its brackets if it is an address of IPv6, and port of the router's endpoint.

    Raises:
        ConfigError: The endpoint is none of TLS.
    """
    if (match := ENDPOINT.fullmatch(router)) is None:
        raise ConfigError(f"certs: --router must be an endpoint of TLS, such as tls/robot.local:7447, got {router!r}")
    return match[1], match[2]


def _is_local(host: str) -> bool:
    return host in ("localhost", "[::1]") or host.startswith("127.")


def _rule(name: str, flow: str, messages: tuple[str, ...], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": list(messages), "key_exprs": keys}
