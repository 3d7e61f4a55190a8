# SPDX-License-Identifier: Apache-2.0
"""Description of the machine on which figures are measured."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

CPUINFO = Path("/proc/cpuinfo")
GOVERNOR = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
GIT_TIMEOUT_S = 2.0
PACKAGES = ("casadi", "eclipse-zenoh", "numpy", "osqp")


def machine_info() -> dict[str, Any]:
    """Return processor, load, system and package versions, in JSON."""
    return {
        "processor": processor(),
        "cores": os.cpu_count(),
        "governor": GOVERNOR.read_text().strip() if GOVERNOR.is_file() else "unknown",
        "load": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "packages": packages(),
    }


def packages() -> dict[str, str]:
    """Return the versions of the packages that decide what a command does."""
    return {name: version(name) for name in PACKAGES}


def processor() -> str:
    """Return the name of the processor; the architecture where the system tells no name."""
    if CPUINFO.is_file():
        for line in CPUINFO.read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def commit(folder: Path) -> str | None:
    """Return the git commit of a checkout, with ``-dirty`` where files differ from it; None without one, or without git."""
    if not (folder / ".git").exists():  # one further up is another project's, in which this one is installed
        return None
    command = ["git", "-C", str(folder), "--no-optional-locks", "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}  # a hook's name another repository
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=GIT_TIMEOUT_S, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None
