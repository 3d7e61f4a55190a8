# SPDX-License-Identifier: Apache-2.0
"""
Arguments as a caller gives them, made into what the library works with.

What can only mean one thing is taken: lists, other number types, CasADi's `DM`, a number for
an array of one. What cannot is refused in one line that names the argument, never broadcast.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Collection, Iterable
from decimal import Decimal
from difflib import get_close_matches
from numbers import Real
from typing import Any, TypeVar

import numpy as np

from rti_mpc.array import Array
from rti_mpc.errors import OcpError, ShapeError

T = TypeVar("T")
FLOAT64 = np.dtype(np.float64)  # the one object NumPy has of it
QUOTED_CHARACTERS = 80  # of a wrong value in an error


def quoted(value: object, characters: int = QUOTED_CHARACTERS) -> str:
    """Return a value as one line of bounded length."""
    text = " ".join(repr(value).split())
    return text if len(text) <= characters else f"{text[:characters]}..."


def numbers(name: str, value: Any) -> Array:
    """
    Return real numbers as an array of any shape, not owned.

    Raises:
        OcpError: They are none: text, symbols, complex numbers, nothing, masked, or rows of different lengths.
    """
    try:
        array = np.asarray(value.full() if hasattr(value, "full") else value)  # CasADi's DM
        exact = array.dtype.kind == "O" and array.size > 0 and all(isinstance(number, Real | Decimal) for number in array.flat)
        if (exact or array.dtype.kind in "fiub") and not np.ma.is_masked(value):
            return np.asarray(array, dtype=np.float64, order="C")
    except Exception:  # whatever a foreign type raises where it is no array, or an integer that no float64 can hold
        pass
    raise OcpError(f"{name} must be real numbers, got {quoted(value)}") from None


def array(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """
    Return real numbers as an array of a shape, not owned; an axis of length one may be left out, and a column of CasADi's is a vector.

    Raises:
        OcpError: They are no real numbers.
        ShapeError: Their shape is another.
    """
    if value.__class__ is np.ndarray and value.dtype is FLOAT64 and value.shape == shape:
        return value  # nothing to be done, as for every sample of a loop
    given = numbers(name, value)
    if given.shape == shape:
        return given
    long, wanted = (tuple(n for n in lengths if n != 1) for lengths in (given.shape, shape))
    left_out = given.ndim < len(shape) and long == wanted
    column = hasattr(value, "full") and given.shape == (*shape, 1)
    if left_out or column or given.size == math.prod(shape) == 0:
        return given.reshape(shape)
    raise ShapeError(name, shape, given)


def number(name: str, value: Any) -> float:
    """
    Return one real number.

    Raises:
        OcpError: It is none.
    """
    if (given := numbers(name, value)).size != 1 or (given.ndim and not hasattr(value, "full")):
        raise OcpError(f"{name} must be one number, got {quoted(value)}")
    return float(given.item())


def whole(name: str, value: Any, least: int) -> int:
    """
    Return a whole number of at least `least`.

    Raises:
        OcpError: It is none.
    """
    try:
        count = operator.index(value)
    except TypeError:
        count = None
    if count is None or isinstance(value, bool) or count < least:
        raise OcpError(f"{name} must be a whole number of at least {least}, got {quoted(value)}")
    return count


def one_of(name: str, value: Any, names: Collection[str]) -> str:
    """
    Return one of some names.

    Raises:
        OcpError: It is none of them.
    """
    if not isinstance(value, str) or value not in names:
        raise OcpError(f"{name} must be one of {', '.join(names)}, got {quoted(value)}{nearest(value, names)}")
    return value


def nearest(value: Any, names: Iterable[str]) -> str:
    """Return what was probably meant, in small or in large letters, to be appended; empty if nothing is near."""
    known = {name.lower(): name for name in names}
    near = get_close_matches(value.lower(), known, 1) if isinstance(value, str) else []
    return f", perhaps {known[near[0]]} is meant" if near else ""


def instance(name: str, value: Any, cls: type[T]) -> T:
    """
    Return an object of a class.

    Raises:
        OcpError: It is of another.
    """
    if not isinstance(value, cls):
        raise OcpError(f"{name} must be of {cls.__module__}.{cls.__name__}, got {quoted(value)}")
    return value
