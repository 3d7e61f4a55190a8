# SPDX-License-Identifier: Apache-2.0
"""Polylines with rounded corners, by arc length."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.errors import ConfigError

REVERSAL_RAD = 3.1  # a corner that turns by more than this is a reversal, and has no arc


@dataclass(frozen=True)
class Polyline:
    """
    Straight lines and circular arcs that meet with equal tangents.

    Attributes:
        s0: Arc length at which each piece begins, shape ``(n,)``, in m.
        xy0: Point at which each piece begins, shape ``(n, 2)``, in m.
        theta0: Direction of each piece at its beginning, shape ``(n,)``, in rad.
        kappa: Curvature of each piece, shape ``(n,)``, in 1/m: 0 on lines.
        length: Total arc length, in m.
        closed: Whether the path ends where it begins.
    """

    s0: Array
    xy0: Array
    theta0: Array
    kappa: Array
    length: float
    closed: bool

    def position(self, s: Array) -> Array:
        """Point at arc length `s`, shape ``(..., 2)``; a closed path repeats, an open one stays at its end."""
        i, ds = self._locate(s)
        half = 0.5 * self.kappa[i] * ds
        chord = ds * np.sinc(half / np.pi)
        theta = self.theta0[i] + half
        return np.stack([self.xy0[i, 0] + chord * np.cos(theta), self.xy0[i, 1] + chord * np.sin(theta)], axis=-1)

    def direction(self, s: Array) -> Array:
        """Unit tangent at arc length `s`, shape ``(..., 2)``."""
        i, ds = self._locate(s)
        theta = self.theta0[i] + self.kappa[i] * ds
        return np.stack([np.cos(theta), np.sin(theta)], axis=-1)

    def _locate(self, s: Array) -> tuple[np.ndarray, Array]:
        """Find the piece of each arc length, and how far into it."""
        s = np.mod(s, self.length) if self.closed else np.clip(s, 0.0, self.length)
        i = np.searchsorted(self.s0, s, side="right") - 1
        return i, s - self.s0[i]


def polyline(points: Array, corner_m: float) -> Polyline:
    r"""
    Join points by straight lines and round the corners.

    An arc that turns by :math:`\delta` and passes its corner at distance `e`
    begins :math:`e / \tan(|\delta| / 4)` before it; it takes at most half of
    either edge, so that closely sampled curves become smooth and stay in place.
    A closed polyline (first point equal to the last) has an arc at its first
    point too and begins right after it.

    Args:
        points: Corners, shape ``(n, 2)``, in m. Repeated points count once.
        corner_m: Largest distance at which the path passes a corner; 0 leaves corners sharp.

    Raises:
        ConfigError: There are fewer than two distinct finite points, or the distance is negative.
    """
    points = distinct(points)
    if not (math.isfinite(given.number("corner_m", corner_m)) and corner_m >= 0.0):
        raise ConfigError(f"corner_m must be a distance of at least 0 m, got {corner_m}")
    closed = len(points) > 2 and bool(np.all(points[0] == points[-1]))

    edge = np.diff(points, axis=0)
    length = np.hypot(edge[:, 0], edge[:, 1])
    theta = np.arctan2(edge[:, 1], edge[:, 0])
    turn = np.remainder(theta - np.roll(theta, 1) + np.pi, 2 * np.pi) - np.pi  # at the start of each edge
    if not closed:
        turn[0] = 0.0
    rounded = (np.abs(turn) > 1e-12) & (np.abs(turn) < REVERSAL_RAD) & (corner_m > 0.0)
    reach = np.zeros_like(turn)
    reach[rounded] = np.minimum(corner_m / np.tan(0.25 * np.abs(turn[rounded])), 0.5 * np.minimum(length, np.roll(length, 1))[rounded])
    next_reach = np.append(reach[1:], reach[0])

    # Edge i is a line, then the arc at its end; the arc at the start of edge 0 closes the lap.
    next_turn = np.append(turn[1:], turn[0])
    radius = np.divide(next_reach, np.tan(0.5 * np.abs(next_turn)), out=np.zeros_like(reach), where=next_reach > 0.0)
    line_length = length - reach - next_reach
    unit = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    line_start = points[:-1] + reach[:, None] * unit
    arc_start = points[1:] - next_reach[:, None] * unit
    arc_kappa = np.divide(np.sign(next_turn), radius, out=np.zeros_like(radius), where=radius > 0.0)
    lengths = np.stack([line_length, radius * np.abs(next_turn)], axis=-1).ravel()
    keep = lengths > 0.0
    s = np.concatenate([[0.0], np.cumsum(lengths[keep])])
    return Polyline(
        s0=s[:-1],
        xy0=np.stack([line_start, arc_start], axis=1).reshape(-1, 2)[keep],
        theta0=np.repeat(theta, 2)[keep],
        kappa=np.stack([np.zeros_like(arc_kappa), arc_kappa], axis=-1).ravel()[keep],
        length=float(s[-1]),
        closed=closed,
    )


def distinct(points: Array) -> Array:
    """
    Return waypoints, each unlike the one before, shape ``(n, 2)``, in m.

    Raises:
        ConfigError: There are fewer than two distinct finite points.
        OcpError: They are no numbers.
    """
    points = given.numbers("waypoints", points)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ConfigError(f"waypoints must be finite, of shape (n, 2), got shape {points.shape}")
    points = np.concatenate([points[:1], points[1:][np.any(np.diff(points, axis=0) != 0.0, axis=1)]])
    if len(points) < 2:
        raise ConfigError(f"waypoints must be at least two distinct points, got {len(points)}")
    return points
