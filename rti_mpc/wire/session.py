# SPDX-License-Identifier: Apache-2.0
"""
Settings with which a process joins the bus, and the Zenoh session made from them.

Peers find each other by gossip. The robot listens on the rendezvous endpoint, the others
on a free loopback port. Those connect to the robot, trying until it is there, learn of
one another and link directly. So processes may start and restart in any order, and those
already linked stay so without the robot, and see `rti_mpc.wire.introduction` for those
that were held up. Multicast is off. Across hosts, name the
endpoint to listen on. Across a security boundary, use ``mode="client"`` and a router: a
peer never forwards, and never passes a router's access control.
"""

from __future__ import annotations

import json
import os
import re
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import zenoh

from rti_mpc.contract.message import Reference
from rti_mpc.errors import ConfigError, Stopped
from rti_mpc.text_file import read_text_file
from rti_mpc.wire import credentials
from rti_mpc.wire.handshake import ADDRESS, obstacles
from rti_mpc.wire.layout import MAX_PAYLOAD_BYTES
from rti_mpc.wire.reach import remind

RENDEZVOUS_ENDPOINT = "tcp/127.0.0.1:7447"
# Protocols that need a port; whether an endpoint of another protocol is valid is left to Zenoh.
ENDPOINT_PATTERN = re.compile(r"(tcp|tls|udp|quic|ws)/.+:(?P<port>\d+)([?#].*)?$|(?!(tcp|tls|udp|quic|ws)/)[a-z_-]+/.+")
OPEN_PATTERN = re.compile(r"(tcp|udp|ws)/(?!127\.|localhost:|\[::1\])")  # an endpoint beyond the loopback without TLS
TLS_PROTOCOLS = ("tls/", "quic/")
MAX_PORT = 65535
CLIENT_TIMEOUT_MS = 500  # of one attempt to reach a router
MAX_CONFIG_BYTES = 1 << 16  # of Zenoh's configuration file: its parser recurses at every bracket
RETRY_INTERVAL_S = 0.1  # between two attempts to reach a router

# Closing the link of a hung peer occupies a thread of Zenoh for its linger time, 10 s. By default there is one to send and
# two to receive: a hung viewer would then cut the controller from the robot.
ZENOH_THREADS = "(rx: (worker_threads: 4), tx: (worker_threads: 4))"

MAX_MESSAGE_BYTES = MAX_PAYLOAD_BYTES[Reference] + (1 << 12)  # payload and Zenoh's own bytes: a longer message is dropped before it is reassembled

ALL_ADDRESSES, LOOPBACK = ("0.0.0.0", "[::]"), ("127.0.0.1", "localhost", "::1")

# Settings of this package, unless the user's own Zenoh configuration says otherwise.
ZENOH_DEFAULTS: dict[str, Any] = {
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
    "scouting/gossip/enabled": True,
    "transport/link/tx/lease": 2000,  # a hung process is noticed after 1.5 s, not 7.5 s
    "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,  # bytes: what a peer can make us put together
    "transport/shared_memory/enabled": False,  # gains nothing at these sizes
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 500_000,  # us: what a query waits for a hung peer
    "queries_default_timeout": 1000,  # ms: a hung publisher delays a late joiner no longer
}


@dataclass(frozen=True, slots=True)
class BusSettings:
    """
    Settings with which a process joins the bus. Attributes that differ from their defaults override a Zenoh configuration file.

    Attributes:
        mode: peer, client or router.
        listen: Endpoints to listen on; none for a free loopback port, or for the rendezvous endpoint of a router.
        connect: Endpoints to connect to, without those in `listen`; a router does not connect to the rendezvous endpoint.
        config: Configuration file of Zenoh, JSON5.
        multicast: Whether to look for others by multicast.
        authority: Certificate of the authority, PEM, for TLS with certificates on both sides. Given together with `certificate` and `key`,
            and then every endpoint must be ``tls/`` or ``quic/``, and links close when the other side's certificate expires.
        certificate: Certificate of this process, PEM.
        key: Private key of this process, PEM.
        cfg: Further settings of Zenoh, each ``KEY:VALUE``, applied last.
    """

    mode: str = "peer"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = (RENDEZVOUS_ENDPOINT,)
    config: Path | None = None
    multicast: bool = False
    authority: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    cfg: tuple[str, ...] = ()


