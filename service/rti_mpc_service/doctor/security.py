# SPDX-License-Identifier: Apache-2.0
"""
Security of this host: a line for each thing that is open, with what to do about it.

Configuration, certificates and files are read; of listeners, those that the
configuration names and those that processes of Zenoh have opened on this host are tried.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Address, IPv6Address
from pathlib import Path

from rich.table import Table

from rti_mpc.errors import ConfigError
from rti_mpc.wire.certificate import WARN_DAYS, ends
from rti_mpc.wire.handshake import ADDRESS, openness
from rti_mpc.wire.session import BusSettings, all_endpoints, denies, open_endpoints
from rti_mpc_service.certs.folder import credentials, misfit, renewal
from rti_mpc_service.config.build import bus_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.console import table_console
from rti_mpc_service.latch_file import state_folder

LISTENING = "0A"  # state of a socket in /proc/net/tcp
OURS = ("rti-mpc", "zenohd")  # names of programs that listen for a bus
OUR_PACKAGES = re.compile(r"(from )?(rti_mpc_service|rti_mpc_sim)\b")  # begin of an argument of Python, where a script starts a process
CERTIFY = "make certificates, and start all processes with them: `rti-mpc certs`, docs/security.md"


@dataclass(frozen=True)
class Opening:
    """
    Something that is open.

    Attributes:
        what: What it is.
        here: How it is here.
        do: What to do about it.
    """

    what: str
    here: str
    do: str


@dataclass(frozen=True)
class Examined:
    """
    What is examined.

    Attributes:
        config: Configuration of the robot.
        path: Its file.
        tls: Folder of this host's certificates; None if there is none.
        state: Folder in which an operator's stop is stored; None if none is known.
    """

    config: Config
    path: Path
    tls: Path | None
    state: Path | None

    @property
    def robot(self) -> BusSettings:
        """Settings of the bus of the process that listens where there is no router, the robot."""
        settings, bus = bus_settings(self.config), self.config.bus
        listen = bus.listen or (settings.connect if settings.mode == "peer" and settings.config is None else ())
        return replace(settings, listen=listen)

    @property
    def router(self) -> BusSettings | None:
        """Settings of the bus of the router that has its configuration here; None if there is none."""
        own = self.tls / "router.json5" if self.tls else None
        return BusSettings(mode="router", config=own) if own is not None and own.exists() else None


def main(path: Path, json_path: Path | None = None, *, tls: Path | None = None, state: Path | None = None) -> int:
    """
    Examine the security of this host, print what is open, and return the exit status: 0 if nothing is.

    Args:
        path: TOML file of the robot.
        json_path: Where to write the findings as JSON, too.
        tls: Folder of this host's certificates; None: that of the configuration or of systemd.
        state: Folder in which an operator's stop is stored; None: the folder of the user or of the service.
    """
    config = load(path, with_model=False)
    subject = Examined(config, path, tls or credentials() or config.bus.tls, state or state_folder())
    found = [finding for examine in EXAMINATIONS for finding in examine(subject)]
    if json_path is not None:
        json_path.write_text(json.dumps({"open": [asdict(finding) for finding in found]}, indent=2) + "\n", encoding="utf-8")
    console = table_console()
    if found:
        table = Table("what", "here", "what to do", box=None, padding=(0, 2, 0, 0))
        for finding in found:
            table.add_row(finding.what, finding.here, finding.do)
        console.print(table)
    counted = "nothing is open here" if not found else f"{len(found)} finding{'s' if len(found) > 1 else ''}"
    console.print(f"{path}: {counted}", soft_wrap=True)
    return int(bool(found))


def bus(subject: Examined) -> Iterator[Opening]:
    """Whether the bus is open, by configuration."""
    if subject.tls is None and not any(end.startswith(("tls/", "quic/")) for end in all_endpoints(subject.robot)):
        yield Opening("TLS", "none: whoever reaches the bus commands the robot", CERTIFY)
    for settings in (subject.robot, subject.router):
        for endpoint in open_endpoints(settings) if settings else ():
            yield Opening("configured listener", f"{endpoint}, beyond the loopback without TLS", CERTIFY)
    if subject.router is not None and not denies(subject.router):
        own = subject.router.config
        yield Opening("access control list", f"{own} has none that denies by default", "make it anew: `rti-mpc certs issue` in a new folder")


def listeners(subject: Examined) -> Iterator[Opening]:
    """Which processes listen beyond the loopback on this host, and take everybody."""
    settings = (subject.robot, *((subject.router,) if subject.router else ()))
    named = {int(match["port"]) for one in settings for end in all_endpoints(one) if (match := ADDRESS.match(end))}
    for address, port, program in listening():
        if (port in named or program) and not address.is_loopback and (how := openness(reachable(address), port)):
            who = program or "a process of another user"
            yield Opening(
                "listener", f"{who} on {address}, port {port}, {how}", "end it, or let it listen on 127.0.0.1 or with TLS, docs/security.md"
            )


def switches(subject: Examined) -> Iterator[Opening]:
    """Which switches of the configuration let others change the controller."""
    if subject.config.params.live:
        yield Opening("live parameters", "params.live = true", "set it to false in a robot in use, or know who is `operator`")
    if subject.config.debug.inject:
        yield Opening("fault injection", "debug.inject = true", "set it to false: it is for tests")


def certificates(subject: Examined) -> Iterator[Opening]:
    """Which certificates end soon, have ended or do not fit, and who may read private keys."""
    if subject.tls is not None and not any(subject.tls.glob("*.pem")):
        yield Opening("certificates", f"{subject.tls} has none: no process of this host starts with it", CERTIFY)
    for path in sorted(subject.tls.glob("*.pem")) if subject.tls else ():
        try:
            left = ends(path) - datetime.now(UTC)
        except ConfigError as error:
            yield Opening("certificate", str(error), renewal(path))
            continue
        if left < timedelta(days=WARN_DAYS):
            when = f"ends in {left / timedelta(days=1):.1f} days" if left > timedelta() else "has ended"
            yield Opening("certificate", f"{path} {when}", renewal(path))
        if left > timedelta() and (fault := misfit(path)):
            yield Opening("certificate", fault, "no process starts with it: take all files of a role from one `rti-mpc certs issue`")
    for path in sorted(subject.tls.glob("*.key")) if subject.tls else ():
        if others := may(path, 0o077):
            yield Opening("private key", f"{path} is for {others}, too", f"chmod 600 {path}; make a new one if others may have read it")


def folders(subject: Examined) -> Iterator[Opening]:
    """Which folders and files others may write."""
    state = subject.state
    for what, path in (("certificates", subject.tls), ("configuration", subject.path), ("state directory", state)):
        if path is not None and path.exists() and (others := may(path, 0o022)):
            yield Opening(what, f"{others} may write {path}", f"chmod go-w {path}")
    for path in sorted(state.glob("*.json")) if state else ():
        if others := may(path, 0o022):
            yield Opening("stop of an operator", f"{others} may write {path}", f"chmod go-w {path}")


EXAMINATIONS: tuple[Callable[[Examined], Iterator[Opening]], ...] = (bus, listeners, switches, certificates, folders)


def may(path: Path, bits: int) -> str:
    """Return who besides its owner has any of these permissions of a file; empty if nobody has."""
    mode = path.stat().st_mode & bits
    return "everybody" if mode & 0o007 else "its group" if mode else ""


def listening() -> Iterator[tuple[IPv4Address | IPv6Address, int, str]]:
    """Yield address, port and program of all TCP sockets that listen on this host; the program is empty if it is none of a bus, or another user's."""
    programs = programs_by_socket()
    for table in ("tcp", "tcp6"):
        path = Path("/proc/net") / table
        for line in path.read_text().splitlines()[1:] if path.exists() else ():
            fields = line.split()
            address, _, port = fields[1].partition(":")
            if fields[3] == LISTENING:
                words = bytes.fromhex(address)  # of four bytes each, in this machine's order
                packed = b"".join(int.from_bytes(words[k : k + 4], "little").to_bytes(4, "big") for k in range(0, len(words), 4))
                yield (IPv4Address if len(packed) == 4 else IPv6Address)(packed), int(port, 16), programs.get(fields[9], "")


def programs_by_socket() -> dict[str, str]:
    """Return the programs of buses that run on this host, as far as this user may see, by the inodes of their sockets."""
    programs = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = process.joinpath("cmdline").read_text(errors="replace").split("\0")
            name = next((name for word in words[:2] for name in OURS if Path(word).name == name), "")
            name = name or next((match[2] for word in words if (match := OUR_PACKAGES.match(word))), "")
            for descriptor in process.joinpath("fd").iterdir() if name else ():
                if (target := os.readlink(descriptor)).startswith("socket:["):
                    programs[target[8:-1]] = f"{name} ({process.name})"
        except OSError:  # it has ended, or is another user's
            continue
    return programs


def reachable(address: IPv4Address | IPv6Address) -> str:
    """Return the address at which a listener of this host is reached from here."""
    return ("127.0.0.1" if address.version == 4 else "::1") if address.is_unspecified else str(address)
