# SPDX-License-Identifier: Apache-2.0
"""Export of a recording as Parquet files."""

from __future__ import annotations

from pathlib import Path

from rti_mpc.errors import ConfigError
from rti_mpc.recording import export
from rti_mpc_service.opened import opened


def main(path: Path, folder: Path, *, horizon: bool) -> int:
    """
    Write a recording as Parquet files, print their names and rows, and return the exit status.

    Raises:
        ConfigError: It is no recording, or the files cannot be written.
    """
    recording = opened(path)
    try:
        written = export(recording, folder, horizon=horizon)
    except OSError as error:
        raise ConfigError(f"--parquet must be a folder that can be written, got {folder}: {error.strerror}") from error
    for file, rows in written:
        print(f"{file}: {rows} rows")
    return 0
