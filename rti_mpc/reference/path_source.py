# SPDX-License-Identifier: Apache-2.0
"""
Window of a path around a robot, as stage parameters of a model that follows a path.

Arc length counts on across laps and pieces, as the robot's progress does. A piece that
ends is followed until the robot has come to rest at its end; then the next one begins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.errors import ConfigError, OcpError
from rti_mpc.reference.path import Path
from rti_mpc.signals import KNOTS_BEHIND

ARRIVED_M = 0.05  # from the end of a piece at which it counts as driven
RESTING_M_S = 0.1  # pace below which a robot rests there


class PathSource:
    """
    A path, and how far a robot is along it.

    Attributes:
        pieces: Pieces of the path, in order.
        piece: Index of the piece that is followed.
        passed_m: Arc length of the pieces before it, in m.

    Args:
        pieces: Pieces, each beginning where the one before ends; a closed one is followed for ever.
        p_nominal: Nominal parameters of the model, shape ``(np,)``.
        first: Index of the path's first parameter among these.
        knots: Knots of the model's window.

    Raises:
        ConfigError: There is no piece, or a closed one before the last.
        OcpError: The parameters have no room for the window.
    """

    def __init__(self, pieces: Sequence[Path], p_nominal: Sequence[float] | Array, first: int, knots: int) -> None:
        self.pieces = tuple(pieces)
        if not self.pieces or any(piece.closed for piece in self.pieces[:-1]):
            raise ConfigError(f"a path must have at least one piece, and only the last may be closed, got {len(self.pieces)}")
        self._p = given.numbers("p_nominal", p_nominal).copy()
        self._window = slice(first + 2, first + 2 + self.pieces[0].window(0, knots).size)
        if self._window.stop > len(self._p):
            raise OcpError(f"p_nominal must have {self._window.stop} entries for a path of {knots} knots from {first} on, got {len(self._p)}")
        self._first, self._knots = first, knots
        self.piece, self.passed_m = 0, 0.0

    @property
    def path(self) -> Path:
        """The piece that is followed."""
        return self.pieces[self.piece]

    @property
    def ended(self) -> bool:
        """Whether nothing follows after the end of the present piece."""
        return self.piece == len(self.pieces) - 1 and not self.path.closed

    def begin(self, point: Sequence[float] | Array, progress_m: float) -> None:
        """
        Begin the path where it is nearest to a robot.

        Args:
            point: x and y of the robot, in m.
            progress_m: Its progress there, in m, whatever it counted before.
        """
        self.piece, self.passed_m = 0, 0.0
        self.passed_m = progress_m - self.path.project(point)

    def arrived(self, progress_m: float, pace_m_s: float) -> bool:
        """Whether a robot rests at the end of the present piece."""
        return not self.path.closed and abs(progress_m - self.passed_m - self.path.length) < ARRIVED_M and abs(pace_m_s) < RESTING_M_S

    def parameters(self, progress_m: float, pace_m_s: float = math.inf) -> Array:
        """
        Return the stage parameters around a robot, and begin the next piece where it rests at the end of one.

        Args:
            progress_m: Its progress, in m.
            pace_m_s: Its pace, in m/s; no next piece begins without it.

        Returns:
            Parameters, shape ``(np,)``, the same for all stages of a horizon. Overwritten by the next call.
        """
        if self.arrived(progress_m, pace_m_s) and not self.ended:
            self.passed_m += self.path.length
            self.piece += 1
        path = self.path
        first = math.floor((progress_m - self.passed_m) / path.step_m) - KNOTS_BEHIND
        self._p[self._first] = self.passed_m + first * path.step_m
        self._p[self._first + 1] = path.step_m
        self._p[self._window] = path.window(first, self._knots).ravel()
        return self._p

    def offset(self, point: Sequence[float] | Array, progress_m: float) -> tuple[float, float, float]:
        """
        Return where a point is on the track.

        Args:
            point: x and y, in m.
            progress_m: About where along the path it is, in m.

        Returns:
            Arc length at its projection, distances to the right and to the left edge, negative beyond it; all in m.
        """
        s, left = self.path.offset(point, progress_m - self.passed_m)
        at = np.array(s)
        right_edge, left_edge = float(self.path.at(self.path.right, at)), float(self.path.at(self.path.left, at))
        return self.passed_m + s, right_edge + left, left_edge - left
