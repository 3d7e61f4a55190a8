# SPDX-License-Identifier: Apache-2.0
"""Messages of `make` on a machine that lacks something: they name the package to install, and nothing is left behind."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOOLS = ("sh", "basename", "rm", "touch")  # what the recipes call besides Python; no uv
OLD = "exit 1"  # any Python outside the range: what is asked first is its version
WITHOUT_VENV = f'case "$2" in *ensurepip*) exit 1;; esac; exec {sys.executable} "$@"'  # as on Debian without python3-venv

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def make(tmp_path: Path, pythons: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    """Set up a clone where these are the only Pythons, each a shell script."""
    clone, bin_ = tmp_path / "clone", tmp_path / "bin"
    clone.mkdir()
    bin_.mkdir()
    for name in ("Makefile", "constraints.txt", "pyproject.toml"):
        shutil.copy(ROOT / name, clone)
    for tool in TOOLS:
        (bin_ / tool).symlink_to(str(shutil.which(tool)))
    for name, script in pythons.items():
        (bin_ / name).write_text(f"#!/bin/sh\n{script}\n")
        (bin_ / name).chmod(0o755)
    done = subprocess.run([str(shutil.which("make")), "demo"], cwd=clone, env={"PATH": str(bin_)}, capture_output=True, text=True, timeout=60)
    assert not (clone / ".venv").exists()
    return done


@pytest.mark.parametrize(
    ("pythons", "told"),
    [
        ({}, "make needs Python 3.11 to 3.14: apt-get install python3 python3-venv"),
        ({"python3": OLD}, "make needs Python 3.11 to 3.14: apt-get install python3 python3-venv"),
        ({"python3": WITHOUT_VENV}, "make needs venv: apt-get install python3-venv"),
        ({"python3": OLD, "python3.12": WITHOUT_VENV}, "make needs venv: apt-get install python3.12-venv"),
    ],
    ids=["no python", "an old python", "no venv", "no venv for a newer python"],
)
def test_make_names_the_package_that_is_missing(tmp_path: Path, pythons: dict[str, str], told: str) -> None:
    done = make(tmp_path, pythons)
    assert done.returncode == 2
    assert done.stderr.splitlines()[0] == told
    assert done.stdout == ""
