# SPDX-License-Identifier: Apache-2.0
"""
Writer and reader of the descriptions on ``info/<role>``, JSON that late joiners receive as well.

Viewers and figures take names, units and limits from them, standbys take the parameters
of the leader, and all controllers and guards an operator's stop that they have missed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rti_mpc.errors import MessageError
from rti_mpc.rotation import Rotations
from rti_mpc.signals import Signal, path_place, place, plane
from rti_mpc.wire.document import read
from rti_mpc.wire.layout import NUMBER_LIMIT
from rti_mpc.wire.received import Received
from rti_mpc.wire.streams import role_of

MAX_TEXT_CHARS = 64  # of a name or a unit
MAX_COMPONENTS = 512  # of a vector; also the most obstacles, and the most columns of a reference


@dataclass(frozen=True)
class Label:
    """
    Name and unit of one component of a vector.

    Attributes:
        name: Unique within its vector.
        unit: SI unit, ``"1"`` if none.
        angle: Whether it wraps at ``+-pi``.
        role: As in `rti_mpc.signals.Signal`; empty if none is said.
        state: Name of the state that an input commands, or that an output is; empty if there is none.
    """

    name: str
    unit: str = "1"
    angle: bool = False
    role: str = ""
    state: str = ""

    def __str__(self) -> str:
        return self.name if self.unit == "1" else f"{self.name} [{self.unit}]"


@dataclass(frozen=True)
class Obstacle:
    """
    A disc that the robot must stay out of.

    Attributes:
        at: Column of its x in a reference's `p`; y and r follow.
        x: Position in m, unless a reference carries another.
        y: Position in m, likewise.
        r: Radius in m.
    """

    at: int
    x: float
    y: float
    r: float


@dataclass(frozen=True)
class Weights:
    """
    Weights of the cost, as they are now; see `rti_mpc.rti.ocp.Ocp`.

    Attributes:
        Q: Of outputs, ``ny`` rows.
        R: Of increments, ``nu`` rows.
        delta: Of each stage's outputs; a row per stage where they differ by output.
        lambda_: Of each stage's increments, within the control horizon, likewise.
    """

    Q: tuple[tuple[float, ...], ...]
    R: tuple[tuple[float, ...], ...]
    delta: tuple[float, ...] | tuple[tuple[float, ...], ...]
    lambda_: tuple[float, ...] | tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Info:
    """
    Description of a process on the bus; that of a controller labels every vector. Two are equal if all but role and document are.

    Attributes:
        role: Role of the publisher: controller, robot, ...
        document: The whole description, as indented JSON.
        model: Name of the model.
        states: Labels of ``x``; empty where the publisher does not know the model.
        inputs: Labels of ``u``.
        outputs: Labels of ``y``.
        disturbances: Labels of the disturbances that an observer estimates.
        stage_parameters: Labels of a reference's ``p``.
        obstacles: Obstacles that the robot must stay out of.
        dt_s: Sample period; NaN if not said.
        lbu: Lower bounds of the inputs, infinite where there is none.
        ubu: Upper bounds of the inputs.
        lbx: Lower bounds of the states.
        ubx: Upper bounds of the states.
        lbdu: Lower bounds of the increments of the inputs, per sample.
        ubdu: Upper bounds of the increments.
        scale_x: What each state ranges over, its scale inside the solver, see `rti_mpc.rti.scale`; empty if not said.
        scale_u: The same of the inputs.
        weights: Weights of the cost; None if not said.
        quaternions: Names of w, x, y, z of each attitude, of states or outputs.
    """

    role: str = field(compare=False)
    document: str = field(default="{}", compare=False)
    model: str = ""
    states: tuple[Label, ...] = ()
    inputs: tuple[Label, ...] = ()
    outputs: tuple[Label, ...] = ()
    disturbances: tuple[Label, ...] = ()
    stage_parameters: tuple[Label, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    dt_s: float = math.nan
    lbu: tuple[float, ...] = ()
    ubu: tuple[float, ...] = ()
    lbx: tuple[float, ...] = ()
    ubx: tuple[float, ...] = ()
    lbdu: tuple[float, ...] = ()
    ubdu: tuple[float, ...] = ()
    scale_x: tuple[float, ...] = ()
    scale_u: tuple[float, ...] = ()
    weights: Weights | None = None
    quaternions: tuple[tuple[str, ...], ...] = ()

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Info:
        """
        Read a description as published, infinities as null.

        Raises:
            MessageError: The document is no description.
        """
        try:
            vectors: dict[str, Any] = {name: tuple(_label(signal) for signal in _few(document.get(name, ()))) for name in INFO_VECTORS}
            bounds: dict[str, Any] = {name: _bounds(document.get(name), sign, len(vectors[vector])) for name, (vector, sign) in INFO_BOUNDS.items()}
            told = [(name, vector) for name, vector in INFO_SCALES.items() if name in document]
            scales: dict[str, Any] = {name: _scale(document[name], len(vectors[vector])) for name, vector in told}
            return cls(
                role=str(document["role"]),
                document=json.dumps(document, indent=2),
                model=str(document.get("model", "")),
                obstacles=tuple(_obstacle(disc) for disc in _few(document.get("obstacles", ()))),
                dt_s=float(document.get("dt_s", math.nan)),
                weights=_weights(document["weights"], len(vectors["outputs"]), len(vectors["inputs"])) if "weights" in document else None,
                quaternions=tuple(_quaternion(names) for names in _few(document.get("quaternions", ()))),
                **vectors,
                **bounds,
                **scales,
            )
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise MessageError(f"info must be JSON of role, states, inputs, outputs, bounds as documented, got a fault at {error}") from error

    @classmethod
    def from_received(cls, received: Received) -> Info:
        """
        Read a description from the bus; its key must end with the role that it describes.

        Raises:
            MessageError: The payload is no description, or of another role.
        """
        info, key = cls.from_json(read(received.payload, received.size)), received.key
        if not info.role or info.role != role_of(key):
            raise MessageError(f"info must be of the role that its key ends with, got {info.role[:MAX_TEXT_CHARS]!r} on {key[-MAX_TEXT_CHARS:]!r}")
        return info

    @classmethod
    def unnamed(cls, nx: int, nu: int, ny: int) -> Info:
        """Number the components of a robot whose description was never heard."""
        sizes = zip(INFO_VECTORS, (nx, nu, ny, 0, 0), strict=True)
        vectors: dict[str, Any] = {name: tuple(Label(f"{name[:-1]}_{i}") for i in range(n)) for name, n in sizes}
        bounds: dict[str, Any] = {name: _bounds(None, sign, len(vectors[vector])) for name, (vector, sign) in INFO_BOUNDS.items()}
        return cls(role="unknown", **vectors, **bounds)

    def rotations(self, vector: str) -> Rotations:
        """Return the rotations among ``states`` or ``outputs``."""
        return Rotations.of(getattr(self, vector), self.quaternions)

    @property
    def position(self) -> tuple[int, int] | None:
        """Indices of the states that are the position in the plane; None: the model has none."""
        return plane(self.states)

    @property
    def heading(self) -> int | None:
        """Index of the state that is the heading in the plane; None: the model has none."""
        return place(self.states, "heading")

    @property
    def tracked(self) -> list[tuple[int, int]]:
        """Index pairs of each output that is a state, and of that state."""
        return [(i, k) for i, label in enumerate(self.outputs) if (k := self._state(label)) is not None]

    @property
    def computed(self) -> list[int]:
        """Indices of the outputs that are no state, such as the tip of an arm: only the controller, who has the model, knows them."""
        return [i for i, label in enumerate(self.outputs) if self._state(label) is None]

    @property
    def computed_position(self) -> tuple[int, int] | None:
        """Indices of the outputs that are the position in the plane; None if there are none, or one of them is a state."""
        position = plane(self.outputs)
        return position if position is not None and set(position) <= set(self.computed) else None

    @property
    def planar(self) -> bool:
        """Whether there is a position in the plane, of the robot or of its outputs."""
        return self.position is not None or self.computed_position is not None

    @property
    def path(self) -> tuple[int, int] | None:
        """Where the followed path's parameters begin in a reference's `p`, and how many knots it has; None: the robot follows no path."""
        return path_place(self.stage_parameters)

    def measured(self, i: int) -> int | None:
        """Index of the state that input `i` commands; None: there is none."""
        return self._state(self.inputs[i])

    def _state(self, label: Label) -> int | None:
        return next((k for k, state in enumerate(self.states) if state.name == label.state), None)


INFO_VECTORS = ("states", "inputs", "outputs", "disturbances", "stage_parameters")
# Bounds, each with its vector and the sign of the infinity that stands for none.
INFO_BOUNDS = {
    "lbu": ("inputs", -1),
    "ubu": ("inputs", 1),
    "lbx": ("states", -1),
    "ubx": ("states", 1),
    "lbdu": ("inputs", -1),
    "ubdu": ("inputs", 1),
}

INFO_SCALES = {"scale_x": "states", "scale_u": "inputs"}


def labels(counterparts: Mapping[str, Sequence[str]] | None = None, /, **vectors: Sequence[Signal | Label]) -> dict[str, Any]:
    """
    Write the components of vectors, such as ``states``, as a part of a description.

    Args:
        counterparts: For each vector by name, the `Label.state` of each of its components; empty strings if left out.
        vectors: For each vector by name, its components.
    """
    return {
        vector: [
            {"name": signal.name, "unit": signal.unit, "angle": signal.angle, "role": signal.role, "state": state}
            for signal, state in zip(signals, (counterparts or {}).get(vector, [""] * len(signals)), strict=True)
        ]
        for vector, signals in vectors.items()
    }


def bounds(**vectors: Iterable[float]) -> dict[str, Any]:
    """Write bounds, such as ``lbu``, as a part of a description: null where there is none."""
    return {name: [value if math.isfinite(value) else None for value in values] for name, values in vectors.items()}


def scales(*, scale_x: Iterable[float], scale_u: Iterable[float]) -> dict[str, Any]:
    """Write what states and inputs range over as a part of a description."""
    return {"scale_x": [*scale_x], "scale_u": [*scale_u]}


def weights(**values: Sequence[Any]) -> dict[str, Any]:
    """Write weights, with the attributes of `Weights`, as a part of a description."""
    return {"weights": values}


def obstacles(discs: Iterable[tuple[int, float, float, float]]) -> dict[str, Any]:
    """Write obstacles, each with the attributes of `Obstacle`, as a part of a description."""
    return {"obstacles": [{"at": at, "x": x, "y": y, "r": r} for at, x, y, r in discs]}


def parameters(version: int, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Write a controller's parameters, by their version and what was changed, as a part of a description."""
    return {"parameters": {"version": version, "changes": changes}}


