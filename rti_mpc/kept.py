# SPDX-License-Identifier: Apache-2.0
"""Arrays that a computation may overwrite, and that are put back as they were, bit for bit."""

from __future__ import annotations

from collections.abc import Iterable

from rti_mpc.array import Array, copy, memories


class Kept:
    """
    A block, at the end of which arrays are as they were at its beginning; may be entered again and again.

    Args:
        arrays: The arrays, C-contiguous; their memory must stay in place.
    """

    def __init__(self, arrays: Iterable[Array]) -> None:
        self._pairs = memories((array.copy(), array) for array in arrays)

    def __enter__(self) -> None:
        copy(self._pairs)

    def __exit__(self, *_: object) -> None:
        for kept, array in self._pairs:
            array[:] = kept
