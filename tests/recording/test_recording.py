# SPDX-License-Identifier: Apache-2.0
"""Recordings are read as they were written, by us and by readers of others, also those whose recorder was killed."""

from __future__ import annotations

import resource
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from rti_mpc.contract.message import State
from rti_mpc.errors import MessageError
from rti_mpc.recording import Recording
from rti_mpc.recording.repair import repair
from rti_mpc.recording.ros2 import read_text, write_text
from rti_mpc.recording.writer import ABOUT, RecordingWriter
from rti_mpc.wire.cdr import encode, encoding
from rti_mpc.wire.keys import Keys
from tests.recording.samples import INFO, KEYS, MS, START_NS, UNIX_OFFSET_NS, state, write

COUNT = 200


def read_by_others(path: Path) -> Counter[str]:
    """Read every message with two readers that are not ours, and return how many there are on each topic."""
    counts: list[Counter[str]] = [Counter(), Counter()]
    with path.open("rb") as file:
        for _, channel, _, message in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            assert hasattr(message, "data") if "/info/" in channel.topic or channel.topic.endswith("/host") else message.seq >= 0
            counts[0][channel.topic] += 1
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)
            counts[1][connection.topic] += 1
    assert counts[0] == counts[1]
    return counts[0]


def test_recording_is_read_as_it_was_written(tmp_path: Path) -> None:
    written = write(tmp_path / "run.mcap", COUNT)
    recording = Recording(tmp_path / "run.mcap")
    assert recording.whole
    assert (recording.robots, recording.start_ns, recording.unix_offset_ns) == (["wheels"], START_NS, UNIX_OFFSET_NS)
    assert recording.attachments == {"wheels/9/config.toml": b"robot = 'wheels'\n"}
    assert [info.message for info in recording.infos()] == [INFO]
    read = [recorded for recorded in recording.messages() if recorded.stream != "info"]
    assert [(recorded.received.key, encode(recorded.message)) for recorded in read] == [(key, encode(message)) for key, message in written]
    assert [recorded.local_ns for recorded in read] == [START_NS + i * MS for i in range(len(written))]
    assert [recorded.role for recorded in read[:3]] == ["", "controller", ""]


def test_recording_is_read_by_tools_of_ros_2(tmp_path: Path) -> None:
    write(tmp_path / "run.mcap", COUNT)
    topics = read_by_others(tmp_path / "run.mcap")
    assert topics["/rti_mpc/wheels/state"] == topics["/rti_mpc/wheels/telemetry"] == COUNT
    assert topics["/rti_mpc/wheels/info/controller"] == topics["/rti_mpc/wheels/event/controller"] == 1


