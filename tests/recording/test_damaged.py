# SPDX-License-Identifier: Apache-2.0
"""Files whose bytes are cut off or changed at random: what comes of them is read, or refused by an error of ours."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from rti_mpc.errors import MessageError
from rti_mpc.recording import Recording, export
from rti_mpc.recording.repair import repair
from tests.recording.samples import write

COUNT = 24


def damaged(content: bytes, count: int, seed: int) -> Iterator[bytes]:
    """Yield copies that are cut off somewhere, or of which one to three bytes are others."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        copy = bytearray(content)
        if k % 4 == 0:
            yield bytes(copy[: rng.integers(len(copy))])
            continue
        for place in rng.integers(len(copy), size=rng.integers(1, 4)):
            copy[place] = rng.integers(256)
        yield bytes(copy)


def bare(content: bytes) -> bytes:
    """Return a recording without compression and checksums, so that damage comes through to its messages."""
    output, reader = BytesIO(), make_reader(BytesIO(content))
    writer = Writer(output, compression=CompressionType.NONE, enable_crcs=False)
    writer.start()
    for metadata in reader.iter_metadata():
        writer.add_metadata(metadata.name, metadata.metadata)
    channels = dict[str, int]()
    for _, channel, message in reader.iter_messages():
        if channel.topic not in channels:
            channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, 0, channel.metadata)
        writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time, message.sequence)
    writer.finish()
    return output.getvalue()


def test_damaged_recording_is_read_or_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write(path, 2)
    content = bare(path.read_bytes())
    outcomes = Counter[str]()
    for copy in damaged(content, COUNT, seed=15):
        path.write_bytes(copy)
        try:
            repair(path, tmp_path / "repaired.mcap")
            recording = Recording(path)
            read = [recorded.message for recorded in recording.messages()]
            export(recording, tmp_path / "out", horizon=True)
            outcomes["less" if len(read) < 9 else "whole"] += 1
        except MessageError as error:
            assert "\n" not in str(error)
            outcomes["refused"] += 1
    assert len(outcomes) == 3, f"each of the three happens, got {outcomes}"
