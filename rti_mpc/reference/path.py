# SPDX-License-Identifier: Apache-2.0
r"""
Smooth paths by arc length, with the widths of a track and a speed profile, for path following [Lam2010]_ [Faulwasser2016]_ [Liniger2015]_.

A path is a cubic B-spline whose knots lie at equal steps of arc length,

.. math::

    p(s) = \sum_k P_k \, b(s / h - k),

so that position, direction and curvature are continuous, and the part of it that a robot can reach within its horizon is given by a few
control points. An open path continues straight beyond its ends. Where a path turns back, at a cusp, it is split: each piece is followed to its
end before the next one begins.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path as File
from typing import Literal

import numpy as np

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.errors import ConfigError
from rti_mpc.reference.polyline import distinct
from rti_mpc.reference.smoothing import smoothed
from rti_mpc.reference.speed_profile import SpeedLimits, profile_time_s, speed_profile
from rti_mpc.reference.waypoint_file import read_track

CUSP_RAD = math.radians(120.0)  # a point at which the direction turns by more than this is a cusp
STEP_RADII = 0.5  # step of the knots, in smallest radii of the path: the spline is within 2e-4 of that radius of a circle
MIN_STEPS, MAX_STEPS = 16, 4000  # of a path
DENSE = 20  # points per given point at which arc length is measured
GAP_STEPS = 3.0  # a track whose last point is within this many typical distances of its first is closed
NEAR_STEPS = 8  # steps from the last projection within which the next one is looked for
NEWTON_STEPS = 4
MIN_SHRINKING = 0.2  # of 1 - curvature times offset in a Newton step, which vanishes at the centre of curvature


@dataclass(frozen=True, eq=False)
class Path:
    """
    One smooth piece of a path.

    Attributes:
        step_m: Arc length from knot to knot, in m.
        control: Control points, shape ``(n, 2)``, in m.
        right: Distance from the path to the right edge at the knots, shape ``(n,)``, in m.
        left: Distance to the left edge, shape ``(n,)``, in m.
        speed: Speed profile at the knots, shape ``(n,)``, in m/s.
        closed: Whether one more step leads from the last knot to the first.
    """

    step_m: float
    control: Array
    right: Array
    left: Array
    speed: Array
    closed: bool

    @property
    def length(self) -> float:
        """Arc length, in m: of a lap, if the path is closed."""
        return self.step_m * (len(self.control) - (not self.closed))

    @property
    def time_s(self) -> float:
        """How long the speed profile takes, in s."""
        return profile_time_s(self.speed, self.step_m, closed=self.closed)

    def position(self, s: Array) -> Array:
        """Points at arc lengths ``(...)``, shape ``(..., 2)``, in m; a closed path repeats, an open one continues straight."""
        return self._spline(s, 0)

    def tangent(self, s: Array) -> Array:
        """Unit tangents at arc lengths ``(...)``, shape ``(..., 2)``."""
        along = self._spline(s, 1)
        return np.asarray(along / np.hypot(along[..., 0], along[..., 1])[..., None])

    def curvature(self, s: Array) -> Array:
        """Curvatures at arc lengths ``(...)``, positive to the left, in 1/m."""
        along, bend = self._spline(s, 1), self._spline(s, 2)
        return np.asarray((along[..., 0] * bend[..., 1] - along[..., 1] * bend[..., 0]) / np.hypot(along[..., 0], along[..., 1]) ** 3)

    def at(self, values: Array, s: Array) -> Array:
        """Values between those at the knots, such as `right`, at arc lengths ``(...)``; held beyond the ends of an open path."""
        at = np.asarray(s) / self.step_m
        below = np.floor(at).astype(int)
        lower, upper = values[self._index(below)], values[self._index(below + 1)]
        return np.asarray(lower + (at - below) * (upper - lower))

    def project(self, point: Sequence[float] | Array, near: float | None = None) -> float:
        """
        Return the arc length at which the path is nearest to a point, in m.

        Args:
            point: x and y, in m.
            near: Arc length near which it is looked for, so that laps go on and crossings are passed; None: anywhere.
        """
        xy, quarter = np.asarray(point, dtype=np.float64), 0.25 * self.step_m
        reach = NEAR_STEPS * self.step_m
        candidates = np.arange(0.0, self.length + quarter, quarter) if near is None else np.arange(near - reach, near + reach, quarter)
        if not self.closed:
            candidates = np.clip(candidates, 0.0, self.length)
        away = self.position(candidates) - xy
        s = float(candidates[np.argmin(np.sum(away**2, axis=-1))])
        for _ in range(NEWTON_STEPS):
            at = np.array(s)
            away, along = xy - self.position(at), self.tangent(at)
            left = float(along[0] * away[1] - along[1] * away[0])
            s += float(away @ along) / max(MIN_SHRINKING, 1.0 - float(self.curvature(at)) * left)
            s = s if self.closed else min(max(s, 0.0), self.length)
        return s

    def offset(self, point: Sequence[float] | Array, near: float | None = None) -> tuple[float, float]:
        """Return arc length and distance to the left of the path, of a point, both in m; arguments as of `project`."""
        s = self.project(point, near)
        (x, y), (along_x, along_y) = self.position(np.array(s)), self.tangent(np.array(s))
        return s, float(along_x * (point[1] - y) - along_y * (point[0] - x))

    def limited(self, limits: SpeedLimits, *, inside: bool = False) -> Path:
        """
        Return this path with the fastest speed profile inside limits.

        Args:
            limits: Limits.
            inside: Whether it is also to stay below the present one, such as the one of a race line.
        """
        s: Array = np.float64(self.step_m) * np.arange(len(self.control))
        speed = speed_profile(self.curvature(s), self.step_m, limits, closed=self.closed, most=self.speed if inside else None)
        return replace(self, speed=speed)

    def window(self, first: int, knots: int) -> Array:
        """
        Return knots from one on, as stage parameters of a model that follows a path.

        Args:
            first: Index of the first of them, of any sign.
            knots: How many.

        Returns:
            Rows of x and y of the control point, right and left width and speed, shape ``(knots, 5)``. Beyond the end of an open path the speed is 0.
        """
        k = first + np.arange(knots)
        speed = self.speed[self._index(k)]
        if not self.closed:
            speed = np.where(k >= len(self.control) - 1, 0.0, speed)
        return np.column_stack([self._control(k), self.right[self._index(k)], self.left[self._index(k)], speed])

    def _index(self, k: np.ndarray) -> np.ndarray:
        """Return the place of knots that may lie beyond the ends."""
        n = len(self.control)
        return np.asarray(np.mod(k, n) if self.closed else np.clip(k, 0, n - 1))

    def _control(self, k: np.ndarray) -> Array:
        """Return control points by index, beyond the ends of an open path on a straight line."""
        point = self.control[self._index(k)]
        if self.closed:
            return np.asarray(point)
        before, beyond = np.minimum(k, 0)[..., None], np.maximum(k - len(self.control) + 1, 0)[..., None]
        return np.asarray(point + before * (self.control[1] - self.control[0]) + beyond * (self.control[-1] - self.control[-2]))

    def _spline(self, s: Array, order: int) -> Array:
        """Evaluate the spline, or a derivative by arc length."""
        at = np.asarray(s, dtype=np.float64) / self.step_m
        k = np.floor(at).astype(int)
        t = (at - k)[..., None]
        weights = {
            0: ((1 - t) ** 3 / 6, (3 * t**3 - 6 * t**2 + 4) / 6, (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6, t**3 / 6),
            1: (-((1 - t) ** 2) / 2, (3 * t**2 - 4 * t) / 2, (-3 * t**2 + 2 * t + 1) / 2, t**2 / 2),
            2: (1 - t, 3 * t - 2, 1 - 3 * t, t),
        }[order]
        total = sum((weight * self._control(k + i) for i, weight in enumerate(weights, -1)), start=np.zeros(2))
        return np.asarray(total / self.step_m**order)


def smooth_path(
    points: Array,
    *,
    right: Array | float = 1.0,
    left: Array | float = 1.0,
    speed: Array | float = 1.0,
    step_m: float | None = None,
    smooth_m: float | None = None,
) -> Path:
    """
    Lay a smooth path through points.

    Args:
        points: Shape ``(n, 2)``, in m; of a closed path the first is also the last. A recorded path is averaged first, see
            `rti_mpc.reference.smoothing`.
        right: Width to the right at the points, shape ``(n,)``, or a constant, in m; likewise `left`.
        left: Width to the left.
        speed: Speed at the points, shape ``(n,)``, or a constant, in m/s: `Path.limited` makes a profile inside limits.
        step_m: Arc length from knot to knot, near which an equal division lies; half of the smallest radius by default.
        smooth_m: Arc length to average over, as in `rti_mpc.reference.trajectory.waypoints`.

    Raises:
        ConfigError: There are fewer than two distinct points, or a number is out of range.
        OcpError: What must be numbers is none.
    """
    from scipy.interpolate import CubicSpline  # which takes half a second to load, that of a program without a path, too

    given_points = distinct(points)
    along = smoothed(given_points, smooth_m).points
    closed = len(along) > 3 and bool(np.all(along[0] == along[-1]))
    chord = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(along, axis=0).T))])
    ends: Literal["periodic", "natural"] = "periodic" if closed else "natural"
    curve = CubicSpline(chord, along, bc_type=ends)
    dense = curve(np.linspace(0.0, chord[-1], DENSE * len(along) + 1))
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(dense, axis=0).T))])
    by_length = CubicSpline(s, dense, bc_type=ends)
    if step_m is None:
        step_m = STEP_RADII / max(1e-9, float(np.max(np.hypot(*by_length(s, 2).T))))
    elif not (math.isfinite(given.number("step_m", step_m)) and step_m > 0.0):
        raise ConfigError(f"step_m must be finite and above 0, got {step_m}")
    steps = min(MAX_STEPS, max(MIN_STEPS, round(s[-1] / step_m)))
    step = float(s[-1] / steps)
    s_knots: Array = np.float64(step) * np.arange(steps + (not closed))
    chord = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(given_points, axis=0).T))])
    s_given = np.asarray(chord * (s[-1] / chord[-1]))

    def knots(name: str, value: Array | float) -> Array:
        return at_knots(name, value, s_given, s_knots, closed=closed)

    nodes = np.asarray(by_length(s_knots), dtype=np.float64)
    return Path(step, control_points(nodes, closed=closed), knots("right", right), knots("left", left), knots("speed", speed), closed)


def at_knots(name: str, value: Array | float, s_given: Array, s: Array, *, closed: bool) -> Array:
    """Return what is given at points, whose arc lengths these are, or as a constant, at the arc lengths of knots."""
    array = given.numbers(name, value)
    if array.shape not in ((), s_given.shape) or not np.isfinite(array).all() or (array < 0.0).any():
        told = f"one number or one for each of {len(s_given)} distinct points"
        raise ConfigError(f"{name} must be at least 0, {told}, got {given.quoted(value)}")
    if array.shape == ():
        return np.full(len(s), float(array))
    if closed:
        s_given, array = s_given[:-1], array[:-1]
    return np.asarray(np.interp(s, s_given, array, period=s[-1] + s[1] if closed else None))


def control_points(nodes: Array, *, closed: bool) -> Array:
    """Return the control points of the cubic B-spline that passes through its knots there, shape ``(n, 2)``; straight at the ends of an open one."""
    from scipy.linalg import solve_banded, solve_circulant

    n = len(nodes)
    if closed:
        column = np.zeros(n)
        column[[0, 1, -1]] = 4 / 6, 1 / 6, 1 / 6
        return np.asarray(solve_circulant(column, nodes))
    bands = np.full((3, n), 1 / 6)
    bands[1] = 4 / 6
    bands[1, [0, -1]] = 1.0
    bands[0, 1] = bands[2, -2] = 0.0
    return np.asarray(solve_banded((1, 1), bands, nodes))


def pieces(points: Array, **values: Array | float | None) -> tuple[Path, ...]:
    """
    Lay a path through points, split where it turns back: at each cusp one piece ends at rest, and the next begins there in the other direction.

    Arguments are those of `smooth_path`.

    Raises:
        ConfigError: As `smooth_path`.
    """
    points = given.numbers("points", points)
    distinct(points)
    keep = np.concatenate([[True], np.any(np.diff(points, axis=0) != 0.0, axis=1)])
    columns: Mapping[str, Array | float | None] = {
        name: value[keep] if isinstance(value, np.ndarray) and value.shape == keep.shape else value for name, value in values.items()
    }
    points = points[keep]
    theta = np.arctan2(*np.diff(points, axis=0).T[::-1])
    turn = np.abs(np.remainder(np.diff(theta) + np.pi, 2 * np.pi) - np.pi)
    cuts = [0, *(1 + np.flatnonzero(turn > CUSP_RAD)).tolist(), len(points) - 1]
    parts = [slice(first, last + 1) for first, last in pairwise(cuts)]

    def of(part: slice, value: Array | float | None) -> Array | float | None:
        return value[part] if isinstance(value, np.ndarray) and value.shape == (len(points),) else value

    return tuple(smooth_path(points[part], **{name: of(part, value) for name, value in columns.items()}) for part in parts)  # type: ignore[arg-type]


def read_path(
    file: File | str, *, width_m: float = 1.0, speed_m_s: float = 1.0, closed: bool | None = None, smooth_m: float | None = None
) -> tuple[Path, ...]:
    """
    Read a path from a CSV file: a centre line with widths, as in the TUM's race track database, a race line with speeds, or waypoints.

    Args:
        file: With the columns x and y in m, and perhaps w_right and w_left in m, and speed in m/s; see `rti_mpc.reference.waypoint_file`.
        width_m: To either side, where the file names no widths, in m.
        speed_m_s: Where it names no speeds, in m/s.
        closed: Whether the last point leads to the first; None: if it lies as near to it as points are apart.
        smooth_m: Arc length to average over, in m.

    Returns:
        Its pieces, more than one if it turns back.

    Raises:
        ConfigError: The file cannot be read, or is no path: file, line and column are named.
    """
    if not isinstance(file, str | File):
        raise ConfigError(f"file must be the path of a CSV file, got {given.quoted(file)}")
    table = read_track(File(file))
    points = np.column_stack([table["x"], table["y"]])
    values = [table.get(name, np.full(len(points), constant)) for name, constant in (("right", width_m), ("left", width_m), ("speed", speed_m_s))]
    try:
        distinct(points)
        gaps = np.hypot(*np.diff(points, axis=0).T)
        gap = math.hypot(*(points[0] - points[-1]))
        if (len(points) > 3 and gap <= GAP_STEPS * float(np.median(gaps)) if closed is None else closed) and gap > 0.0:
            points, values = np.vstack([points, points[:1]]), [np.append(value, value[0]) for value in values]
        right, left, speed = values
        return pieces(points, right=right, left=left, speed=speed, smooth_m=smooth_m)
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from error
