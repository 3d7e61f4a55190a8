# SPDX-License-Identifier: Apache-2.0
"""Configurations with a guard, and the file of signals beside them that a guard reads."""

from __future__ import annotations

from pathlib import Path

from rti_mpc_service.config import signals_file
from rti_mpc_service.config.build import build_signals
from rti_mpc_service.config.config import load
from rti_mpc_service.shipped import SHIPPED

GUARDED = "\n[guard]\nenabled = true\n"


def write_robot(path: Path, more: str = "", text: str = SHIPPED.read_text() + GUARDED) -> Path:
    """Write a configuration, the shipped one with a guard if no other is given, and the signals of its model as `check` does."""
    path.write_text(text + more)
    signals_file.write(path, build_signals(load(path)))
    return path
