# SPDX-License-Identifier: Apache-2.0
"""The array type of the library: float64, C-contiguous; shapes are in the docstrings."""

from __future__ import annotations

from collections.abc import Iterable
from math import hypot

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FEW = 64  # numbers, up to which one call on floats is faster than three on an array


def bounded(vector: Array, limit: float) -> bool:
    """Return whether all numbers of a vector, shape ``(n,)``, are finite and of a magnitude of at most a limit."""
    if vector.size <= FEW and hypot(*vector.tolist()) <= 0.5 * limit:  # then each of them is, however it was rounded; false for NaN
        return True
    return bool((np.abs(vector) <= limit).all())


def memories(pairs: Iterable[tuple[Array, Array]]) -> tuple[tuple[memoryview, memoryview], ...]:
    """Return pairs of arrays as their memory, for `copy`: NumPy decides at each copy how to do it, which takes longer than the copy."""
    return tuple((to.reshape(-1).data, of.reshape(-1).data) for to, of in pairs)


def copy(pairs: Iterable[tuple[memoryview, memoryview]]) -> None:
    """Copy the second of each pair of `memories` into the first."""
    for to, of in pairs:
        to[:] = of