def latch(values: Mapping[str, Any]) -> dict[str, Any]:
    """Write an operator's stop, the fields of a `rti_mpc.contract.latch.Latch`, as a part of a description."""
    return {"latch": values}


def latches(received: Received) -> tuple[Any, ...]:
    """
    Return the latch of a description, not checked yet, for `rti_mpc.contract.latch.read_latch`; empty if there is none.

    Raises:
        MessageError: The payload is no JSON object.
    """
    document = read(received.payload, received.size)
    return (document["latch"],) if "latch" in document else ()


@dataclass(frozen=True)
class Leader:
    """
    The leading controller, from its own description.

    Attributes:
        epoch: Epoch of its commands.
        seq: Sequence number of the description.
        config_hash: Hash of its configuration.
        parameters: Version and changes of its parameters as they came, see `parameters`; None if the description has none.
        model_hash: Hash of its model's equations, text; empty if the description has none.
    """

    epoch: int
    seq: int
    config_hash: int
    parameters: Any = None
    model_hash: str = ""

    @classmethod
    def from_received(cls, received: Received, highest: int) -> Leader | None:
        """Read the description of a leader with an epoch of at most `highest`; None if it is not one."""
        try:
            document = read(received.payload, received.size)
        except MessageError:
            return None
        numbers: list[Any] = [document.get(name) for name in ("epoch", "seq", "config_hash")]
        if not all(type(number) is int and number >= 0 for number in numbers):
            return None
        epoch, seq, config_hash = numbers
        model_hash = document.get("model_hash")
        known = model_hash if isinstance(model_hash, str) and len(model_hash) <= MAX_TEXT_CHARS else ""
        return cls(epoch, seq, config_hash, document.get("parameters"), known) if epoch <= highest else None


