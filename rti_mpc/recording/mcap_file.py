# SPDX-License-Identifier: Apache-2.0
"""
Records of an MCAP file in their order, up to where it ends or is damaged.

The readers of the `mcap` package need the summary at the end, which a file lacks whose
writer was killed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from struct import Struct, error
from typing import NamedTuple

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream
from zstandard import ZstdError

from rti_mpc.errors import MessageError

RECORD_HEAD = Struct("<BQ")  # opcode, length
MESSAGE_HEAD = Struct("<HIQQ")  # channel, sequence number, times of arrival and of publication
# Raised by a part that is no record; sums that do not fit and texts that are not UTF-8 are a ValueError.
DAMAGES = (McapError, ZstdError, error, ValueError, MemoryError, OverflowError)


class StoredMessage(NamedTuple):
    """
    A message as it is stored.

    Attributes:
        channel_id: Number of its channel.
        seq: Sequence number, low 32 bits.
        time_ns: Unix time of its arrival.
        payload: Its bytes.
    """

    channel_id: int
    seq: int
    time_ns: int
    payload: bytes


class McapFile:
    """
    An MCAP file.

    Attributes:
        whole: Whether the last pass through the records came to the end of the data; a file whose writer was killed has none.
    """

    def __init__(self, path: Path) -> None:
        """
        Open a file.

        Raises:
            MessageError: It is no MCAP file.
            OSError: It cannot be read.
        """
        self.whole = False
        self._path = path
        with path.open("rb") as file:
            if (head := file.read(8)) != b"\x89MCAP0\r\n":
                raise MessageError(f"{path} must be an MCAP file, got {f'one that begins with {head!r}' if head else 'an empty one'}")

    def records(self) -> Iterator[McapRecord]:
        """Yield what the data holds: chunks, attachments and metadata, up to the first record that is not whole."""
        self.whole = False
        with self._path.open("rb") as file:
            records = StreamReader(file, emit_chunks=True).records
            while True:
                try:
                    record = next(records)
                except (*DAMAGES, StopIteration):
                    return
                if isinstance(record, DataEnd):
                    self.whole = True
                    return
                yield record

    def contents(self) -> Iterator[Channel | Schema | Attachment | Metadata]:
        """Yield all but messages."""
        for record in self.records():
            if isinstance(record, Chunk):
                try:
                    yield from (inner for inner in breakup_chunk(record, validate_crc=True) if isinstance(inner, Channel | Schema))
                except DAMAGES:
                    return
            elif isinstance(record, Attachment | Metadata):
                yield record

    def messages(self, channels: Collection[int] | None = None) -> Iterator[StoredMessage]:
        """Yield the messages of channels, by their numbers, in the order of their arrival; None: of all."""
        for record in self.records():
            if isinstance(record, Chunk):
                try:
                    stream, length = get_chunk_data_stream(record, validate_crc=True)
                    yield from messages_in(stream.read(length), channels)
                except DAMAGES:
                    self.whole = False
                    return


def messages_in(data: bytes, channels: Collection[int] | None) -> Iterator[StoredMessage]:
    """Yield the messages of channels in the uncompressed content of a chunk."""
    at = 0
    while at < len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        at += RECORD_HEAD.size
        if opcode == Opcode.MESSAGE:
            channel_id, seq, time_ns, _ = MESSAGE_HEAD.unpack_from(data, at)
            if channels is None or channel_id in channels:
                yield StoredMessage(channel_id, seq, time_ns, data[at + MESSAGE_HEAD.size : at + length])
        at += length
