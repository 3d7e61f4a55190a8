# SPDX-License-Identifier: Apache-2.0
"""Replacement of files: each is there as it was or as it is to be, whatever ends the process meanwhile, or the power."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedWriter
from pathlib import Path


@contextmanager
def replaced(path: Path, mode: int = 0o666) -> Iterator[BufferedWriter]:
    """
    Yield a file to write, which takes the place of another at the end of the block, once the disk has it; after an error nothing has changed.

    Args:
        path: The file to replace, or to create.
        mode: Mode of the file, less the process's mask.

    Raises:
        OSError: It cannot be written.
    """
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}")  # of nobody else, as several threads may write the same file
    try:
        with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, mode), "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
