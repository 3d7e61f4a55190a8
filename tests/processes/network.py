# SPDX-License-Identifier: Apache-2.0
"""Network of hosts on one machine: a network namespace per host, joined by a bridge, with links that can be cut. Needs root and `ip`."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from tests.processes.system import ROOT, environment

MIDDLE = "middle"  # the namespace of the bridge, whose address all others reach
NETWORK = "10.77.0"
MIDDLE_ADDRESS = f"{NETWORK}.1"
FIRST = 2  # number of the first host's address
PREFIX = "rti-mpc-test-"


def ip(*words: str) -> None:
    """Run `ip`."""
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"ip {' '.join(words)}: {done.stderr.strip()}"


def missing() -> str | None:
    """Return why namespaces cannot be used here, or None if they can."""
    if os.getuid() != 0:
        return "root is needed for network namespaces: networks of hosts are NOT tested"
    if shutil.which("ip") is None:
        return "`ip` is needed for network namespaces (apt-get install iproute2): networks of hosts are NOT tested"
    try:
        with Network("probe"):
            return None
    except AssertionError as error:
        return f"network namespaces cannot be made here ({error}): networks of hosts are NOT tested"


class Network:
    """
    Hosts on one bridge, and the processes that run on them.

    All of it is taken down at the end; what a test that was killed has left is
    taken down before the next begins.

    Attributes:
        names: File like ``/etc/hosts`` that takes its place on all hosts.
    """

    def __init__(self, *hosts: str) -> None:
        self._hosts = hosts
        self.names: Path | None = None
        self._stack = ExitStack()
        self.running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Network:
        for name in left_behind():
            ip("netns", "del", name)
        try:
            self._add(MIDDLE)
            ip("-n", name_of(MIDDLE), "link", "add", "bridge", "type", "bridge")
            ip("-n", name_of(MIDDLE), "addr", "add", f"{MIDDLE_ADDRESS}/24", "dev", "bridge")
            ip("-n", name_of(MIDDLE), "link", "set", "bridge", "up")
            for number, host in enumerate(self._hosts, FIRST):
                self._add(host)
                ip("-n", name_of(host), "link", "add", "up0", "type", "veth", "peer", "name", host, "netns", name_of(MIDDLE))
                ip("-n", name_of(MIDDLE), "link", "set", host, "master", "bridge", "up")
                ip("-n", name_of(host), "addr", "add", f"{NETWORK}.{number}/24", "dev", "up0")
                ip("-n", name_of(host), "link", "set", "up0", "up")
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._stack.close()

    def _add(self, host: str) -> None:
        ip("netns", "add", name_of(host))
        self._stack.callback(ip, "netns", "del", name_of(host))
        ip("-n", name_of(host), "link", "set", "lo", "up")

    def start(self, name: str, host: str, module: str, *arguments: object, folder: Path, cwd: Path = ROOT) -> None:
        """Start a module of ours on a host, as `python -m` does; it ends with us, however we end."""
        with (folder / f"{name}.log").open("wb") as log:
            command, env = self._command(host, module, *arguments), environment(folder / "state" / host)
            process = subprocess.Popen(command, cwd=cwd, env=env, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT)
        self.running[name] = process
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)

    def run(self, host: str, module: str, *arguments: object, cwd: Path = ROOT, timeout_s: float = 120.0) -> subprocess.CompletedProcess[str]:
        """Run a module of ours on a host to its end."""
        command = self._command(host, module, *arguments)
        return subprocess.run(command, cwd=cwd, env=environment(), capture_output=True, text=True, timeout=timeout_s)

    def address(self, host: str) -> str:
        """Return the address of a host."""
        return f"{NETWORK}.{FIRST + self._hosts.index(host)}"

    def _command(self, host: str, module: str, *arguments: object) -> list[str]:
        # `ip netns exec` makes a mount namespace as well, so the machine's own /etc/hosts stays as it is.
        named = () if self.names is None else ("sh", "-c", 'mount --bind "$0" /etc/hosts && exec "$@"', str(self.names))
        leash = [sys.executable, "-m", "rti_mpc_service.rig.leash", str(os.getpid())]
        return ["ip", "netns", "exec", name_of(host), *named, *leash, module, *map(str, arguments)]

    def cut(self, host: str) -> None:
        """Let nothing pass between a host and the others."""
        ip("-n", name_of(MIDDLE), "link", "set", host, "down")

    def restore(self, host: str) -> None:
        """Let everything pass again."""
        ip("-n", name_of(MIDDLE), "link", "set", host, "up")


def name_of(host: str) -> str:
    """Return the name of a host's namespace."""
    return f"{PREFIX}{os.getpid()}-{host}"


def left_behind() -> list[str]:
    """Return namespaces of tests that are over."""
    listed = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=False).stdout.splitlines()
    names = [line.split()[0] for line in listed if line.startswith(PREFIX)]
    return [name for name in names if not Path(f"/proc/{name.removeprefix(PREFIX).split('-')[0]}").exists()]
