# SPDX-License-Identifier: Apache-2.0
"""Text files of users: regular files of bounded size, in UTF-8 with or without a byte-order mark."""

from __future__ import annotations

import stat
from pathlib import Path

from rti_mpc.errors import ConfigError

MAX_FILE_BYTES = 1 << 17  # ten times what a configuration with a weight for each of a thousand stages needs


def read_text_file(path: Path, kind: str, max_bytes: int = MAX_FILE_BYTES) -> str:
    """
    Read a whole file; never waits, as it would for a pipe, and refuses a file that is too large.

    Args:
        path: Path of the file.
        kind: Expected content, for the error.
        max_bytes: Largest size.

    Raises:
        ConfigError: The file is missing, not a regular file, too large, or not text.
    """
    try:
        state = path.stat()
        if not stat.S_ISREG(state.st_mode):
            raise ConfigError(f"{path}: must be a file of {kind}, got a {'folder' if stat.S_ISDIR(state.st_mode) else 'pipe or device'}")
        if state.st_size > max_bytes:
            raise ConfigError(f"{path}: must be {kind} of at most {max_bytes} bytes, got {state.st_size}")
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"{path}: must be a readable file, got {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: must be {kind} in UTF-8, got byte 0x{error.object[error.start]:02x} after {error.start} others") from error