def zenoh_config(settings: BusSettings) -> zenoh.Config:
    """
    Zenoh configuration of a process.

    Raises:
        ConfigError: An endpoint is malformed, a file of TLS is missing, or Zenoh refuses a value or cannot read its file.
    """
    for endpoint in (*settings.listen, *settings.connect):
        if (match := ENDPOINT_PATTERN.match(endpoint)) is None or int(match["port"] or 0) > MAX_PORT:
            raise ConfigError(f"bus: an endpoint must be a protocol, an address and a port, such as {RENDEZVOUS_ENDPOINT}, got {endpoint!r}")
    name = str(settings.config)
    if settings.config is not None:
        read_text_file(settings.config, "Zenoh's configuration", MAX_CONFIG_BYTES)
    try:
        config = zenoh.Config() if settings.config is None else zenoh.Config.from_file(settings.config)
        untouched = zenoh.Config()
        mode = settings.mode if settings.mode != BusSettings().mode else json.loads(config.get_json("mode")) or settings.mode
        usual = _by_name(BusSettings(), mode)
        for name, value in _by_name(settings, mode).items():
            if value != usual[name] or config.get_json(name) == untouched.get_json(name):
                config.insert_json5(name, json.dumps(value))
        name = "mode"
        config.insert_json5(name, json.dumps(mode))
        for name, value in _tls(settings).items():
            config.insert_json5(name, json.dumps(value))
        for setting in settings.cfg:
            name, _, text = setting.partition(":")
            if not text:
                raise ConfigError(f"bus: a setting of Zenoh must be KEY:VALUE, such as transport/link/tx/lease:1000, got {setting!r}")
            config.insert_json5(name, text)
    except zenoh.ZError as error:
        raise ConfigError(f"bus: {name} must be what Zenoh takes, got: {_brief(error)}") from None
    return config


def listens_itself(endpoint: str, listen: Iterable[str]) -> bool:
    """Whether a process that listens on some endpoints does so at this one: one of them, or of this host where it listens on all addresses."""
    this = ADDRESS.match(endpoint)
    own = {endpoint}
    if this is not None and (this["v6"] or this["host"]) in LOOPBACK:
        own |= {f"{this['protocol']}/{host}:{this['port']}" for host in ALL_ADDRESSES}
    return not own.isdisjoint(listen)


def _by_name(settings: BusSettings, mode: str) -> dict[str, Any]:
    """Return the settings by their names in Zenoh. No process connects to itself, and a router to none by default."""
    others = () if mode == "router" and settings.connect == (RENDEZVOUS_ENDPOINT,) else settings.connect
    return {
        "listen/endpoints": settings.listen or {"client": [], "peer": ["tcp/127.0.0.1:0"], "router": [RENDEZVOUS_ENDPOINT]}.get(mode, []),
        "connect/endpoints": [endpoint for endpoint in others if not listens_itself(endpoint, settings.listen)],
        "connect/timeout_ms": CLIENT_TIMEOUT_MS if mode == "client" else -1,
        "scouting/multicast/enabled": settings.multicast,
        **ZENOH_DEFAULTS,
    }


def _tls(settings: BusSettings) -> dict[str, Any]:
    """Return the settings of TLS by their names in Zenoh; empty without a certificate."""
    files = {name: getattr(settings, name) for name in ("authority", "certificate", "key")}
    if not any(files.values()):
        return {}
    for name, path in files.items():
        if path is None or not os.access(path, os.R_OK):
            raise ConfigError(f"bus: TLS needs authority, certificate and key, each a file that can be read, got {name} {path}")
    authority, certificate, key = (str(path.absolute()) for path in files.values())
    own = {f"{side}_{part}": path for side in ("listen", "connect") for part, path in (("certificate", certificate), ("private_key", key))}
    asked = {"root_ca_certificate": authority, **own, "enable_mtls": True, "verify_name_on_connect": True, "close_link_on_expiration": True}
    return {"transport/link/protocols": ["tls", "quic"]} | {f"transport/link/tls/{name}": value for name, value in asked.items()}


TOLD_IN_RUST = re.compile(r'(?:Str\(|msg: )"((?:[^"\\]|\\.)*)"')  # the text in a value of Rust that Zenoh prints as such
PLACE_DRAWN = re.compile(r"^--> (\d+):(\d+) .* = (.*)$")  # of a fault in JSON5, in one line


def _brief(error: Exception) -> str:
    """Return the innermost cause that Zenoh tells, without the places in its source: of ``what: [why at PLACE] at PLACE`` the why."""
    text = str(error).split(" at /")[0]
    inside = text.count("[") > text.count("]")
    text = text.rpartition(": [")[2] if inside else text
    if (told := TOLD_IN_RUST.search(text)) is not None:
        text = told[1].replace("\\n", " ").replace('\\"', '"')
    return PLACE_DRAWN.sub(r"\3, at line \1, column \2", " ".join(text.split()))


def endpoints(config: zenoh.Config) -> str:
    """Return the endpoints that a process connects to, and what is wrong there, in words; empty if it waits for others to connect."""
    files = [_tls_file(config, name) for name in ("root_ca_certificate", "connect_certificate", "connect_private_key")]
    ends = _ends(config, "connect")
    found = obstacles(ends, *files)
    return "; ".join(f"{end}: {found.get(end) or _guess(end)}" for end in ends)


