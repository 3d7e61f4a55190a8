# SPDX-License-Identifier: Apache-2.0
"""One run of a robot along a reference, as arrays for drawing figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.contract.message import Reference
from rti_mpc.signals import in_plane, plane
from rti_mpc.wire.info import Info, Obstacle
from rti_mpc_service.rig.along_path import AlongPath


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
        y: True outputs, shape ``(M, ny)``.
        reference: Outputs the reference asks for at the stamps, shape ``(M, ny)``.
        sample_stamp_ns: Stamps of the samples' telemetry, shape ``(K,)``.
        prepare_us: Times of the preparation phases, shape ``(K,)``.
        feedback_us: Times of the feedback phases, shape ``(K,)``.
        latency_us: Time from a state sent to its command received, shape ``(K,)``.
        speed: Seconds of robot time per second.
        transient_s: Time that the robot may take to reach the reference.
        along: The drive along a path that says nothing of time; None where none was followed.
        discs: x, y and radius of each obstacle at the stamps, in m, each of shape ``(M, 3)``.
    """

    info: Info
    scenario: str
    stamp_ns: NDArray[np.int64]
    x: Array
    u_applied: Array
    y: Array
    reference: Array
    sample_stamp_ns: NDArray[np.int64]
    prepare_us: Array
    feedback_us: Array
    latency_us: Array
    speed: float = 1.0
    transient_s: float = 20.0
    along: AlongPath | None = None
    discs: tuple[Array, ...] = ()

    @property
    def time_s(self) -> Array:
        """Times of the states since the first, shape ``(M,)``."""
        return np.asarray(1e-9 * (self.stamp_ns - self.stamp_ns[0]))

    @property
    def sample_time_s(self) -> Array:
        """Times of the samples since the first state, shape ``(K,)``."""
        return np.asarray(1e-9 * (self.sample_stamp_ns - self.stamp_ns[0]))

    @property
    def planar(self) -> bool:
        """Whether the outputs are a pose in the plane."""
        return in_plane(self.info.outputs)

    @property
    def position(self) -> Array:
        """True positions in m, shape ``(M, 2)``; NaN where none of the outputs are, and no path is followed."""
        return self._position(self.y) if self.along is None else self.along.position

    @property
    def path(self) -> Array:
        """Positions the reference asks for in m, shape ``(M, 2)``, or points of a path at the robot's progress; NaN likewise."""
        return self._position(self.reference) if self.along is None else self.along.point

    @property
    def error_mm(self) -> Array:
        """Distance of the true position from the reference at the same stamp, shape ``(M,)``; NaN likewise."""
        dx, dy = (self.position - self.path).T
        return np.asarray(1e3 * np.hypot(dx, dy))

    @property
    def output_error(self) -> Array:
        """True outputs less those asked for at the same stamp, angles within pi, each in its unit; shape ``(M, ny)``."""
        return self.info.rotations("outputs").difference(self.y, self.reference)

    def _position(self, y: Array) -> Array:
        columns = plane(self.info.outputs)
        return np.full((len(y), 2), np.nan) if columns is None else y[:, columns]

    @property
    def settled(self) -> NDArray[np.bool_]:
        """Which states come after the transient, shape ``(M,)``."""
        return np.asarray(self.time_s >= self.transient_s)

    @property
    def period_us(self) -> float:
        """Wall time available for a sample."""
        return 1e6 * self.info.dt_s / self.speed


def wanted(reference: Reference, stamp_ns: NDArray[np.int64]) -> Array:
    """Return the outputs a reference asks for at stamps, shape ``(..., ny)``, interpolated between its rows; at its ends beyond them."""
    rows = (stamp_ns - reference.stamp_ns) / reference.period_ns
    return np.stack([np.interp(rows, np.arange(len(reference.y)), column) for column in reference.y.T], axis=-1)


def located(obstacle: Obstacle, reference: Reference | None, stamps: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Return x, y and radius of an obstacle at stamps, each of shape ``(n,)``, in m; constant before and after the reference, as in a controller."""
    if reference is None or reference.p.shape[1] < obstacle.at + 3:
        x, y, r = (np.full(len(stamps), value) for value in (obstacle.x, obstacle.y, obstacle.r))
    else:
        row = (stamps - reference.stamp_ns) / reference.period_ns
        x, y, r = (np.interp(row, np.arange(len(reference.p)), reference.p[:, obstacle.at + part]) for part in range(3))
    return x, y, r
