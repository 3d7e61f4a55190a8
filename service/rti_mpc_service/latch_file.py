# SPDX-License-Identifier: Apache-2.0
"""
File of one robot's latch: read at the start of a process, and written atomically at each change.

There is one file per prefix and robot, in a folder that outlives processes. Several
processes of a host may share it: a writer holds the folder's lock and writes the
greater of the stored latch and its own.
"""

from __future__ import annotations

import fcntl
import json
import os
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from urllib.parse import quote

from rti_mpc.contract.latch import Latch, read_latch, shown
from rti_mpc.errors import MessageError
from rti_mpc.wire import document
from rti_mpc.wire.keys import Keys

FILE_VERSION = 1
MAX_FILE_BYTES = 4096  # a larger file is not a latch file
LOCK_TIMEOUT_S = 5.0  # other writers hold the lock while they sync a file and a folder, which takes long on a busy disk
NO_FOLDER = "no folder is known for it: neither --state, $STATE_DIRECTORY, $XDG_STATE_HOME nor $HOME says where"


def state_folder() -> Path | None:
    """Return the folder that systemd gives (``StateDirectory=``), or that of the XDG base directory specification; None if there is none."""
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.partition(":")[0])
    if given := os.environ.get("XDG_STATE_HOME"):
        return Path(given) / "rti_mpc"
    with suppress(RuntimeError):  # no HOME, and no entry for this user
        return Path.home() / ".local" / "state" / "rti_mpc"
    return None


class LatchFile:
    """
    The latch file of one robot.

    Attributes:
        path: Path of the file; None if no folder is known.
    """

    def __init__(self, keys: Keys, folder: Path | None = None) -> None:
        """
        Determine the path of the file.

        Args:
            keys: The robot's keys.
            folder: Folder of the file; None: `state_folder`.
        """
        folder = folder or state_folder()
        self.path = None if folder is None else folder / f"{quote(f'{keys.prefix}/{keys.robot}', safe='')}.json"

    def read(self) -> tuple[Latch, str]:
        """Return the latch and the fault of the file, empty if there is none; an unreadable file counts as a stop with the lowest counter."""
        try:
            return self._read(), ""
        except (FileNotFoundError, NotADirectoryError):
            return Latch(), ""
        except OSError as error:
            fault = str(error.strerror)
        except MessageError as error:
            fault = str(error)
        return Latch(stopped=True, reason="its file cannot be understood"), f"{self.path}: {fault}"

    def write(self, latch: Latch) -> None:
        """
        Store a latch, unless a greater one is stored already.

        Raises:
            OSError: The latch cannot be stored.
        """
        if self.path is None:
            raise OSError(0, NO_FOLDER)
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            lock(folder)
            content = json.dumps({"version": FILE_VERSION, **asdict(max(latch, self.read()[0]))})
            beside = self.path.with_name(f"{self.path.name}.tmp")
            beside.unlink(missing_ok=True)  # left by a process that was killed while writing
            with beside.open("xb") as file:
                file.write(content.encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())
            beside.replace(self.path)
            os.fsync(folder)
        finally:
            os.close(folder)

    def obstacle(self) -> str:
        """Return why a latch cannot be stored, as far as that is known without trying; empty if nothing is known to prevent it."""
        if self.path is None:
            return NO_FOLDER
        there = next(folder for folder in self.path.parents if folder.exists())
        if not there.is_dir():
            return f"{there} must be a folder"
        return "" if os.access(there, os.W_OK | os.X_OK) else f"{there} cannot be written"

    def _read(self) -> Latch:
        if self.path is None:
            return Latch()
        descriptor = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK)  # does not block on a pipe of that name
        try:
            payload = os.read(descriptor, MAX_FILE_BYTES + 1)
        finally:
            os.close(descriptor)
        content = document.read(payload, most=MAX_FILE_BYTES)
        if content.get("version") != FILE_VERSION:
            raise MessageError(f"must be of version {FILE_VERSION}, got {shown(content.get('version'))}")
        return read_latch(content)


def lock(folder: int) -> None:
    """
    Lock an open folder against other writers; closing the folder releases the lock.

    Raises:
        TimeoutError: Another process has held the lock for too long.
    """
    deadline_s = time.monotonic() + LOCK_TIMEOUT_S
    while True:
        try:
            return fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > deadline_s:
                raise TimeoutError(0, f"another process has held the lock of the folder for {LOCK_TIMEOUT_S:g} s") from None
            time.sleep(0.01)