def _few(values: Sequence[Any]) -> Sequence[Any]:
    if len(values) > MAX_COMPONENTS:
        raise ValueError(f"at most {MAX_COMPONENTS} components expected, got {len(values)}")
    return values


def _label(signal: Mapping[str, Any]) -> Label:
    role, state = (str(signal.get(name, ""))[:MAX_TEXT_CHARS] for name in ("role", "state"))
    label = Label(signal["name"], signal["unit"], bool(signal["angle"]), role, state)
    for text in (label.name, label.unit):
        if not 0 < len(text) <= MAX_TEXT_CHARS or not text.isprintable():
            raise ValueError(f"names and units of 1 to {MAX_TEXT_CHARS} printable characters expected, got {text[:MAX_TEXT_CHARS]!r}")
    return label


def _quaternion(names: Any) -> tuple[str, ...]:
    if not isinstance(names, list | tuple) or len(names) != 4 or not all(isinstance(name, str) and len(name) <= MAX_TEXT_CHARS for name in names):
        raise ValueError(f"names of w, x, y, z expected, got {str(names)[:MAX_TEXT_CHARS]}")
    return tuple(names)


def _weights(values: Mapping[str, Any], ny: int, nu: int) -> Weights:
    rows = {name: tuple(_numbers(row, size) for row in _few(values[name])) for name, size in (("Q", ny), ("R", nu))}
    if (len(rows["Q"]), len(rows["R"])) != (ny, nu):
        raise ValueError(f"weights of {ny} outputs and {nu} inputs expected, got {len(rows['Q'])} and {len(rows['R'])}")
    return Weights(**rows, delta=_factors(values["delta"], ny), lambda_=_factors(values["lambda_"], nu))


