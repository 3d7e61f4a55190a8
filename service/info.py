# SPDX-License-Identifier: Apache-2.0
"""What ``info/<role>`` says: names, units and limits, which viewers and figures take their labels from."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rti_mpc.errors import MessageError
from rti_mpc.wire.document import read
from rti_mpc.wire.layout import NUMBER_LIMIT
from rti_mpc.wire.streams import role_of

MAX_TEXT = 64  # characters of a name or a unit
MAX_COMPONENTS = 512  # components of a vector, obstacles, or columns of a reference


@dataclass(frozen=True)
class Label:
    """
    Name and unit of one component of a vector.

    Attributes:
        name: Unique within its vector.
        unit: SI unit, ``"1"`` if none.
        angle: Whether it wraps at ``+-pi``.
    """

    name: str
    unit: str = "1"
    angle: bool = False

    def __str__(self) -> str:
        return self.name if self.unit == "1" else f"{self.name} [{self.unit}]"


@dataclass(frozen=True)
class Obstacle:
    """
    A disc that the robot keeps out of.

    Attributes:
        at: Column of a reference's `p` that is its x; y and r follow.
        x: Where it is, in m, unless a reference says where else; y likewise.
        r: Its radius, in m.
    """

    at: int
    x: float
    y: float
    r: float


@dataclass(frozen=True)
class Info:
    """
    Description of a process on the bus; a controller's names every vector. Equal if it labels alike.

    Attributes:
        role: Who published it: controller, robot, ...
        document: All of it, as indented JSON.
        model: Name of the model.
        states: Labels of ``x``; empty where the publisher does not know the model.
        inputs: Labels of ``u``.
        outputs: Labels of ``y``.
        disturbances: Labels of what an observer estimates besides.
        obstacles: What it keeps out of.
        dt_s: Sample period; NaN if not said.
        lbu: Lower bounds of the inputs, infinite where there is none.
        ubu: Upper bounds of the inputs.
        lbx: Lower bounds of the states.
        ubx: Upper bounds of the states.
    """

    role: str = field(compare=False)
    document: str = field(default="{}", compare=False)
    model: str = ""
    states: tuple[Label, ...] = ()
    inputs: tuple[Label, ...] = ()
    outputs: tuple[Label, ...] = ()
    disturbances: tuple[Label, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    dt_s: float = math.nan
    lbu: tuple[float, ...] = ()
    ubu: tuple[float, ...] = ()
    lbx: tuple[float, ...] = ()
    ubx: tuple[float, ...] = ()

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Info:
        """
        Read a description as published, infinities as null.

        Raises:
            MessageError: It is not one.
        """
        try:
            vectors: dict[str, Any] = {name: tuple(_label(signal) for signal in _few(document.get(name, ()))) for name in VECTORS}
            bounds: dict[str, Any] = {name: _bounds(document.get(name), sign, len(vectors[vector])) for name, (vector, sign) in BOUNDS.items()}
            return cls(
                role=str(document["role"]),
                document=json.dumps(document, indent=2),
                model=str(document.get("model", "")),
                obstacles=tuple(_obstacle(disc) for disc in _few(document.get("obstacles", ()))),
                dt_s=float(document.get("dt_s", math.nan)),
                **vectors,
                **bounds,
            )
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise MessageError(f"info must be JSON of role, states, inputs, outputs, bounds as documented, got a fault at {error}") from error

    @classmethod
    def from_payload(cls, payload: bytes, size: int, key: str) -> Info:
        """
        Read a description as it came.

        Args:
            payload: Its bytes.
            size: How many were sent.
            key: Where it was published, which ends with the role that it describes.

        Raises:
            MessageError: It is none.
        """
        info = cls.from_json(read(payload, size))
        if not info.role or info.role != role_of(key):
            raise MessageError(f"info must be of the role that its key ends with, got {info.role[:MAX_TEXT]!r} on {key[-MAX_TEXT:]!r}")
        return info

    @classmethod
    def unnamed(cls, nx: int, nu: int, ny: int) -> Info:
        """Number the components of a robot whose description was never heard."""
        vectors: dict[str, Any] = {name: tuple(Label(f"{name[:-1]}_{i}") for i in range(n)) for name, n in zip(VECTORS, (nx, nu, ny, 0), strict=True)}
        bounds: dict[str, Any] = {name: _bounds(None, sign, len(vectors[vector])) for name, (vector, sign) in BOUNDS.items()}
        return cls(role="unknown", **vectors, **bounds)

    @property
    def position(self) -> tuple[int, int] | None:
        """Indices of the states that are the position in the plane; None: the model has none."""
        names = [label.name for label in self.states]
        return (names.index("x"), names.index("y")) if {"x", "y"} <= set(names) else None

    @property
    def heading(self) -> int | None:
        """Index of the first state that is an angle; None: the model has none."""
        return next((i for i, label in enumerate(self.states) if label.angle), None)

    @property
    def tracked(self) -> list[tuple[int, int]]:
        """Pairs of an output and the state of the same name, by index."""
        names = [label.name for label in self.states]
        return [(i, names.index(label.name)) for i, label in enumerate(self.outputs) if label.name in names]

    def measured(self, i: int) -> int | None:
        """Index of the state that input `i` commands: of its unit, and if several are, of a name it begins with."""
        command = self.inputs[i]
        same_unit = [k for k, label in enumerate(self.states) if label.unit == command.unit != "1"]
        same_name = [k for k in same_unit if command.name.startswith(self.states[k].name)]
        found = same_unit if len(same_unit) == 1 else same_name
        return found[0] if len(found) == 1 else None


VECTORS = ("states", "inputs", "outputs", "disturbances")
BOUNDS = {"lbu": ("inputs", -1), "ubu": ("inputs", 1), "lbx": ("states", -1), "ubx": ("states", 1)}


def _few(values: Sequence[Any]) -> Sequence[Any]:
    if len(values) > MAX_COMPONENTS:
        raise ValueError(f"at most {MAX_COMPONENTS} components expected, got {len(values)}")
    return values


def _label(signal: Mapping[str, Any]) -> Label:
    label = Label(signal["name"], signal["unit"], bool(signal["angle"]))
    for text in (label.name, label.unit):
        if not 0 < len(text) <= MAX_TEXT or not text.isprintable():
            raise ValueError(f"names and units of 1 to {MAX_TEXT} printable characters expected, got {text[:MAX_TEXT]!r}")
    return label


def _obstacle(disc: Mapping[str, Any]) -> Obstacle:
    if not 0 <= (at := int(disc["at"])) < MAX_COMPONENTS:
        raise ValueError(f"a column below {MAX_COMPONENTS} expected, got {at}")
    obstacle = Obstacle(at, *(float(disc[part]) for part in "xyr"))
    if not max(abs(obstacle.x), abs(obstacle.y), abs(obstacle.r)) <= NUMBER_LIMIT:
        raise ValueError(f"a place within {NUMBER_LIMIT:g} expected, got {obstacle}")
    return obstacle


def _bounds(values: Sequence[float | None] | None, sign: int, length: int) -> tuple[float, ...]:
    """Replace what JSON cannot say: null by the infinity of this side."""
    bounds = tuple(sign * math.inf if v is None else float(v) for v in (values or [None] * length))
    if len(bounds) != length:
        raise ValueError(f"{length} bounds expected, got {len(bounds)}")
    return bounds
