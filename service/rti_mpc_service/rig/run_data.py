# SPDX-License-Identifier: Apache-2.0
"""One run of a robot along a reference, as arrays for drawing figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.wire.info import Info


@dataclass(frozen=True, eq=False)
class Run:
    """
    A run, with one row per state of the robot and one row per sample of the controller.

    Attributes:
        info: The controller's description: names, units, limits, period.
        scenario: Name of the reference.
        stamp_ns: Stamps of the states, robot time, shape ``(M,)``.
        x: True states, shape ``(M, nx)``.
        u_applied: Inputs acting at the stamps, shape ``(M, nu)``.
        reference: Position the reference asks for at the stamps, in m, shape ``(M, 2)``.
        sample_stamp_ns: Stamps of the samples' telemetry, shape ``(K,)``.
        prepare_us: Times of the preparation phases, shape ``(K,)``.
        feedback_us: Times of the feedback phases, shape ``(K,)``.
        latency_us: Time from a state sent to its command received, shape ``(K,)``.
        speed: Seconds of robot time per second.
        transient_s: Time that the robot may take to reach the reference.
    """

    info: Info
    scenario: str
    stamp_ns: NDArray[np.int64]
    x: Array
    u_applied: Array
    reference: Array
    sample_stamp_ns: NDArray[np.int64]
    prepare_us: Array
    feedback_us: Array
    latency_us: Array
    speed: float = 1.0
    transient_s: float = 20.0

    @property
    def time_s(self) -> Array:
        """Times of the states since the first, shape ``(M,)``."""
        return np.asarray(1e-9 * (self.stamp_ns - self.stamp_ns[0]))

    @property
    def sample_time_s(self) -> Array:
        """Times of the samples since the first state, shape ``(K,)``."""
        return np.asarray(1e-9 * (self.sample_stamp_ns - self.stamp_ns[0]))

    @property
    def position(self) -> Array:
        """True positions in m, shape ``(M, 2)``; NaN where the model has none."""
        return np.full((len(self.x), 2), np.nan) if self.info.position is None else self.x[:, self.info.position]

    @property
    def error_mm(self) -> Array:
        """Distance of the true position from the reference at the same stamp, shape ``(M,)``; NaN where the model has no position."""
        dx, dy = (self.position - self.reference).T
        return np.asarray(1e3 * np.hypot(dx, dy))

    @property
    def settled(self) -> NDArray[np.bool_]:
        """Which states come after the transient, shape ``(M,)``."""
        return np.asarray(self.time_s >= self.transient_s)

    @property
    def period_us(self) -> float:
        """Wall time available for a sample."""
        return 1e6 * self.info.dt_s / self.speed