def test_streams_and_robots_are_chosen(tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    folder.mkdir()
    write(folder / "1.mcap", COUNT)
    write(folder / "2.mcap", COUNT, keys=Keys(robot="other"))
    recording = Recording(folder)
    assert recording.robots == ["other", "wheels"]
    assert sum(1 for _ in recording.messages("other", ("state", "command"))) == 2 * COUNT
    assert sum(1 for _ in recording.messages(streams=("state",))) == 2 * COUNT


def test_recording_opens_wherever_its_writer_was_killed(tmp_path: Path) -> None:
    written = write(tmp_path / "run.mcap", COUNT, finish=False)
    content = (tmp_path / "run.mcap").read_bytes()
    rng = np.random.default_rng(2)
    cuts = [*rng.integers(3000, len(content), size=60).tolist(), len(content) - 1, len(content)]
    numbers = []
    for cut in sorted(cuts):
        path = tmp_path / "cut.mcap"
        path.write_bytes(content[:cut])
        recording = Recording(path)
        read = [recorded for recorded in recording.messages() if recorded.stream != "info"]
        assert not recording.whole
        assert len(read) % 50 == 0 or len(read) == len(written), "whole chunks"
        assert [encode(recorded.message) for recorded in read] == [encode(message) for _, message in written[: len(read)]]
        numbers.append(len(read))
    assert numbers == sorted(numbers)
    assert numbers[-1] == len(written) // 50 * 50


def test_damaged_chunk_ends_a_recording(tmp_path: Path) -> None:
    write(tmp_path / "run.mcap", COUNT)
    content = bytearray((tmp_path / "run.mcap").read_bytes())
    content[len(content) // 2] ^= 0xFF
    (tmp_path / "run.mcap").write_bytes(content)
    read = list(Recording(tmp_path / "run.mcap").messages(streams=("state",)))
    assert 50 <= len(read) < COUNT
    assert repair(tmp_path / "run.mcap", tmp_path / "mended.mcap") >= 3 * len(read)
    assert read_by_others(tmp_path / "mended.mcap")["/rti_mpc/wheels/state"] == len(read)


def test_repaired_recording_is_whole_and_read_by_tools_of_ros_2(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write(path, COUNT, finish=False)
    path.write_bytes(path.read_bytes()[:-100])
    before = Recording(path)
    states = [recorded.message.seq for recorded in before.messages(streams=("state",))]
    assert repair(path, path) > 3 * len(states)
    assert [child.name for child in tmp_path.iterdir()] == ["run.mcap"], "nothing is left over"
    after = Recording(path)
    assert after.whole
    assert after.attachments == before.attachments
    assert [recorded.message.seq for recorded in after.messages(streams=("state",))] == states
    assert read_by_others(path)["/rti_mpc/wheels/state"] == len(states)


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """Refuse to write any file beyond a size, in bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_full_disk_loses_nothing_that_was_written(tmp_path: Path) -> None:
    writer, flushed = RecordingWriter(tmp_path / "run.mcap", START_NS, UNIX_OFFSET_NS, "0.0"), 0
    with pytest.raises(OSError, match="too large"), disk_of(20_000):
        for k in range(1, 10_000):
            writer.add("wheels", KEYS.state, START_NS + k, encode(state(k)), k)
            if k % 20 == 0:
                writer.flush()
                flushed = k
    writer.abandon()
    assert flushed > 100
    assert [recorded.message.seq for recorded in Recording(tmp_path / "run.mcap").messages()] == list(range(1, flushed + 1))
    assert repair(tmp_path / "run.mcap", tmp_path / "run.mcap") == flushed


@pytest.mark.parametrize(
    ("content", "said"),
    [(b"", "must be an MCAP file, got an empty one"), (b"\x89MCAP0\r\n", "must be"), (b"\x89PNG\r\n\x1a\n" + bytes(100), "begins with b'.x89PNG")],
)
def test_what_is_no_recording_is_refused(content: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(content)
    with pytest.raises(MessageError, match=rf"run\.mcap .*{said}"):
        Recording(tmp_path / "run.mcap")


def test_messages_of_another_version_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "run.mcap", 1, finish=False)
    writer = RecordingWriter(tmp_path / "other.mcap", START_NS, UNIX_OFFSET_NS, "0.0")
    writer._writer.register_channel("/a", "cdr", 0, {"robot": "a", "stream": "state", "role": "", "key": "a", "encoding": "application/cdr;State@1"})
    writer.add("wheels", KEYS.state, START_NS, encode(state(1)), 1)
    writer.finish({})
    with pytest.raises(MessageError, match=r"State@2, got application/cdr;State@1"):
        Recording(tmp_path / "other.mcap")


def crafted(path: Path, about: dict[str, str] | None = None, **channel: str | None) -> Path:
    """Write a recording of one state and one description, with other words about itself and about the channel of a state; None: left out."""
    told = {"robot": "wheels", "stream": "state", "role": "", "key": "rti_mpc/wheels/state", "encoding": encoding(State)} | channel
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata(ABOUT, {"version": "0", "start_ns": "0", "unix_offset_ns": "0"} if about is None else about)
        number = writer.register_channel("/a", "cdr", 0, {name: text for name, text in told.items() if text is not None})
        writer.add_message(number, START_NS, encode(state(1)), START_NS)
        writer.finish()
    return path


def test_crafted_recording_is_read_if_nothing_is_wrong(tmp_path: Path) -> None:
    assert [recorded.message.seq for recorded in Recording(crafted(tmp_path / "run.mcap")).messages()] == [1]


@pytest.mark.parametrize("robot", ["../../evil", "/tmp/evil", "..", ".", "a/../b", "a//b", "", "a\0b"])
def test_robot_whose_name_would_leave_the_folder_of_an_export_is_refused(robot: str, tmp_path: Path) -> None:
    with pytest.raises(MessageError, match=r"run\.mcap: robot must be a word of letters, digits"):
        Recording(crafted(tmp_path / "run.mcap", robot=robot))


@pytest.mark.parametrize("name", ["robot", "role", "key", "encoding"])
def test_recording_whose_channel_says_too_little_is_refused_by_what_is_missing(name: str, tmp_path: Path) -> None:
    with pytest.raises(MessageError, match=rf"run\.mcap must say the {name} of its channel /a"):
        Recording(crafted(tmp_path / "run.mcap", **{name: None}))


@pytest.mark.parametrize("time", [None, "", "x", "1.5", "٣", "9" * 5000, str(2**62)])
@pytest.mark.parametrize("name", ["start_ns", "unix_offset_ns"])
def test_recording_without_its_times_is_refused(name: str, time: str | None, tmp_path: Path) -> None:
    told = {other: text for other, text in {"start_ns": "0", "unix_offset_ns": "0", name: time}.items() if text is not None}
    with pytest.raises(MessageError, match=rf"run\.mcap must say its {name} as a number of nanoseconds") as refusal:
        Recording(crafted(tmp_path / "run.mcap", told))
    assert len(str(refusal.value)) < 200 + len(str(tmp_path))


@pytest.mark.parametrize("text", ["", "{}", "µ" * 1000])
def test_text_is_kept(text: str) -> None:
    assert read_text(write_text(text.encode())).decode() == text


@pytest.mark.parametrize("payload", [b"", write_text(b"ab")[:-1], write_text(b"ab") + b"\0", b"\0\0\0\0\1\0\0\0\0"])
def test_what_is_no_text_is_refused(payload: bytes) -> None:
    with pytest.raises(MessageError, match="must be a std_msgs/msg/String"):
        read_text(payload)
