# SPDX-License-Identifier: Apache-2.0
"""Processes of ours, each in a group of its own, what they say in files, and none left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from types import TracebackType

END_TIMEOUT_S = 3.0  # between Ctrl-C and SIGKILL


class Children:
    """
    Starts processes and ends them by their ids, all of them at the end.

    Ctrl-C reaches us alone, and so does a closed terminal: we end the others, in
    the order that is right. Where we cannot, killed ourselves, the kernel presses
    Ctrl-C for each of them (`rti_mpc_service.rig.leash`). What they are to remember lies in our
    folder: a stop of a real robot of the same name is neither obeyed nor released.

    Attributes:
        folder: Where their output goes, a file each.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._logged: set[str] = set()  # those that were started before, whose output goes on

    def __enter__(self) -> Children:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        for name in list(self._running):
            self.end(name, 0.0 if kind else END_TIMEOUT_S)

    def start(self, name: str, module: str, *arguments: object, nice: int = 0) -> int:
        """
        Start a module of ours as a process. It lives no longer than the thread that calls this: call it in the main thread.

        Args:
            name: For its output and for `end`.
            module: As after ``python -m``.
            arguments: Of its command line.
            nice: By how much others go before it.

        Returns:
            Its process id.
        """
        command = [sys.executable, "-P", "-m", "rti_mpc_service.rig.leash", str(os.getpid()), module, *map(str, arguments)]
        environment = {**os.environ, "STATE_DIRECTORY": str(self.folder / "state")}
        with self.log(name).open("ab" if name in self._logged else "wb") as log:
            child = subprocess.Popen(
                command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, process_group=0
            )  # no session of its own: Linux weighs sessions against each other first, and niceness only within one
        os.setpriority(os.PRIO_PROCESS, child.pid, os.getpriority(os.PRIO_PROCESS, 0) + nice)
        self._running[name] = child
        self._logged.add(name)
        return child.pid

    def log(self, name: str) -> Path:
        """Return the file that holds what a process said."""
        return self.folder / f"{name}.log"

    def ended(self) -> str | None:
        """Return the name of a process that has ended by itself, if there is one."""
        return next((name for name, child in self._running.items() if child.poll() is not None), None)

    def signal(self, name: str, number: int) -> None:
        """Send a signal to a process."""
        self._running[name].send_signal(number)

    def kill(self, name: str) -> None:
        """End a process without notice, as a crash does."""
        child = self._running.pop(name)
        child.kill()
        child.wait()

    def pid(self, name: str) -> int | None:
        """Return the id of a process that was started and not ended by us; None if there is none."""
        return self._running[name].pid if name in self._running else None

    def end(self, name: str, patience_s: float = END_TIMEOUT_S) -> int:
        """Ask a process to end as Ctrl-C does, insist after a while, and return its exit status."""
        child = self._running.pop(name)
        if child.poll() is None:
            child.send_signal(signal.SIGINT)
        try:
            return child.wait(patience_s)
        except subprocess.TimeoutExpired:
            child.kill()
            return child.wait()
