# SPDX-License-Identifier: Apache-2.0
"""
The paper's experiments: every contender drives its own robot, all of them through the same samples.

At each sample they solve in random order, one after the other in one process,
so that each finds the caches as others left them, as a 10 Hz service does, and
every hiccup of the machine may hit any of them.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rti_mpc.reference.trajectory import eight, positioning
from rti_mpc_service.paper.contender import CONTENDERS, Contender
from rti_mpc_service.paper.experiment import BEST_SETTINGS, Experiment
from rti_mpc_service.paper.loop import Loop

DURATION_S = 82.8  # one lap after the transient
QUICK_DURATION_S, QUICK_TRANSIENT_S = 3.0, 2.0  # with --quick

# On the eight the heading is the one of the reading that gives the paper's 3 mm (`rti_mpc_service.paper.readings`).
EIGHT = Experiment(eight().lasting(DURATION_S), heading="consistent")
SCENARIOS = {"eight": EIGHT, "positioning": Experiment(positioning())}


def shortened(experiment: Experiment) -> Experiment:
    """Return an experiment that ends early."""
    return replace(experiment, trajectory=experiment.trajectory.lasting(QUICK_DURATION_S), transient_s=QUICK_TRANSIENT_S)


def grid(experiment: Experiment, build: Callable[[str, Experiment], Contender]) -> dict[str, Loop]:
    """Put all contenders at the start of an experiment; the last of them, ``"best"``, has `BEST_SETTINGS` settings."""
    loops = {name: Loop(experiment, build(name, experiment)) for name in CONTENDERS}
    best = replace(experiment, **BEST_SETTINGS)
    return loops | {"best": Loop(best, build("rti_simultaneous", best))}


def race(loops: dict[str, Loop], tick: Callable[[], None]) -> None:
    """Drive all loops to their end."""
    rng = np.random.default_rng(1)
    names = list(loops)
    gc.collect()
    gc.disable()
    try:
        for _ in range(loops["best"].experiment.samples):
            for name in rng.permutation(names):
                loops[name].step()
            tick()
    finally:
        gc.enable()
