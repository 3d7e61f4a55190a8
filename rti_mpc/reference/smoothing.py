# SPDX-License-Identifier: Apache-2.0
r"""
Smoothing of recorded paths, whose direction from point to point is mostly noise.

Points a few cm apart that are off by a cm turn the direction by tens of degrees, to
and fro, and a heading along them cannot be followed. Such a path is averaged over a
window of arc length, its ends in place: two means of half the window each differ in
direction by :math:`4 \sigma / (w \sqrt{w / d})`, with points `d` apart that are off by :math:`\sigma`, and the
window is so long that this is small. A path that was laid out by hand has its corners
further apart, and is left as it is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.errors import ConfigError

SAMPLES = 8  # of the averaged path in one window
SHORT_EDGE_M = 0.25  # an edge up to this long between two turns to and fro is noise rather than laid out
NOISY_RAD = math.radians(10.0)  # turns to and fro from which on an edge is noise
RECORDED_SHARE = 0.1  # of all edges that are noise, from which on a path counts as recorded
DIRECTION_NOISE_RAD = math.radians(1.5)  # standard deviation that averaging leaves of the direction
WINDOW_STEP_M, MAX_WINDOW_M = 0.1, 2.0  # a window is a multiple of the one, and at most the other
MEDIAN_BEND = 2.884  # median length of p[i - 1] - 2 p[i] + p[i + 1] for points that are off by a standard deviation of 1 in x and in y


class Smoothed(NamedTuple):
    """
    A path as it is followed.

    Attributes:
        points: Shape ``(n, 2)``, in m.
        window_m: Arc length it was averaged over; 0: it is as it was given.
        turn_rad: Largest turn to and fro, from point to point, before that.
        moved_m: Largest distance by which averaging has moved it.
    """

    points: Array
    window_m: float
    turn_rad: float
    moved_m: float


def smoothed(points: Array, window_m: float | None = None) -> Smoothed:
    """
    Average a path if it is a recorded one.

    Args:
        points: Distinct neighbours, shape ``(n, 2)``, in m, the first equal to the last if it is closed.
        window_m: Arc length to average over, in m; 0: none. None: what its noise needs, none for a path that was laid out.

    Raises:
        ConfigError: The window is negative.
    """
    if window_m is not None and not (math.isfinite(given.number("smooth_m", window_m)) and window_m >= 0.0):
        raise ConfigError(f"smooth_m must be a distance of at least 0 m, got {window_m}")
    noise_rad = jitter(points)
    recorded = np.count_nonzero(noise_rad > NOISY_RAD) >= max(2.0, RECORDED_SHARE * len(points))
    window = (needed(points) if recorded else 0.0) if window_m is None else window_m
    averaged, moved = average(points, window) if window else (points, 0.0)
    return Smoothed(averaged, window, float(noise_rad.max(initial=0.0)), moved)


def needed(points: Array) -> float:
    """Return the window, in m, that the noise of recorded points needs."""
    bends = np.hypot(*np.diff(points, n=2, axis=0).T)
    apart = float(np.hypot(*np.diff(points, axis=0).T).mean())
    window = math.cbrt(4.0 * float(np.median(bends)) / MEDIAN_BEND * math.sqrt(apart) / DIRECTION_NOISE_RAD) ** 2
    return min(MAX_WINDOW_M, round(WINDOW_STEP_M * math.ceil(window / WINDOW_STEP_M), 3))


def jitter(points: Array) -> Array:
    """Return by how much the direction turns to and fro at the ends of each short edge, in rad: the smaller of two turns, 0 if they are alike."""
    edge = np.diff(points, axis=0)
    turn = np.diff(np.unwrap(np.arctan2(edge[:, 1], edge[:, 0])))
    back = np.where(turn[:-1] * turn[1:] < 0.0, np.minimum(np.abs(turn[:-1]), np.abs(turn[1:])), 0.0)
    return np.asarray(np.where(np.hypot(*edge[1:-1].T) <= SHORT_EDGE_M, back, 0.0))


def average(points: Array, window_m: float) -> tuple[Array, float]:
    """Return a path averaged over a window, twice over half of it, so that directions are averages, too; and the largest distance it was moved by."""
    step = window_m / SAMPLES
    points = resampled(gathered(points, step), step)
    closed = bool(np.all(points[0] == points[-1]))
    half = SAMPLES // 2
    kernel = np.convolve(np.ones(half + 1), np.ones(half + 1))
    reach = len(kernel) // 2
    if len(points) <= reach + 1:
        return points, 0.0
    if closed:
        before, after = points[-reach - 1 : -1], points[1 : reach + 1]
    else:  # turned about its ends, which stay in place
        before, after = 2.0 * points[0] - points[reach:0:-1], 2.0 * points[-1] - points[-2 : -reach - 2 : -1]
    padded = np.vstack([before, points, after])
    averaged = np.column_stack([np.convolve(column, kernel / kernel.sum(), mode="valid") for column in padded.T])
    if closed:
        averaged[-1] = averaged[0]
    return averaged, float(np.hypot(*(averaged - points).T).max())


def gathered(points: Array, step_m: float) -> Array:
    """Return the means of neighbours that lie within a step of the first of them, as where a robot stood while it was recorded; the ends stay."""
    groups = [[points[0]]]
    for point in points[1:]:
        first = groups[-1][0]
        if math.hypot(point[0] - first[0], point[1] - first[1]) >= step_m:
            groups.append([point])
        else:
            groups[-1].append(point)
    return np.array([points[0], *(np.mean(group, axis=0) for group in groups[1:-1]), points[-1]])


def resampled(points: Array, step_m: float) -> Array:
    """Return a polyline's points at equal steps of arc length, near the one that is asked for."""
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0.0, s[-1], max(2, 1 + round(s[-1] / step_m)))
    return np.column_stack([np.interp(at, s, column) for column in points.T])