def _factors(values: Sequence[Any], width: int) -> tuple[float, ...] | tuple[tuple[float, ...], ...]:
    if not values:
        raise ValueError("factors of one stage or more expected, got none")
    by_signal = isinstance(values[0], Sequence)
    return tuple(_numbers(row, width) for row in values) if by_signal else _numbers(values)


def _numbers(values: Sequence[Any], length: int | None = None) -> tuple[float, ...]:
    numbers = tuple(map(float, values))
    if length not in (None, len(numbers)) or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{length or 'some'} finite numbers expected, got {numbers[:MAX_COMPONENTS]}")
    return numbers


def _scale(values: Sequence[Any], length: int) -> tuple[float, ...]:
    numbers = _numbers(values, length)
    if not min(numbers, default=1.0) > 0.0:
        raise ValueError(f"positive numbers expected, got {numbers[:MAX_COMPONENTS]}")
    return numbers


def _obstacle(disc: Mapping[str, Any]) -> Obstacle:
    if not 0 <= (at := int(disc["at"])) < MAX_COMPONENTS:
        raise ValueError(f"a column below {MAX_COMPONENTS} expected, got {at}")
    obstacle = Obstacle(at, *(float(disc[part]) for part in "xyr"))
    if not max(abs(obstacle.x), abs(obstacle.y), abs(obstacle.r)) <= NUMBER_LIMIT:
        raise ValueError(f"a place within {NUMBER_LIMIT:g} expected, got {obstacle}")
    return obstacle


def _bounds(values: Sequence[float | None] | None, sign: int, length: int) -> tuple[float, ...]:
    """Replace null, which stands for no bound, by the infinity of this side."""
    bounds = tuple(sign * math.inf if v is None else float(v) for v in (values or [None] * length))
    if len(bounds) != length:
        raise ValueError(f"{length} bounds expected, got {len(bounds)}")
    return bounds
