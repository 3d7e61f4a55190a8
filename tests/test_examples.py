# SPDX-License-Identifier: Apache-2.0
"""Examples run as they are, and what they print is as good as it was."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rti_mpc_service.host.hold_up import Host
from tests.in_time import explained

EXAMPLES = Path(__file__).parents[1] / "examples"
GALLERY = Path(__file__).parents[1] / "docs" / "gallery.md"
# The first number that each prints, or the one after a word, and what it must not exceed.
MOST = {
    "delay": (r"([\d.]+) mm off at most with the delay measured", 1.0),
    "observer": (r"([\d.]+) mm off with it", 5.0),
    "obstacles": (r"([\d.]+) mm off in the end", 1.0),
    "own_planner": (r"([\d.]+) mm off the walker", 20.0),
    "quadrotor": (r"([\d.]+) mm from where", 1.0),
    "race": (r"oval +([\d.]+) s", 13.5),
    "several_robots": (r"([\d.]+|nan) mm off is the worst", 10.0),
    "tuning": (r"R = 0\.0001 +[\d.]+ +([\d.]+)", 0.001),
}
MAX_HELD_UP_MS = {"several_robots": 3000.0}  # of examples in real time, half a minute: a host that holds them up for longer may spoil what they print


def test_every_example_is_run() -> None:
    assert set(MOST) == {path.stem for path in EXAMPLES.glob("*.py")}


@pytest.mark.parametrize("name", MOST)
def test_gallery_has_a_picture_of_each_example(name: str) -> None:
    page = GALLERY.read_text(encoding="utf-8")
    told = page.split(f"`{name}.py` ", 1)[1]
    picture = re.search(r"!\[[^]]+\]\(([^)]+)\)", told)
    assert picture is not None
    assert (GALLERY.parent / picture[1]).is_file()
    assert "`" not in told[: picture.start()].replace("`rti-mpc status --once --json`", ""), "the next picture is another example's"


@pytest.mark.slow
@pytest.mark.parametrize("name", MOST)
def test_example_prints_a_small_error_and_draws_a_picture(name: str, tmp_path: Path, host: Host) -> None:
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLES.parent)}
    picture = tmp_path / "drawn.png"
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), str(picture)]
    since_ns = time.monotonic_ns()
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert picture.stat().st_size > 10_000
    pattern, most = MOST[name]
    said = re.search(pattern, done.stdout)
    assert said is not None, done.stdout
    if not float(said[1]) <= most:
        assert name in MAX_HELD_UP_MS and explained(host, done.stdout, MAX_HELD_UP_MS[name], since_ns, time.monotonic_ns())
