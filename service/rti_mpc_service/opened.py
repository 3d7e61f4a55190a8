# SPDX-License-Identifier: Apache-2.0
"""Opening of a recording that somebody names, by every command that takes one: refused in one line, which says what would be right."""

from __future__ import annotations

from pathlib import Path

from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.recording.reader import Recording


def opened(path: Path) -> Recording:
    """
    Open a recording.

    Raises:
        ConfigError: It is none, or cannot be read.
    """
    try:
        return Recording(path)
    except OSError as error:
        raise ConfigError(f"{path} must be a recording that can be read: {error.strerror}") from error
    except MessageError as error:
        raise ConfigError(str(error)) from error
