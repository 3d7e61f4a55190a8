# SPDX-License-Identifier: Apache-2.0
"""Child processes: each in a process group of its own, with its output in a file, and none left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from types import TracebackType

from rti_mpc_service.entry import EXIT_BY_SIGNAL

END_TIMEOUT_S = 3.0  # between Ctrl-C and SIGKILL


class Children:
    """
    Starts processes and ends them by their ids, at the latest when its context ends.

    Ctrl-C and a closed terminal reach only this process, which ends the others in the
    right order. If it is killed itself, the kernel sends each of them SIGINT
    (`rti_mpc_service.rig.leash`). Their stored state lies in this folder, so that the
    stop of a real robot of the same name is neither obeyed nor released.

    Attributes:
        folder: Folder of their output, one file each.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._logged: set[str] = set()  # names that were started before, whose output is appended

    def __enter__(self) -> Children:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        for name in self.names:
            self.end(name, 0.0 if kind else END_TIMEOUT_S)

    def start(self, name: str, module: str, *arguments: object, nice: int = 0) -> int:
        """
        Start a module as a process. It lives no longer than the calling thread, so call it in the main thread.

        Args:
            name: Name for its output and for `end`.
            module: Module, as after ``python -m``.
            arguments: Arguments of the module.
            nice: Niceness added to that of this process.

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

    @property
    def names(self) -> list[str]:
        """Names of the processes that were started and not ended by us, oldest first."""
        return list(self._running)

    def log(self, name: str) -> Path:
        """Return the file that holds the output of a process."""
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
        """
        End a process by SIGINT, after `patience_s` by SIGKILL, and return its exit status.

        That is 0 also where this SIGINT has ended it while it was loading: then it had nothing to end.
        """
        child = self._running.pop(name)
        if runs := child.poll() is None:
            child.send_signal(signal.SIGINT)
        try:
            status = child.wait(patience_s)
            return 0 if runs and status in (-signal.SIGINT, EXIT_BY_SIGNAL + signal.SIGINT) else status
        except subprocess.TimeoutExpired:
            child.kill()
            return child.wait()
