# SPDX-License-Identifier: Apache-2.0
"""
Readings of what the paper leaves open.

Which curve, heading, `a` and plant give its 3 mm, how fast its references are, and where the second one ends.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rti_mpc.array import Array
from rti_mpc.reference.trajectory import Trajectory, circle, eight, positioning
from rti_mpc_service.paper.experiment import BEST_SETTINGS, Experiment
from rti_mpc_service.paper.race import DURATION_S

PRINTED_MM = 3.0
PRINTED_SPEED_M_S = 0.25
OFFSETS_M = (0.0, 0.05, 0.1, 0.2, 0.3)
CLOSED_PATHS = (circle().lasting(DURATION_S), eight().lasting(DURATION_S))
FOUND = Experiment(CLOSED_PATHS[1], heading="consistent", plant="euler")


def headings() -> Iterator[Experiment]:
    """Yield every reading of the first experiment: curve, heading, `a`, plant."""
    for trajectory in CLOSED_PATHS:
        for plant in ("euler", "continuous"):
            yield Experiment(trajectory, heading="atan", plant=plant)
            for heading in ("tangent", "consistent", "none"):
                for a in OFFSETS_M[heading != "tangent" :]:  # at a = 0 the consistent heading is the tangent, and without one nothing steers
                    yield Experiment(trajectory, heading=heading, a=a, plant=plant)


def converged() -> tuple[Experiment, ...]:
    """Return the readings that are judged by converged NMPC, too."""
    return (FOUND, replace(FOUND, plant="continuous"), replace(FOUND, heading="tangent"), Experiment(CLOSED_PATHS[0], plant="euler"))


def faster(trajectory: Trajectory, factor: float) -> Trajectory:
    """Return the same path, followed faster."""
    assert trajectory.lap_s is not None
    return replace(
        trajectory,
        position=lambda t: trajectory.position(factor * t),
        velocity=lambda t: factor * trajectory.velocity(factor * t),
        lap_s=trajectory.lap_s / factor,
    )


def speed(trajectory: Trajectory) -> dict[str, float]:
    """Return least, mean and largest speed of a reference over a lap, or while it moves, m/s."""
    values = np.hypot(*trajectory.velocity(np.linspace(0.0, trajectory.lap_s or 5 * math.pi, 10_001)[:-1]).T)
    return {"min": float(values.min()), "mean": float(values.mean()), "max": float(values.max())}


def speeds() -> dict[str, dict[str, float]]:
    """Return the speeds of all references."""
    return {trajectory.name: speed(trajectory) for trajectory in (circle(), eight(), positioning())}


def at_printed_speed() -> Iterator[Experiment]:
    """Yield the closed paths as their formulas say, and at the mean speed the paper says."""
    for trajectory in CLOSED_PATHS:
        factor = PRINTED_SPEED_M_S / speed(trajectory)["mean"]
        for path in (trajectory, faster(trajectory, factor)):
            yield Experiment(path, heading="consistent")
            yield Experiment(path, **BEST_SETTINGS)


def goals() -> dict[str, Experiment]:
    """Return the second experiment with the two ends its reference may have: where its formulas lead, and -r sqrt(2) for both coordinates."""
    path = positioning()
    stop_s, goal = 5 * math.pi, -0.4 * math.sqrt(2.0)

    def jumping(t: Array) -> Array:
        return np.where(np.asarray(t)[..., None] < stop_s, path.position(t), goal)

    return {"continuous": Experiment(path), "jumping": Experiment(replace(path, position=jumping))}


def jump_mm(trajectory: Trajectory) -> float:
    """Return how far a reference leaps at the end of its path."""
    before, after = trajectory.position(np.array([5 * math.pi - 1e-9, 5 * math.pi]))
    return float(1e3 * np.hypot(*(after - before)))
