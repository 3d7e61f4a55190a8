# SPDX-License-Identifier: Apache-2.0
"""
Signals, the named components of a model's vectors, and their roles.

A role gives a signal its meaning outside the optimal control problem: a path fills
outputs by their roles, obstacles keep away from the position, viewers draw it. Names are
for people: nothing is inferred from names, units or the order of signals.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any, Literal, Protocol

from rti_mpc import given
from rti_mpc.errors import OcpError
from rti_mpc.rotation import TURNS
from rti_mpc.si import misspelt

Role = Literal["", "x", "y", "heading", "axle_offset", "disc_x", "disc_y", "disc_radius", "progress", "path_start", "path_x"]

POSE_ROLES: tuple[Role, ...] = ("x", "y", "heading")  # roles that a path in the plane gives values for
DISC_ROLES: tuple[Role, ...] = ("disc_x", "disc_y", "disc_radius")
PATH_ROLES: tuple[Role, ...] = ("path_start", "path_x")  # of the path that a robot follows: where its knots begin, and each knot
UNIT_OF_ROLE: dict[Role, str] = {"heading": "rad"}  # m for the others
ROLES_OF_VECTOR: dict[str, tuple[Role, ...]] = {
    "states": (*POSE_ROLES, "progress"),
    "outputs": POSE_ROLES,
    "inputs": (),
    "parameters": ("axle_offset", *DISC_ROLES, *PATH_ROLES),
    "constraints": (),
}  # roles that the signals of each vector may have
KNOTS_BEHIND = 3  # knots of a followed path's window behind a robot: one for the spline, two for robots that move back
REPEATABLE_ROLES: tuple[Role, ...] = ("", *DISC_ROLES, "path_x")  # roles that several signals of one vector may have


@dataclass(frozen=True)
class Signal:
    r"""
    One component of a state, input, output or parameter vector.

    Attributes:
        name: Unique within its vector; what configuration and viewers call it.
        unit: SI unit, or another one that `rti_mpc.si` knows, ``"1"`` if none. Any other text counts as it is.
        angle: Whether it is an angle whose whole turns do not matter: it may wrap at half a turn, and the dynamics repeat with each turn. Its unit,
            rad or deg, says how large a turn is.
        role: Of states and outputs ``"x"``, ``"y"`` (position in the plane, m) and ``"heading"`` (an angle, from the x axis to the left); of a
            parameter ``"axle_offset"``: distance in m from the axle ahead to the point whose position this is. Those of discs and of a followed
            path are set by `rti_mpc.model.obstacle` and `rti_mpc.model.path_following`. Empty: none of these.
        commands: Of an input, the name of the state that follows it, a speed; empty: none.

    Raises:
        OcpError: A field is of the wrong type, the name is empty, the unit is a known one in another spelling, or an angle is in neither rad nor deg.
    """

    name: str
    unit: str
    angle: bool = False
    role: Role = ""
    commands: str = ""

    def __post_init__(self) -> None:
        """Check the types, which nothing behind this checks again."""
        for field, right in (("name", str), ("unit", str), ("angle", bool), ("role", str), ("commands", str)):
            if not isinstance(value := getattr(self, field), right):
                words = "text" if right is str else "true or false"
                raise OcpError(f"{field} of the signal {given.quoted(self.name)} must be {words}, got {given.quoted(value)}")
        if not self.name.strip():
            raise OcpError(f"name of a signal must not be empty, got {self.name!r}")
        if not (self.name + self.unit).isprintable():
            raise OcpError(f"name and unit of a signal must be printable, in one line, got {self.name!r} in {self.unit!r}")
        if self.angle and self.unit not in TURNS:
            raise OcpError(f"unit of the signal {self.name!r} must be {' or '.join(TURNS)} for angle=True, to know a whole turn, got {self.unit!r}")
        if wrong := misspelt(self.unit):
            instead = ", ".join(f"{right} instead of {symbol}" for symbol, right in wrong.items())
            raise OcpError(f"unit of the signal {self.name!r} must have {instead}, got {self.unit!r}")


def as_label(text: str) -> str:
    """Return a name or a unit as Matplotlib draws it in a figure: a dollar sign begins no formula."""
    return text.replace("$", r"\$")


def quantity(value: float, unit: str, form: str = ".3g") -> str:
    """Return a number with its unit as text, alone if the unit is 1."""
    return f"{value:{form}}" + ("" if unit == "1" else f" {unit}")


def signals(vector: str, given_as: Any, alike: Sequence[Signal | None] = ()) -> tuple[Signal, ...]:
    """
    Return signals from these, or from their names alone; from one of them for a vector of one.

    Args:
        vector: Name of the vector.
        given_as: Signals or names.
        alike: Signals that those given by name alone are like in all else, in their order; without unit and meaning where there is none.

    Raises:
        OcpError: One is neither.
    """
    entries = (given_as,) if isinstance(given_as, str | Signal) else given_as
    if not isinstance(entries, Iterable):
        raise OcpError(f"{vector} must be signals or their names, got {given.quoted(entries)}")
    found: list[Signal] = []
    for entry, like in zip_longest(entries := tuple(entries), alike[: len(entries)]):
        if not isinstance(entry, str | Signal):
            raise OcpError(f"{vector} must be signals or their names, got {given.quoted(entry)} among them")
        found.append(entry if isinstance(entry, Signal) else Signal(entry, "1") if like is None else replace(like, name=entry))
    return tuple(found)


class HasRole(Protocol):
    """A signal, or its label on the bus."""

    @property
    def role(self) -> str:
        """Its role; empty if it has none."""


def place(signals: Sequence[HasRole], role: Role) -> int | None:
    """Return the index of the signal of a role; None if there is none."""
    return next((i for i, signal in enumerate(signals) if signal.role == role), None)


def path_place(parameters: Sequence[HasRole]) -> tuple[int, int] | None:
    """Return where a followed path begins among stage parameters, and how many knots it has; None if there is none."""
    first = place(parameters, "path_start")
    return None if first is None else (first, sum(signal.role == "path_x" for signal in parameters))


def plane(signals: Sequence[HasRole]) -> tuple[int, int] | None:
    """Return the indices of x and y; None if not both are there."""
    x, y = place(signals, "x"), place(signals, "y")
    return None if x is None or y is None else (x, y)


def in_plane(outputs: Sequence[HasRole]) -> bool:
    """Whether outputs are a position in the plane, perhaps with a heading, and nothing else: what a path tells."""
    return plane(outputs) is not None and all(output.role in POSE_ROLES for output in outputs)


def misplaced(vector: str, signals: Sequence[Signal], states: Sequence[Signal]) -> str:
    """Return what is wrong with the roles in a vector, empty if nothing is."""
    roles = [signal.role for signal in signals if signal.role not in REPEATABLE_ROLES]
    for signal in signals:
        if signal.role and signal.role not in ROLES_OF_VECTOR[vector]:
            return f"the role of {vector} must be {' or '.join(ROLES_OF_VECTOR[vector]) or 'left out'}, got {signal.role} for {signal.name}"
        if signal.role and signal.unit != UNIT_OF_ROLE.get(signal.role, "m"):
            return f"the role {signal.role} must be in {UNIT_OF_ROLE.get(signal.role, 'm')}, got {signal.name} in {signal.unit}"
        if signal.role == "heading" and not signal.angle:
            return f"the role heading must be an angle, got {signal.name} without angle=True"
        if roles.count(signal.role) > 1:
            return f"the role {signal.role} must be one signal's of {vector}, got {[s.name for s in signals if s.role == signal.role]}"
        if signal.commands and (vector != "inputs" or signal.commands not in [state.name for state in states]):
            return f"commands must be an input's, and name a state, got {signal.commands} for {signal.name} of {vector}"
    return ""
