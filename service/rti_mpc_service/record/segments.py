# SPDX-License-Identifier: Apache-2.0
"""Files of a recording: one, or a folder of segments of which the oldest are deleted."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import rti_mpc
from rti_mpc.errors import ConfigError
from rti_mpc.recording.writer import RecordingWriter
from rti_mpc_service.record.inbox import Arrived

SEGMENTS = 8  # that a limit of time or size is divided into; one more is being written


@dataclass(frozen=True)
class Retention:
    """
    What of a recording is kept, None where there is no limit.

    Attributes:
        last_s: Time that is kept at least, s.
        max_bytes: Size of all files at most.
    """

    last_s: float | None = None
    max_bytes: int | None = None

    def __bool__(self) -> bool:
        return self != Retention()


class Segments:
    """
    Files of one recording.

    Each segment stands for itself: it begins with all attachments, and with the last message of every cached stream.

    Attributes:
        writer: The file that is being written.
        written: Bytes in all files that are kept, but for that one.
    """

    def __init__(self, path: Path, retention: Retention, start_ns: int, unix_offset_ns: int) -> None:
        """
        Create the first file.

        Args:
            path: The file; the folder of the segments if there is a limit.
            retention: Limits of time and size.
            start_ns: Local monotonic time.
            unix_offset_ns: Unix time minus local monotonic time.

        Raises:
            ConfigError: It is there already, or cannot be written.
        """
        self.written = 0
        self._retention = retention
        self._path = path
        self._unix_offset_ns = unix_offset_ns
        self._number = 0
        self._begun_ns = start_ns
        self._kept: deque[tuple[Path, int, int]] = deque()  # file, size, time of its end
        self._attached: dict[str, tuple[str, bytes]] = {}
        self._latest: dict[str, Arrived] = {}  # of cached streams, by key
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if retention:
                path.mkdir()
            self.writer = self._begin(start_ns)
        except OSError as error:
            what = "folder" if retention else "file"
            raise ConfigError(f"--out must be a {what} that can be written and is not there yet, got {path}: {error.strerror}") from error

    @property
    def size(self) -> int:
        """Bytes in all files that are kept."""
        return self.written + self.writer.size

    def _begin(self, now_ns: int) -> RecordingWriter:
        self._number += 1
        self._file = self._path / f"{self._number:06d}.mcap" if self._retention else self._path
        self._begun_ns = now_ns
        return RecordingWriter(self._file, now_ns, self._unix_offset_ns, rti_mpc.__version__)

    def keep(self, entry: Arrived) -> None:
        """Remember a message for the beginning of later segments, if late joiners would receive it."""
        if self._retention and entry.stream.qos.cached:
            self._latest[entry.received.key] = entry

    def attach(self, name: str, media_type: str, data: bytes, now_ns: int) -> None:
        """Add an attachment, once."""
        if name not in self._attached:
            self._attached[name] = media_type, data
            self.writer.attach(name, media_type, data, now_ns)

    def roll(self, now_ns: int, outcome: dict[str, str]) -> Iterator[Arrived]:
        """
        Begin the next segment if the present one has its share of a limit, delete the oldest, and yield what it has to begin with.

        Raises:
            OSError: The disk is full.
        """
        retention = self._retention
        due = retention.last_s is not None and now_ns - self._begun_ns >= 1e9 * retention.last_s / SEGMENTS
        if not (due or (retention.max_bytes is not None and self.writer.size >= retention.max_bytes / (SEGMENTS + 1))):
            return
        self.writer.finish(outcome)
        self._kept.append((self._file, self.writer.size, now_ns))
        self.written += self.writer.size
        while self._superfluous(now_ns):
            file, size, _ = self._kept.popleft()
            file.unlink(missing_ok=True)
            self.written -= size
        self.writer = self._begin(now_ns)
        for name, (media_type, data) in self._attached.items():
            self.writer.attach(name, media_type, data, now_ns)
        yield from self._latest.values()

    def _superfluous(self, now_ns: int) -> bool:
        """Whether the oldest segment can be deleted."""
        if not self._kept:
            return False
        retention = self._retention
        old = retention.last_s is not None and now_ns - self._kept[0][2] > 1e9 * retention.last_s
        return old or (retention.max_bytes is not None and self.written > retention.max_bytes * SEGMENTS / (SEGMENTS + 1))
