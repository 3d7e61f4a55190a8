# SPDX-License-Identifier: Apache-2.0
"""Random sequences of everything that may happen, over thousands and millions of samples."""

from __future__ import annotations

import gc
import os

import numpy as np
import pytest

from tests.closed_loop.fuzz import Fuzz
from tests.closed_loop.lossy import Lossy
from tests.memory import PARTS, anonymous_bytes, leaked_bytes

SHORT_SAMPLES = 2_500
MANY_SAMPLES = 20_000 if "CI" in os.environ else 1_000_000


@pytest.mark.parametrize("measured", [pytest.param(False, marks=pytest.mark.slow, id="no delay"), pytest.param(True, id="measured delay")])
def test_no_fuzzed_sample_leaves_the_limits_or_raises(measured: bool) -> None:
    fuzz = Fuzz(seed=1, measured=measured)
    fuzz.run(SHORT_SAMPLES if measured else 2 * SHORT_SAMPLES)
    happened = set(fuzz.seen)
    assert {"TRACKING", "HOLDING", "FALLBACK", "BRAKING", "STOPPED", "over budget", "reference", "jump", "refused at the door"} <= happened
    assert {"qp", "nan_model", "solver", "state_stale", "state_old", "state_refused", "robot_restarted", "clock_jumped", "gap"} <= happened


def test_no_fuzzed_sample_leaves_a_reference_cycle() -> None:
    """The daemon runs with the collector off: what only that frees would stay for good."""
    fuzz = Fuzz(seed=5, measured=True)
    fuzz.run(100)
    gc.collect()
    gc.disable()
    try:
        fuzz.run(700)
        left = gc.collect()
    finally:
        gc.enable()
    assert {"TRACKING", "FALLBACK", "BRAKING", "refused at the door", "over_budget", "reference"} <= set(fuzz.seen)
    assert left == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_no_sample_of_a_million_leaves_the_limits_or_raises(seed: int) -> None:
    fuzz = Fuzz(seed=seed)
    looked = []
    for samples in np.linspace(MANY_SAMPLES // 5, MANY_SAMPLES, PARTS + 1):
        fuzz.run(round(samples))
        looked.append(anonymous_bytes())
    print(f"\n{fuzz.samples} samples, memory grown by {(looked[-1] - looked[0]) / 2**20:.2f} MiB: {dict(fuzz.seen)}")
    assert leaked_bytes(looked) < 2**22, looked  # of 800,000 samples


LOSSY = [
    pytest.param(False, True, id="no guard", marks=pytest.mark.slow),
    pytest.param(True, True, id="guard"),
    pytest.param(False, False, id="no guard, no reports", marks=pytest.mark.slow),
    pytest.param(True, False, id="guard, no reports", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("guarded", "reports"), LOSSY)
def test_no_input_leaves_its_limits_whatever_is_lost_late_repeated_or_reordered_on_any_link(guarded: bool, reports: bool) -> None:
    fuzz = Lossy(seed=4, guarded=guarded, reports=reports)  # a seed in whose few samples the clock jumps, which one in a thousand brings
    fuzz.run(SHORT_SAMPLES)
    assert {"TRACKING", "BRAKING", "accepted", "lost to robot", "lost to standby", "lost to controller", "takeover", "jump"} <= set(fuzz.seen)


@pytest.mark.slow
@pytest.mark.parametrize("guarded", [False, True], ids=["no guard", "guard"])
@pytest.mark.parametrize("seed", [2, 3])
def test_no_sample_of_a_million_leaves_its_limits_on_links_that_lose(seed: int, guarded: bool) -> None:
    fuzz = Lossy(seed=seed, guarded=guarded)
    fuzz.run(int(os.environ.get("FUZZ_SAMPLES", MANY_SAMPLES)))
    print(f"\n{fuzz.samples} samples: {dict(fuzz.seen)}")
