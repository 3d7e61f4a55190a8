# SPDX-License-Identifier: Apache-2.0
"""
Reach of a controller: all objects and arrays that can be found from it, by their attributes and items.

What is fixed has no state of its own, or such that lies in the arrays that it holds.
"""

from __future__ import annotations

import functools
import types
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np

from rti_mpc.rti.ocp import Ocp

# Attributes that no command depends on.
NOT_STATE = {("Controller", "on_call"), ("Controller", "_understudy"), ("Planner", "_kept"), ("ModeMachine", "notices")}
FIXED_MODULES = ("casadi", "osqp")  # whose objects have no state of their own, or such that `rewarm` sets
FIXED_CLASSES = {"Model", "Signal", "Timing", "SolverSettings", "Transcription", "StopLaw", "Disturbance", "ObserverSettings", "Rotations"}  # frozen
FIXED_TYPES = (types.FunctionType, types.BuiltinFunctionType, types.MethodType, types.ModuleType, type, slice, range, np.dtype, memoryview)


def is_fixed(value: Any) -> bool:
    """Whether an object has no state, or such that is held in pinned arrays."""
    kind = type(value)
    return isinstance(value, (*FIXED_TYPES, functools.partial)) or kind.__name__ in FIXED_CLASSES or foreign(kind) or issubclass(kind, Ocp)


def foreign(kind: type[Any]) -> bool:
    """Whether a class is none of this package's, nor a container."""
    return kind.__module__.partition(".")[0] not in ("rti_mpc", "rti_mpc_service", "builtins", "collections", "tests")


def attributes(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the attributes of an object of this package."""
    for kind in type(value).__mro__:
        for name in getattr(kind, "__slots__", ()):
            if hasattr(value, name):
                yield name, getattr(value, name)
    yield from getattr(value, "__dict__", {}).items()


def children(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield what a value holds, with a path to it; of what is fixed nothing, see `held`."""
    if is_fixed(value):
        return
    if isinstance(value, dict):
        yield from ((f"{path}[{key!r}]", item) for key, item in value.items())
    elif isinstance(value, list | tuple | deque | set | frozenset):
        yield from ((f"{path}[{i}]", item) for i, item in enumerate(value))
    else:
        yield from ((f"{path}.{name}", child) for name, child in attributes(value) if (type(value).__name__, name) not in NOT_STATE)


def held(value: Any) -> Iterator[np.ndarray[Any, Any]]:
    """Yield the arrays that are held by what is fixed: a bound call, a memory view, a closure, an object of another package."""
    if isinstance(value, memoryview):
        yield np.asarray(value)
    elif isinstance(value, functools.partial):
        for item in (*value.args, *value.keywords.values(), *getattr(value, "memory", ())):  # memory: see `rti_mpc.codegen.bind`
            yield from arrays_of(item)
    elif isinstance(value, types.FunctionType):
        for cell in value.__closure__ or ():
            yield from arrays_of(cell.cell_contents)
    elif foreign(type(value)) and not type(value).__module__.startswith(FIXED_MODULES):
        yield from arrays_of(value)


def arrays_of(value: Any) -> Iterator[np.ndarray[Any, Any]]:
    """Yield an array, or the arrays among the attributes of an object, or the items of a container."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, memoryview):
        yield np.asarray(value)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from arrays_of(item)
    elif foreign(type(value)) and not type(value).__module__.startswith(FIXED_MODULES):
        for item in getattr(value, "__dict__", {}).values():
            if isinstance(item, np.ndarray) or hasattr(item, "indptr"):
                yield from arrays_of(item)


def memory(array: np.ndarray[Any, Any]) -> tuple[Any, ...]:
    """Return where an array lies in memory, its size, and how it is strided if it is not contiguous."""
    about = array.__array_interface__
    return about["data"][0], array.nbytes, about["strides"]


def root(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the array that owns the memory of another one, as far as it is known."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array
