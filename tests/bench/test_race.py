# SPDX-License-Identifier: Apache-2.0
"""CPU time of both phases of a sample while the race car of `examples/race.py` laps a track."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.reference.tracks import TRACKS, track
from tests.bench.timed import timed

EXAMPLE = Path(__file__).parents[2] / "examples" / "race.py"

pytestmark = pytest.mark.benchmark


def test_phases_of_a_race() -> None:
    race = runpy.run_path(str(EXAMPLE))
    rti = race["racing"]()
    phases: dict[str, list[float]] = {"prepare": [], "feedback": []}
    for name, took_ms in phases.items():
        setattr(rti, name, timed(getattr(rti, name), took_ms))
    for name in TRACKS:
        for took_ms in phases.values():
            took_ms.clear()
        lap = race["follow"](rti, track(name).limited(race["LIMITS"]))
        times = (f"{phase} median {np.median(ms):.2f}, p99 {np.percentile(ms, 99):.2f} ms" for phase, ms in phases.items())
        print(f"\n{name:8} {lap.time_s:.2f} s: {'; '.join(times)}, of {1e3 * race['DT_S']:.0f}")
