# SPDX-License-Identifier: Apache-2.0
r"""
Rotations among the components of a vector, of which several numbers are the same one.

An angle is the same by whole turns. An attitude as a unit quaternion q = (w, x, y, z) is
the same by its sign: q and -q. Whoever compares, interpolates or feeds back such a vector
first writes it as near to the other as it can be written.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np

from rti_mpc.array import Array

TURNS = {"rad": math.tau, "deg": 360.0}  # a whole turn in the units that an angle may have
MAX_TURNS = 1e8  # the direction of a larger angle is lost in rounding
LENGTHS = 0.9, 1.1  # of a measured quaternion: one that was never written is 0, and noise of a sensor is far less

Quaternion = tuple[int, int, int, int]  # places of w, x, y, z


class Component(Protocol):
    """What says of one component whether it is an angle."""

    @property
    def name(self) -> str:
        """Its name, unique within the vector."""

    @property
    def unit(self) -> str:
        """Its unit."""

    @property
    def angle(self) -> bool:
        """Whether it is an angle."""


@dataclass(frozen=True)
class Rotations:
    """
    Rotations among the components of a vector.

    Attributes:
        size: Number of components; 0 if they are not known.
        angles: Places of the angles.
        quaternions: Places of w, x, y and z of each attitude.
        turns: A whole turn of each of the angles in its unit; in rad if left out.
    """

    size: int = 0
    angles: tuple[int, ...] = ()
    quaternions: tuple[Quaternion, ...] = ()
    turns: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Fill in the turns that were left out."""
        if not self.turns:
            object.__setattr__(self, "turns", (math.tau,) * len(self.angles))

    @classmethod
    def of(cls, components: Sequence[Component], quaternions: Iterable[Sequence[str]] = ()) -> Self:
        """Find them among components; of the quaternions, names of w, x, y and z each, those count of which all names are there."""
        places = {component.name: i for i, component in enumerate(components)}
        whole = [tuple(places[name] for name in names) for names in quaternions if all(name in places for name in names)]
        angles = {i: TURNS.get(component.unit, math.tau) for i, component in enumerate(components) if component.angle}
        return cls(len(components), tuple(angles), tuple(whole), tuple(angles.values()))  # type: ignore[arg-type]

    def bring_near(self, x: Any, to: Any) -> None:
        """Write the rotations of a vector as near to those of another one as they can be written; both of `size` floats, arrays or views of them."""
        for j, turn in zip(self.angles, self.turns, strict=True):
            if not abs(apart := float(x[j] - to[j])) <= turn / 2:  # mostly it is: the call is left out then
                x[j] -= whole_turns(apart, turn)
        for places in self.quaternions:
            if sum(x[j] * to[j] for j in places) < 0.0:
                for j in places:
                    x[j] = -x[j]

    def normalize(self, x: Any) -> None:
        """Give the quaternions of a vector length 1, unless they are 0."""
        for places in self.quaternions:
            length = math.sqrt(sum(x[j] * x[j] for j in places))
            if length > 0.0:
                for j in places:
                    x[j] /= length

    def turn_up(self, x: Any) -> None:
        """Write the quaternions of a vector with w >= 0."""
        for places in self.quaternions:
            if x[places[0]] < 0.0:
                for j in places:
                    x[j] = -x[j]

    def completed(self, x: Array) -> Array:
        """Return a vector whose quaternions have length 1 by a w of the same sign; x, y and z that are too long for that are shortened."""
        whole = np.array(x)
        for w, *vector in self.quaternions:
            length = float(np.linalg.norm(whole[vector]))
            whole[vector] /= max(1.0, length)
            whole[w] = math.copysign(math.sqrt(max(0.0, 1.0 - length**2)), whole[w])
        return whole

    def wrap(self, x: Array) -> None:
        """Write the rotations of a vector, shape ``(size,)``, as sensors do: angles up to half a turn, quaternions of length 1 with w >= 0."""
        angles, turns = list(self.angles), np.array(self.turns)
        x[angles] = turns / 2 - np.remainder(turns / 2 - x[angles], turns)
        self.normalize(x)
        self.turn_up(x)

    def near(self, a: Array, b: Array) -> Array:
        """Return a vector written as near to another one as it can be, both of shape ``(..., size)``."""
        written = np.array(a)
        for j, turn in zip(self.angles, self.turns, strict=True):
            written[..., j] -= turn * np.round((a[..., j] - b[..., j]) / turn)
        for places in map(list, self.quaternions):
            opposite = (a[..., places] * b[..., places]).sum(axis=-1, keepdims=True) < 0.0
            written[..., places] *= np.where(opposite, -1.0, 1.0)
        return written

    def difference(self, a: Array, b: Array) -> Array:
        """Return a - b, both of shape ``(..., size)``, with a written near to b: angles within half a turn."""
        return np.asarray(self.near(a, b) - b)

    def unwrap(self, rows: Array) -> None:
        """Write each row near to the one before, shape ``(n, size)`` or with further columns: no angle jumps, no quaternion changes its sign."""
        for j, turn in zip(self.angles, self.turns, strict=True):
            rows[:, j] = np.unwrap(rows[:, j], period=turn)
        for places in map(list, self.quaternions):
            q = rows[:, places]
            signs = np.where((q[1:] * q[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
            rows[1:, places] *= np.cumprod(signs)[:, None]

    def misfit(self, x: Array) -> str:
        """Return what is wrong with the quaternions of a measured vector, shape ``(size,)``, and what would be right; empty if nothing is."""
        for places in self.quaternions:
            length = math.sqrt(sum(float(x[j]) ** 2 for j in places))
            if not LENGTHS[0] <= length <= LENGTHS[1]:
                return f"a quaternion must have length 1, got {x[list(places)].tolist()}"
        return ""


def whole_turns(angle: float, turn: float = math.tau) -> float:
    """Return the multiple of a turn nearest to an angle, in its unit; 0 if the angle is not finite or beyond `MAX_TURNS`."""
    return turn * round(angle / turn) if abs(angle) < MAX_TURNS * turn else 0.0
