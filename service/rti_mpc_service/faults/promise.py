# SPDX-License-Identifier: Apache-2.0
"""Promises under a fault: limits on what is measured, and the words where one is broken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rti_mpc_service.faults.measure import Measured

NOTHING: Mapping[str, float] = {}
ROUNDING = 1e-6  # of a share
EVERYWHERE = {"step_share": 1.0 + ROUNDING, "stale": 0.0}
BRAKES = {"brake_s": 0.3, "zero_s": 0.5}
AGAIN = {"recovery_s": 20.0}  # processes started again included


@dataclass(frozen=True)
class Promise:
    """
    A promise.

    Attributes:
        text: What it says, in words.
        at_most: Limits by names of `Measured`; what has a limit must have happened.
    """

    text: str
    at_most: Mapping[str, float]

    @property
    def on_path(self) -> bool:
        """Whether it is about the distance from the reference."""
        return not {"error_m", "final_error_m"}.isdisjoint(self.at_most)

    def broken(self, measured: Measured, excused: Mapping[str, float] = NOTHING) -> list[str]:
        """Return what is not within the promise, nor excused: by how much each number may be more than its limit."""
        values = {name: getattr(measured, name) for name in self.at_most}
        return [
            f"{name} must be at most {limit:g}, got {'none' if values[name] is None else f'{values[name]:.4g}'}"
            for name, limit in self.at_most.items()
            if values[name] is None or not values[name] <= limit + excused.get(name, 0.0)
        ]


STOPS = Promise("stops, and drives again when mended", {**EVERYWHERE, **BRAKES, "still_s": 2.5, **AGAIN})
STAYS = Promise("stops, stands whoever is restarted, and drives again when released", STOPS.at_most)
PAUSES = Promise("brakes to zero, and drives again when mended", {**EVERYWHERE, **BRAKES, **AGAIN})
KEEPS_ON = Promise("keeps on", {**EVERYWHERE, "missed": 0.0, "error_m": 0.01})
RECOVERS = Promise("is driven again when mended", {**EVERYWHERE, **AGAIN})
REJOINS = Promise("moves over to the new reference", {**EVERYWHERE, "missed": 0.0, "final_error_m": 0.01})
HOLDS = Promise("stands where the reference ends, and drives again when mended", {**EVERYWHERE, "still_s": 5.0, "final_error_m": 0.01, **AGAIN})
WAITS = Promise("does not move before there is a reference", {**EVERYWHERE, "distance_m": 1e-6, **AGAIN})
