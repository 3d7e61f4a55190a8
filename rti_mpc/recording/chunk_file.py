# SPDX-License-Identifier: Apache-2.0
"""File to which only whole chunks are appended."""

from __future__ import annotations

import os
from pathlib import Path


class ChunkFile:
    """
    Output of an MCAP writer: what is written waits in memory until `flush`.

    If the disk takes only a part of a chunk, the file is cut off where that chunk began.

    Attributes:
        size: Bytes in the file.
    """

    def __init__(self, path: Path) -> None:
        """
        Create a file.

        Raises:
            OSError: It is there already, or cannot be created.
        """
        self.size = 0
        self._waiting = bytearray()
        self._file = path.open("xb", buffering=0)

    def write(self, data: bytes) -> int:
        """Keep bytes for the next `flush`, and return their number."""
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        """Return the position at which the next bytes will be written."""
        return self.size + len(self._waiting)

    def flush(self) -> None:
        """
        Write the waiting bytes, to the disk itself.

        Raises:
            OSError: The disk did not take all of them; it keeps none, and they are lost.
        """
        waiting, self._waiting = memoryview(bytes(self._waiting)), bytearray()
        try:
            written = 0
            while written < len(waiting):
                written += self._file.write(waiting[written:]) or 0
            os.fdatasync(self._file.fileno())
        except OSError:
            self._file.truncate(self.size)
            raise
        self.size += len(waiting)

    def close(self) -> None:
        """Close the file, without what is still waiting."""
        self._file.close()
