# SPDX-License-Identifier: Apache-2.0
"""
Effect of `[realtime]` on the latency from state to command, on an idle machine and beside busy processes.

Real processes, 100 samples per second. In every round each setting has a controller
of its own, the settings in random order. The test demands only that the settings
were granted: their effect depends on the machine.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from rti_mpc_service.host import machine, realtime
from tests.bench.driven import driven, quantiles

pytestmark = pytest.mark.benchmark

DT_S = 0.01
SHORT = "CI" in os.environ
ROUNDS = 1 if SHORT else 4
COLD, BLOCK = 100, 300  # samples
LAST_CORE = realtime.available()[-1]
SETTINGS = {
    "off": "",
    "priority": "priority = 20",
    "cores": f"cores = [{LAST_CORE}]",
    "all": f"priority = 20\ncores = [{LAST_CORE}]\nlock_memory = true",
}
ENDLESS_LOOP = "while True: pass"


@contextmanager
def company(number: int) -> Iterator[None]:
    """Busy processes, each of which occupies a core."""
    greedy = [subprocess.Popen([sys.executable, "-c", ENDLESS_LOOP]) for _ in range(number)]
    try:
        yield
    finally:
        for process in greedy:
            process.kill()
            process.wait()


def test_what_real_time_is_worth_here(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(1)
    times: dict[tuple[str, int], list[np.ndarray]] = {(name, number): [] for number in (0, len(realtime.available())) for name in SETTINGS}
    for k in range(ROUNDS):
        for name, number in rng.permutation(np.array(list(times), dtype=object)).tolist():
            folder = tmp_path / f"{k}-{name}-{number}"
            folder.mkdir()
            with driven(folder, DT_S, 60.0, realtime=SETTINGS[name]) as robot:
                if "refused" in (folder / "controller.log").read_text():
                    pytest.skip(f"{name} is not granted here: NOT measured")
                with company(number):
                    robot.samples(COLD)
                    times[name, number].append(np.array([sample.latency_us for sample in robot.samples(BLOCK)]))
    with capsys.disabled():
        print(f"\n{machine.machine_info()}\nstate in to command out, {ROUNDS} rounds of {BLOCK} samples")
        for (name, number), blocks in times.items():
            print(f"  {name:9} beside {number} that never rest  {quantiles(np.concatenate(blocks))}")
