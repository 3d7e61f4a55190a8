# SPDX-License-Identifier: Apache-2.0
"""A drive along a path, from the true states of a robot that follows it: where it was on the track, and how long its laps took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.reference.path import Path
from rti_mpc_service.path_reference import path_source

if TYPE_CHECKING:
    from rti_mpc.model.model import Model

POINTS_PER_KNOT = 4  # of an edge that is drawn


@dataclass(frozen=True, eq=False)
class AlongPath:
    """
    A robot along its path, with one row per state.

    Attributes:
        pieces: Pieces of the path.
        p: Stage parameters, which hold the path around the robot, shape ``(M, np)``.
        time_s: Times of the states, shape ``(M,)``.
        driven: Progress since the first state, shape ``(M,)``, in m.
        position: Of the robot, shape ``(M, 2)``, in m.
        point: Of the path at its progress, shape ``(M, 2)``, in m.
        right: Distance from the robot to the right edge, shape ``(M,)``, in m; negative beyond it.
        left: Distance to the left edge.
    """

    pieces: tuple[Path, ...]
    p: Array
    time_s: Array
    driven: Array
    position: Array
    point: Array
    right: Array
    left: Array

    @staticmethod
    def of(model: Model, pieces: Sequence[Path], time_s: Array, x: Array) -> AlongPath:
        """
        Judge a drive by the path itself, of which the source sends parts, begun where it is nearest to the first state.

        Args:
            model: Model of the robot, which follows a path.
            pieces: Pieces of the path.
            time_s: Times of the states, shape ``(M,)``.
            x: States, shape ``(M, nx)``, at least one.
        """
        source, columns, progress = path_source(model, pieces)
        position = x[:, columns]
        source.begin(position[0], float(x[0, progress]))
        p, point, edges = [], [], []
        for row, at in zip(x, position, strict=True):
            p.append(source.parameters(float(row[progress]), float(row[progress + 1])).copy())
            path, s = source.path, np.array(row[progress] - source.passed_m)
            on, (along_x, along_y) = path.position(s), path.tangent(s)
            beside = float(along_x * (at[1] - on[1]) - along_y * (at[0] - on[0]))  # to the left
            point.append(on)
            edges.append((float(path.at(path.right, s)) + beside, float(path.at(path.left, s)) - beside))
        right, left = np.array(edges).T
        return AlongPath(tuple(pieces), np.array(p), time_s, x[:, progress] - x[0, progress], position, np.array(point), right, left)

    @property
    def laps_s(self) -> list[float]:
        """Times of the whole laps, from where it began; empty if the path is not closed."""
        path = self.pieces[-1]
        if not path.closed:
            return []
        ends = path.length * np.arange(1 + int(self.driven[-1] // path.length))
        return [float(lap) for lap in np.diff(np.interp(ends, np.maximum.accumulate(self.driven), self.time_s))]

    @property
    def edges(self) -> list[Array]:
        """Right and left edge of each piece as polylines, each of shape ``(K, 2)``, in m."""
        lines = []
        for path in self.pieces:
            s = np.linspace(0.0, path.length, POINTS_PER_KNOT * len(path.control))
            centre, normal = path.position(s), path.tangent(s)[:, ::-1] * [-1.0, 1.0]
            lines += [centre - path.at(path.right, s)[:, None] * normal, centre + path.at(path.left, s)[:, None] * normal]
        return lines

    def summary(self) -> dict[str, Any]:
        """Return the drive in numbers, in JSON."""
        return {
            "length_m": sum(path.length for path in self.pieces),
            "driven_m": float(self.driven[-1]),
            "laps_s": self.laps_s,
            "profile_s": sum(path.time_s for path in self.pieces),
            "closest_to_edge_mm": 1e3 * float(min(self.right.min(), self.left.min())),
        }
