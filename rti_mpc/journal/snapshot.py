# SPDX-License-Identifier: Apache-2.0
"""
Snapshot of a controller between two samples, and its restoration in another one that is built alike.

A snapshot holds whatever can be reached from the controller: all attributes of all
objects of this package, containers, and arrays. Nothing is listed by name, so an
attribute that is added is covered. What cannot be copied is refused by name, never left
out. Objects that the controller was built with are known by the order in which they are
reached; they keep their identity, and so do arrays that compiled code is bound to.
Objects that came later, such as commands, are made anew from their attributes; of those
only classes of the modules in `MADE_IN` are, and none of their code runs.

OSQP's workspace cannot be copied. `Controller.rewarm` makes it a function of arrays that can.
"""

from __future__ import annotations

import sys
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from rti_mpc.control.controller import Controller
from rti_mpc.errors import JournalError
from rti_mpc.journal.reach import NOT_STATE, attributes, children, held, is_fixed, memory, root
from rti_mpc.journal.value import ENCODING_VERSION, Decoder, check_version, encode_slowly
from rti_mpc.rti.ocp import WEIGHTS_AND_BOUNDS, Ocp
from rti_mpc.rti.qp.osqp import Solver

MADE_IN = ("rti_mpc.contract.", "rti_mpc.control.", "rti_mpc.rti.")  # modules of the classes whose objects are made anew
RESIZED = {("Track", "_rows")}  # arrays of the size of a reference; all others that a controller was built with keep their shape
ATOMS = frozenset((type(None), bool, int, float, str, bytes))
MAX_BYTES = 1 << 28  # of a snapshot that is decompressed

FIXED, OBJECT, TUPLE, LIST, QUEUE, TABLE, SET, ARRAY, PINNED, PROBLEM, AGAIN = range(11)  # kinds of nodes

Node = Any  # an atom, an enumeration member, or a tuple that begins with one of these kinds


@dataclass(frozen=True)
class Snapshot:
    """
    State of a controller, copied.

    Attributes:
        pinned: Contents of the arrays that never move.
        arrays: Contents of the others.
        tree: The objects.
    """

    pinned: list[Any]
    arrays: list[Any]
    tree: Node

    def encode(self, pause: Callable[[], object] = lambda: None) -> bytes:
        """Return its bytes, compressed; `pause` is called often, so that others get the interpreter's lock meanwhile."""
        content = bytearray()
        encode_slowly((self.pinned, self.arrays, self.tree), content, pause)
        return bytes((ENCODING_VERSION,)) + zlib.compress(content, 1)

    @classmethod
    def decode(cls, content: bytes) -> Snapshot:
        """
        Return a snapshot from its bytes.

        Raises:
            JournalError: They are none.
        """
        check_version(content)
        try:
            inflate = zlib.decompressobj()
            decoder = Decoder(inflate.decompress(content[1:], MAX_BYTES))
        except zlib.error as error:
            raise JournalError(f"a snapshot must be compressed by zlib, got {error}") from None
        value = decoder.value()
        if not (isinstance(value, tuple) and len(value) == 3 and isinstance(value[0], list) and isinstance(value[1], list) and decoder.done):
            raise JournalError("a snapshot must be arrays and objects, and end there")
        return cls(*value)


