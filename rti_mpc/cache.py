# SPDX-License-Identifier: Apache-2.0
"""
Cache of compiled code: one file per problem, in a folder that no other user may write to.

Loaded code runs with the rights of this process, and a truncated file ends it by SIGBUS.
So a file is loaded only if it belongs to this user, no other user may write to it, and it
is complete: it ends with its seal, a hash of its key and content. A file is put in place
by a rename, so that neither another process nor a power cut leaves half of it. A file
that fails a check is built anew.
"""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path

from rti_mpc.whole_file import replaced

SEAL_BYTES = hashlib.sha256().digest_size
WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH  # bits of a file mode


def cache_dir() -> Path:
    """
    Return where compiled code is kept (XDG base directory specification).

    Raises:
        OSError: No folder is known.
    """
    given = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(given):  # by the specification a relative path is ignored
        return Path(given) / "rti_mpc"
    try:
        return Path.home() / ".cache" / "rti_mpc"
    except RuntimeError:
        raise OSError("XDG_CACHE_HOME or HOME must name a folder for it") from None


def make_private(folder: Path) -> None:
    """
    Create a folder that no other user may write to, or check that it is one.

    Raises:
        OSError: The folder cannot be created, or other users could write to it or replace it.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder = folder.resolve()
    if not _ours(folder.stat()):
        raise OSError(f"{folder} must be a folder of this user that nobody else may write: chown it, and chmod 700")
    for parent in folder.parents:
        state = parent.stat()
        if state.st_uid not in (0, os.geteuid()) or (state.st_mode & stat.S_IWOTH and not state.st_mode & stat.S_ISVTX):
            raise OSError(f"{parent}, above {folder}, must belong to root or this user, and not be writable by all")


def is_intact(path: Path, key: str) -> bool:
    """Whether a file is complete, was kept under this key, and belongs to this user."""
    try:
        state = path.lstat()
        if not (stat.S_ISREG(state.st_mode) and _ours(state)):
            return False
        content = path.read_bytes()
    except OSError:
        return False
    return content[-SEAL_BYTES:] == _seal(key, content[:-SEAL_BYTES])


def write_sealed(path: Path, key: str, content: bytes) -> None:
    """
    Write a sealed file, completely or not at all; a loader ignores the seal behind the end of a shared object.

    Raises:
        OSError: The file cannot be written.
    """
    with replaced(path, 0o600) as file:
        file.write(content + _seal(key, content))


def _ours(state: os.stat_result) -> bool:
    """Whether a file or folder belongs to this user, and no other user may write to it."""
    return state.st_uid == os.geteuid() and not state.st_mode & WRITABLE_BY_OTHERS


def _seal(key: str, content: bytes) -> bytes:
    return hashlib.sha256(key.encode() + b"\0" + content).digest()
