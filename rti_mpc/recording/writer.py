# SPDX-License-Identifier: Apache-2.0
"""Writer of a recording: an MCAP file that is whole up to its last chunk at any instant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from rti_mpc.recording.chunk_file import ChunkFile
from rti_mpc.recording.ros2 import MESSAGE_ENCODING, PROFILE, SCHEMA_ENCODING, ros2_schema, topic, write_text
from rti_mpc.wire.keys import Key
from rti_mpc.wire.streams import role_of

ABOUT, OUTCOME = "rti_mpc", "rti_mpc.outcome"  # names of the metadata at the beginning and at the end
CHUNK_BYTES = 1 << 22  # of messages that wait for their chunk to be closed
MAX_UINT32 = 0xFFFF_FFFF


class RecordingWriter:
    """
    Recording that is being written.

    Times in the file are Unix nanoseconds: local monotonic time plus one offset for the
    whole file, which it also tells, so that no adjustment of the clock disturbs their order.
    """

    def __init__(self, path: Path, start_ns: int, unix_offset_ns: int, version: str) -> None:
        """
        Begin a recording.

        Args:
            path: File, created.
            start_ns: Local monotonic time.
            unix_offset_ns: Unix time minus local monotonic time.
            version: Version of this package.

        Raises:
            OSError: The file is there already, or cannot be written.
        """
        self._offset_ns = unix_offset_ns
        self._file = ChunkFile(path)
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._writer.start(PROFILE, f"rti-mpc {version}")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._writer.add_metadata(ABOUT, {"version": version, "start_ns": str(start_ns), "unix_offset_ns": str(unix_offset_ns)})
        self.flush()

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file.size

    def add(self, robot: str, key: Key[Any], local_ns: int, payload: bytes, seq: int = 0) -> None:
        """
        Add a message to the present chunk.

        Args:
            robot: Name of its robot.
            key: Key on which it was published.
            local_ns: Local monotonic time of its arrival.
            payload: Its bytes as they came: CDR, or a JSON object in UTF-8.
            seq: Its sequence number.
        """
        message = key.stream.message
        if key not in self._channels:
            name, definition = ros2_schema(message)
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, SCHEMA_ENCODING, definition.encode())
            about = {"robot": robot, "stream": key.stream.name, "role": role_of(key) if key.stream.by_role else "", "key": key}
            about |= {"encoding": key.stream.encoding, "offered_qos_profiles": ""}
            self._channels[key] = self._writer.register_channel(topic(key), MESSAGE_ENCODING, self._schemas[name], about)
        time_ns = local_ns + self._offset_ns
        self._writer.add_message(self._channels[key], time_ns, write_text(payload) if message is None else payload, time_ns, seq & MAX_UINT32)

    def attach(self, name: str, media_type: str, data: bytes, local_ns: int) -> None:
        """Add an attachment; it is in the file after the next `flush`."""
        time_ns = local_ns + self._offset_ns
        self._writer.add_attachment(time_ns, time_ns, name, media_type, data)

    def flush(self) -> None:
        """
        Close the present chunk and write it.

        Raises:
            OSError: The disk did not take it; the file ends with the chunk before.
        """
        self._writer.flush()

    def finish(self, outcome: dict[str, str]) -> None:
        """
        Write the rest and the summary, with which other readers find everything at once.

        Args:
            outcome: What was counted, in words or numbers.

        Raises:
            OSError: The disk did not take them.
        """
        self._writer.flush()
        self._writer.add_metadata(OUTCOME, outcome)
        self._writer.finish()
        self._file.flush()
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is, after a failure."""
        self._file.close()