def _ends(config: zenoh.Config, side: str) -> list[str]:
    given: list[str] | dict[str, list[str]] = json.loads(config.get_json(f"{side}/endpoints"))
    return given if isinstance(given, list) else [end for ends in given.values() for end in ends]


def certificate(config: zenoh.Config) -> Path | None:
    """Return the certificate of a process; None without TLS."""
    return _tls_file(config, "connect_certificate") or _tls_file(config, "listen_certificate")


def check_credentials(config: zenoh.Config, *, bundled: bool) -> None:
    """
    Check the files of TLS of a process that has an endpoint of TLS, see `rti_mpc.wire.credentials.check`.

    Raises:
        ConfigError: One is none, or does not fit the others.
    """
    for side in ("connect", "listen"):
        if any(end.startswith(TLS_PROTOCOLS) for end in _ends(config, side)):
            credentials.check(
                *(_tls_file(config, name) for name in ("root_ca_certificate", f"{side}_certificate", f"{side}_private_key")), bundled=bundled
            )


def _tls_file(config: zenoh.Config, name: str) -> Path | None:
    path = json.loads(config.get_json(f"transport/link/tls/{name}"))
    return Path(path) if path else None


def _guess(endpoint: str) -> str:
    """Return what may be wrong at an endpoint."""
    certificate = ", the address is wrong, or a certificate is" if endpoint.startswith(TLS_PROTOCOLS) else ", or the address is wrong"
    return f"no process listens there{certificate}"


def meets(config: zenoh.Config) -> bool:
    """Whether a process is a peer, which meets others by gossip."""
    return bool(json.loads(config.get_json("mode")) == "peer")


def guest_config(settings: BusSettings) -> zenoh.Config:
    """Return the configuration of a peer that joins where a process with these settings did: nobody connects to it, and opening waits for nobody."""
    waits = ("connect_scouted", "declares")
    cfg = ("listen/endpoints:[]", *(f"open/return_conditions/{what}:false" for what in waits))
    return zenoh_config(replace(settings, listen=(), cfg=(*settings.cfg, *cfg)))


def open_endpoints(settings: BusSettings) -> list[str]:
    """Return the endpoints beyond the loopback on which a process listens without TLS."""
    given = json.loads(zenoh_config(settings).get_json("listen/endpoints"))
    ends = given if isinstance(given, list) else given.get(settings.mode, [])
    return [endpoint for endpoint in ends if OPEN_PATTERN.match(endpoint)]


def all_endpoints(settings: BusSettings) -> list[str]:
    """Return all endpoints to which a process connects or on which it listens, in any mode."""
    config = zenoh_config(settings)
    return [*_ends(config, "connect"), *_ends(config, "listen")]


def denies(settings: BusSettings) -> bool:
    """Whether a process with these settings drops what no rule of its access control list allows."""
    access = json.loads(zenoh_config(settings).get_json("access_control"))
    return bool(access["enabled"]) and access["default_permission"] == "deny"


def start_zenoh_log(targets: str) -> None:
    """Have Zenoh write its log to standard output, of the targets that are given, or those of ``RUST_LOG``; once in a process."""
    zenoh.init_log_from_env_or(targets)


def open_session(settings: BusSettings, timeout_s: float, stop: threading.Event | None, say: Callable[[str], object]) -> zenoh.Session:
    """
    Open a session; a client waits for its router, and reports that.

    Raises:
        ConfigError: Zenoh refuses a setting, a file of TLS is none or does not fit the others, or no router was there in time.
        Stopped: The wait was ended.
    """
    deadline_s = time.monotonic() + timeout_s
    os.environ.setdefault("ZENOH_RUNTIME", ZENOH_THREADS)
    config, opened, told = zenoh_config(settings), threading.Event(), False
    check_credentials(config, bundled=settings.certificate is not None)
    try:
        while True:
            try:
                return zenoh.open(config)
            except zenoh.ZError as error:
                if "Unable to connect" not in str(error):
                    given = ", ".join(_ends(config, "listen") + _ends(config, "connect"))  # Zenoh does not always name the one that is wrong
                    raise ConfigError(f"bus: endpoints must be valid, and no other process listen there, got {given} ({_brief(error)})") from None
                if stop is not None and stop.is_set():
                    raise Stopped("stopped before a router was there") from None
                if time.monotonic() > deadline_s:
                    raise ConfigError(f"bus: a router must be reachable, none has answered at {endpoints(config)}") from None
                if not told:
                    told = True
                    remind(say, lambda: f"not connected: no router answers at {endpoints(config)}", opened)
                time.sleep(RETRY_INTERVAL_S)
    finally:
        opened.set()
