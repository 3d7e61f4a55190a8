# SPDX-License-Identifier: Apache-2.0
"""Promises under a fault: limits on the measured reaction of the robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from rti_mpc_service.faults.measure import Measured

NO_EXCUSE: Mapping[str, float] = {}
SHARE_ROUNDING = 1e-6  # rounding of `Measured.step_share`
ALWAYS = {"step_share": 1.0 + SHARE_ROUNDING, "stale": 0.0}
BRAKING = {"brake_s": 0.3, "zero_s": 0.5}
RECOVERY = {"recovery_s": 20.0}  # includes the start of processes that were killed


@dataclass(frozen=True)
class Promise:
    """
    A promise about the robot's reaction to a fault.

    Attributes:
        text: The promise in words.
        at_most: Upper limits by field of `Measured`; a field with a limit must not be None.
    """

    text: str
    at_most: Mapping[str, float]

    @property
    def on_path(self) -> bool:
        """Whether it is about the distance from the reference."""
        return not {"error_m", "final_error_m"}.isdisjoint(self.at_most)

    def eased(self, error_m: float) -> Promise:
        """Return the promise of a robot that is this far from its reference without any fault."""
        limits = {name: limit + error_m if name in ("error_m", "final_error_m") else limit for name, limit in self.at_most.items()}
        return replace(self, at_most=limits)

    def without_standstill(self) -> Promise:
        """Return the promise of a robot that coasts, or falls, with its inputs at rest: of the inputs, not of where the robot ends."""
        coasts = {"still_s", "distance_m"} if "brake_s" in self.at_most or "distance_m" in self.at_most else set()
        return replace(self, at_most={name: limit for name, limit in self.at_most.items() if name not in coasts})

    def by_ramp(self, ramp_s: float) -> Promise:
        """Return the promise of a robot whose slew limits take so long from its widest inputs to rest, once it brakes."""
        if "zero_s" not in self.at_most:
            return self
        return replace(self, at_most={**self.at_most, "zero_s": max(self.at_most["zero_s"], self.at_most["brake_s"] + ramp_s)})

    def by_way(self, within_s: float) -> Promise:
        """Return the promise of a robot that its inputs at rest do not stop: it stands once its way to rest is over, whatever its inputs do there."""
        if "brake_s" not in self.at_most:
            return self
        stands = {"still_s": within_s} if "still_s" in self.at_most else {}
        return replace(self, at_most={name: limit for name, limit in self.at_most.items() if name not in BRAKING} | stands)

    def broken(self, measured: Measured, excused: Mapping[str, float] = NO_EXCUSE) -> list[str]:
        """Return the broken limits, in words; `excused` says by how much each value may exceed its limit."""
        values = {name: getattr(measured, name) for name in self.at_most}
        return [
            f"{name} must be at most {limit:g}, got {'none' if values[name] is None else f'{values[name]:.4g}'}"
            for name, limit in self.at_most.items()
            if values[name] is None or not values[name] <= limit + excused.get(name, 0.0)
        ]


STOPS = Promise("stops, and drives again when mended", {**ALWAYS, **BRAKING, "still_s": 2.5, **RECOVERY})
STAYS = Promise("stops, stands whoever is restarted, and drives again when released", STOPS.at_most)
PAUSES = Promise("brakes to zero, and drives again when mended", {**ALWAYS, **BRAKING, **RECOVERY})
KEEPS_ON = Promise("keeps on", {**ALWAYS, "missed": 0.0, "error_m": 0.01})
RECOVERS = Promise("is driven again when mended", {**ALWAYS, **RECOVERY})
REJOINS = Promise("moves over to the new reference", {**ALWAYS, "missed": 0.0, "final_error_m": 0.01})
HOLDS = Promise("stands where the reference ends, and drives again when mended", {**ALWAYS, "still_s": 5.0, "final_error_m": 0.01, **RECOVERY})
WAITS = Promise("does not move before there is a reference", {**ALWAYS, "distance_m": 1e-6, **RECOVERY})
