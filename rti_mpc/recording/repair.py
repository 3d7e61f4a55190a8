# SPDX-License-Identifier: Apache-2.0
"""Repair of a recording: a copy of what is whole, with the summary that other readers need."""

from __future__ import annotations

from pathlib import Path

from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer

from rti_mpc.recording.mcap_file import DAMAGES, McapFile
from rti_mpc.recording.ros2 import PROFILE
from rti_mpc.whole_file import replaced


def repair(path: Path, to: Path) -> int:
    """
    Copy a recording up to its first part that is not whole, and return the number of its messages.

    Args:
        path: File of a recorder that was killed, or whose disk was full.
        to: File of the copy, overwritten; may be the same.

    Raises:
        MessageError: It is no MCAP file.
        OSError: It cannot be read, or the copy not be written.
    """
    schemas, channels, count = {0: 0}, dict[int, int](), 0
    with replaced(to) as output:
        writer = Writer(output, compression=CompressionType.ZSTD)
        writer.start(PROFILE, "rti-mpc, repaired")
        for record in McapFile(path).records():
            if isinstance(record, Attachment):
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
            elif isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, Chunk):
                try:
                    for content in breakup_chunk(record, validate_crc=True):
                        if isinstance(content, Schema):
                            schemas[content.id] = writer.register_schema(content.name, content.encoding, content.data)
                        elif isinstance(content, Channel):
                            channel = (content.topic, content.message_encoding, schemas[content.schema_id], content.metadata)
                            channels[content.id] = writer.register_channel(*channel)
                        elif isinstance(content, Message):
                            to_channel = channels[content.channel_id]
                            writer.add_message(to_channel, content.log_time, content.data, content.publish_time, content.sequence)
                            count += 1
                except (*DAMAGES, KeyError):  # the last one: of a channel that is not there
                    break
        writer.finish()
    return count
