# SPDX-License-Identifier: Apache-2.0
"""Pressure on the cores of this host, as Linux counts it (PSI)."""

from __future__ import annotations

from pathlib import Path

PRESSURE = Path("/proc/pressure/cpu")


def waited_us(path: Path = PRESSURE) -> int | None:
    """Return for how long processes, of any priority, have waited for a core since the host was booted, us; None if the kernel does not count."""
    try:
        words = path.read_text().split()
    except OSError:
        return None
    return next((int(word[len("total=") :]) for word in words if word.startswith("total=")), None)  # the first line is "some"