class Camera:
    """
    Taker of the snapshots of one controller, or restorer of one.

    Args:
        controller: The controller, as it was built: before its first call that is `reported`.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._built: list[Any] = []  # objects that the controller was built with; kept, so that no other one gets the identity of one that is dropped
        self._places: dict[int, int] = {}  # of these objects, by identity
        self._pinned: list[Any] = []
        self._pins: dict[tuple[Any, ...], int] = {}  # places of pinned arrays, by memory
        self._widths = widths(controller)
        self._survey(controller, "controller")

    # Survey of the controller as it was built.

    def _survey(self, value: Any, path: str) -> None:
        if isinstance(value, np.ndarray) and value.base is not None:  # its memory has another owner, and may not move
            self._pin(root(value))
            self._pin(value)
        if type(value) in ATOMS or isinstance(value, Enum | np.ndarray) or id(value) in self._places:
            return
        self._places[id(value)] = len(self._built)
        self._built.append(value)
        for array in held(value):
            self._pin(array)
        for name, child in children(value, path):
            self._survey(child, name)

    def _pin(self, array: np.ndarray[Any, Any]) -> None:
        if array.size and array.dtype != object and (key := memory(array)) not in self._pins:
            self._pins[key] = len(self._pinned)
            self._pinned.append(array)

    # Taking a snapshot.

    def take(self) -> Snapshot:
        """
        Copy the state, between two samples.

        Raises:
            JournalError: Something cannot be copied; it is named.
        """
        self._seen: dict[int, int] = {}  # objects of this snapshot that came later, by identity
        self._copied: dict[tuple[Any, ...], int] = {}
        self._arrays: list[Any] = []
        tree = self._node(self._controller, "controller")
        return Snapshot([array.copy() for array in self._pinned], self._arrays, tree)

    def _node(self, value: Any, path: str) -> Node:
        kind = type(value)
        if kind in ATOMS or isinstance(value, Enum):
            return value
        if kind is np.ndarray:
            return self._array(value, path)
        if isinstance(value, np.number | np.bool_):
            return value.item()
        place = self._places.get(id(value))
        if place is not None and is_fixed(value):
            return FIXED, place
        if kind is Ocp:
            return PROBLEM, {name: getattr(value, name).copy() for name in WEIGHTS_AND_BOUNDS}
        if isinstance(value, tuple):
            return TUPLE, "" if kind is tuple else full_name(kind), [self._node(item, path) for item in value]
        if (again := self._seen.get(id(value))) is not None:
            return AGAIN, again
        self._seen[id(value)] = number = len(self._seen)
        return self._mutable(value, path, number, -1 if place is None else place)

    def _mutable(self, value: Any, path: str, number: int, place: int) -> Node:
        """Return the node of an object that may be reached in several ways, with its number and its place among those built with the controller."""
        kind = type(value)
        if kind is list:
            return LIST, number, place, [self._node(item, path) for item in value]
        if kind is deque:
            return QUEUE, number, place, value.maxlen, [self._node(item, path) for item in value]
        if kind is dict:
            return TABLE, number, place, [(self._node(key, path), self._node(item, f"{path}[{key!r}]")) for key, item in value.items()]
        if kind in (set, frozenset):
            return SET, number, place, sorted((self._node(item, path) for item in value), key=repr)
        if place < 0 and not kind.__module__.startswith(MADE_IN):
            raise JournalError(f"{path} must be of a kind that a snapshot can copy, got {kind.__module__}.{kind.__qualname__}")
        nodes = [(key, self._node(child, f"{path}.{key}")) for key, child in attributes(value) if (kind.__name__, key) not in NOT_STATE]
        return OBJECT, number, place, full_name(kind), nodes

    def _array(self, array: np.ndarray[Any, Any], path: str) -> Node:
        key = memory(array)
        if (pin := self._pins.get(key)) is not None and array.size:
            return PINNED, pin, array.shape
        if array.size and array.base is not None and memory(root(array)) in self._pins:
            raise JournalError(f"{path} must not be a part of an array that never moves, unless it was one from the start: a snapshot cannot tell")
        if key not in self._copied or not array.size:
            self._copied[key] = len(self._arrays)
            self._arrays.append(array.copy())
        return ARRAY, self._copied[key], array.shape

    # Restoration.

    def restore(self, snapshot: Snapshot) -> None:
        """
        Bring the controller, which was built like that of a snapshot, into its state.

        Raises:
            JournalError: It was built by other code, or from another configuration.
        """
        if not (len(self._pinned) == len(snapshot.pinned) and all(map(fits, self._pinned, snapshot.pinned))):
            raise JournalError(
                "a snapshot must be of a controller built like this one, by the same version from the same configuration, got another state"
            )
        for ours, theirs in zip(self._pinned, snapshot.pinned, strict=True):
            if ours.flags.writeable:
                ours[...] = theirs
        self._objects: dict[int, Any] = {}
        self._arrays = snapshot.arrays
        try:
            self._value(snapshot.tree)
        except (IndexError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise JournalError(f"a snapshot must be of a controller built like this one, got a fault at {error}") from error
        for solver in self._built:
            if isinstance(solver, Solver):
                solver.revive()

    def _value(self, node: Node) -> Any:
        if not isinstance(node, tuple):
            return node
        kind, *rest = node
        if kind == FIXED:
            return self._built[rest[0]]
        if kind == AGAIN:
            return self._objects[rest[0]]
        if kind == ARRAY:
            return self._arrays[rest[0]].reshape(rest[1])
        if kind == PINNED:
            return self._pinned[rest[0]].reshape(rest[1])
        if kind == PROBLEM:
            return next(value for value in self._built if type(value) is Ocp).retuned(**rest[0])
        if kind == TUPLE:
            items = [self._value(item) for item in rest[1]]
            return tuple.__new__(made_class(rest[0]), items) if rest[0] else tuple(items)
        return self._restored(kind, *rest)

    def _restored(self, kind: int, number: int, place: int, *content: Any) -> Any:
        """Return an object in its state: the one that the controller was built with, or a new one."""
        made: Any = self._built[place] if place >= 0 else None
        if kind == OBJECT:
            name, nodes = content
            if made is None:
                made = object.__new__(made_class(name))
            if full_name(type(made)) != name:
                raise TypeError(f"a {full_name(type(made))} instead of a {name}")
            self._objects[number] = made
            for key, child in nodes:
                value, at = self._value(child), (type(made).__name__, key)
                check(
                    f"{name}.{key}", value, alike(getattr(made, key, None), value, shape=at not in RESIZED) and has_width(value, self._widths.get(at))
                )
                object.__setattr__(made, key, value)
            return made
        if kind == SET:
            items = {self._value(item) for item in content[0]}
            self._objects[number] = made = items if made is None else made
            if made != items:
                made.clear()
                made.update(items)
            return made
        if made is None:
            made = {} if kind == TABLE else deque(maxlen=content[0]) if kind == QUEUE else []
        self._objects[number] = made
        before = dict(made) if kind == TABLE else {}
        made.clear()
        if kind == TABLE:
            made.update((self._value(key), self._value(item)) for key, item in content[0])
            for key, ours in before.items():
                check(f"{key!r}", theirs := made.get(key), alike(ours, theirs))
        else:
            made.extend(self._value(item) for item in content[-1])
        return made


def fits(ours: np.ndarray[Any, Any], theirs: Any) -> bool:
    """Whether an array may be written over one that never moves; integers are patterns of sparse matrices, whose indices compiled code trusts."""
    alike = isinstance(theirs, np.ndarray) and theirs.shape == ours.shape and theirs.dtype == ours.dtype
    return alike and (ours.dtype.kind == "f" or np.array_equal(ours, theirs))


def widths(controller: Controller) -> dict[tuple[str, str], tuple[int, set[int]]]:
    """Return the number of axes, and the possible lengths of the last one, of arrays that are made anew or resized, by class and attribute."""
    (nx,), (nu,), ny = controller._states.x.shape, controller.envelope.limits["lbu"].shape, controller._track.y_ref.shape[1]
    plan = {("Plan", "u"): (2, {nu}), ("Plan", "asked"): (2, {nu}), ("Plan", "before"): (1, {nu})}
    state = {("State", "x"): (1, {nx}), ("State", "u"): (1, {0, nu})}
    reference = {("Reference", "y"): (2, {ny}), ("Reference", "p"): (2, {0, controller.np_})}
    rest = {("Command", "u_rest"): (2, {0, nu}), ("Command", "x_rest"): (2, {0, nx}), ("Command", "K"): (2, {0, nx})}
    track = {("Track", "_rows"): (2, {2 * columns for columns in controller._track._found})}  # with and without parameters
    return {**plan, **state, **reference, **track, ("Command", "u"): (2, {nu}), **rest}


def has_width(value: Any, width: tuple[int, set[int]] | None) -> bool:
    """Whether a value has a number of axes, and one of some lengths of the last one; anything has if none is known."""
    return width is None or (isinstance(value, np.ndarray) and value.ndim == width[0] and value.shape[-1] in width[1])


def alike(ours: Any, theirs: Any, *, shape: bool = True) -> bool:
    """Whether arrays, or those in tuples, have the same type and, unless it may differ, the same shape; other values are not compared."""
    if isinstance(ours, np.ndarray) and isinstance(theirs, np.ndarray):
        return ours.dtype == theirs.dtype and (ours.shape == theirs.shape or not shape)
    if isinstance(ours, tuple) and isinstance(theirs, tuple):
        return all(map(alike, ours, theirs))
    return True


def check(name: str, value: Any, fitting: bool) -> None:
    """Refuse a value of another size than it can have."""
    if not fitting:
        raise JournalError(f"{name} of a snapshot must have the size that it has in a controller built like this one, got {sizes(value)}")


def sizes(value: Any) -> Any:
    """Return the shape of an array, those of a tuple, or what else a value is."""
    return value.shape if isinstance(value, np.ndarray) else [*map(sizes, value)] if isinstance(value, tuple) else type(value).__name__


def full_name(kind: type[Any]) -> str:
    """Return the name of a class with its module."""
    return f"{kind.__module__}.{kind.__name__}"


def made_class(name: str) -> type[Any]:
    """Return a class of ours by its full name; nothing is imported for it."""
    module, _, own = name.rpartition(".")
    cls = getattr(sys.modules.get(module), own, None) if module.startswith(MADE_IN) else None
    if not isinstance(cls, type) or full_name(cls) != name:
        raise TypeError(f"{name}, which is no class of a controller")
    return cls
