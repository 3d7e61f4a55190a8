# SPDX-License-Identifier: Apache-2.0
"""Reader of recordings, also of those whose recorder was killed."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Metadata

from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.recording.host import HOST
from rti_mpc.recording.mcap_file import McapFile
from rti_mpc.recording.ros2 import read_text
from rti_mpc.recording.writer import ABOUT, OUTCOME
from rti_mpc.wire import document
from rti_mpc.wire.cdr import decode
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.layout import STAMP_LIMIT_NS
from rti_mpc.wire.received import Received
from rti_mpc.wire.streams import JSON_ENCODING, STREAMS, Kind, Stream

STREAM_OF_NAME: dict[str, Stream[Any]] = {stream.name: stream for stream in (*STREAMS, HOST) if stream.kind is Kind.MESSAGE}
TIME = re.compile(r"-?[0-9]{1,19}")
NAMED = {"robot", "role", "key", "encoding"}  # what each channel says of itself, besides its stream


@dataclass(frozen=True, slots=True)
class Recorded:
    """
    A message of a recording.

    Attributes:
        robot: Name of its robot.
        stream: Name of its stream, as in `rti_mpc.wire.streams`.
        role: Role of its publisher, for streams whose keys end with it; else empty.
        local_ns: Monotonic time of the recorder's host at its arrival.
        received: Payload, encoding and key as they came.
    """

    robot: str
    stream: str
    role: str
    local_ns: int
    received: Received

    @property
    def message(self) -> Any:
        """
        The message, decoded at every access: one of `rti_mpc.contract.message`, or a dict for JSON.

        Raises:
            MessageError: The bytes are none.
        """
        cls = STREAM_OF_NAME[self.stream].message
        return document.read(self.received.payload) if cls is None else decode(cls, self.received.payload)


class Recording:
    """
    A recording: one file, or a folder of the segments that a recorder with a limit has kept.

    Attributes:
        files: Its files, oldest first.
        robots: Names of its robots, sorted.
        attachments: Content of each attachment by name, ``<robot>/<owner>/<file>``: `owner` are the low bits of the epochs of a controller,
            see `rti_mpc.contract.epoch`.
        whole: Whether all of its files were finished; a recorder that was killed or a full disk leaves one that was not.
        start_ns: Local monotonic time at which the first file was begun.
        unix_offset_ns: Unix time minus local monotonic time.
        outcome: What the recorder counted, as it wrote it at the end; empty if it could not.
    """

    def __init__(self, path: Path | str) -> None:
        """
        Open a recording.

        Raises:
            MessageError: It is no recording of this package, or its messages are of another version.
            OSError: It cannot be read.
        """
        path = Path(path)
        self.files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        self.attachments: dict[str, bytes] = {}
        self.outcome: dict[str, str] = {}
        self.whole = True
        self.start_ns = self.unix_offset_ns = 0
        self._channels: dict[Path, dict[int, tuple[Channel, Stream[Any]]]] = {}
        abouts: list[dict[str, str]] = []
        for file in self.files:
            self._open(file, abouts)
        if not abouts:
            raise MessageError(f"{path} must be a recording of rti-mpc, or a folder of its segments, got none")
        self.unix_offset_ns, self.start_ns = (time_of(path, abouts[0], name) for name in ("unix_offset_ns", "start_ns"))
        self.robots = sorted({channel.metadata["robot"] for channels in self._channels.values() for channel, _ in channels.values()})

    def _open(self, path: Path, abouts: list[dict[str, str]]) -> None:
        """Read all but the messages of a file."""
        file, channels = McapFile(path), self._channels.setdefault(path, {})
        for content in file.contents():
            if isinstance(content, Attachment):
                self.attachments[content.name] = content.data
            elif isinstance(content, Metadata):
                if content.name == ABOUT:
                    abouts.append(content.metadata)
                elif content.name == OUTCOME:
                    self.outcome = content.metadata
            elif isinstance(content, Channel) and (stream := STREAM_OF_NAME.get(content.metadata.get("stream", ""))) is not None:
                if missing := NAMED - content.metadata.keys():
                    raise MessageError(f"{path} must say the {' and '.join(sorted(missing))} of its channel {content.topic}, got none")
                if (got := content.metadata["encoding"]) != stream.encoding:
                    raise MessageError(f"{path} must hold messages of encoding {stream.encoding}, got {got}")
                try:
                    Keys(robot=content.metadata["robot"])  # which becomes the name of a folder
                except ConfigError as error:
                    raise MessageError(f"{path}: {error}") from error
                channels[content.id] = content, stream
        self.whole &= file.whole

    @property
    def streams(self) -> dict[str, list[str]]:
        """Names of the streams of each robot that have messages, sorted."""
        found: dict[str, set[str]] = {robot: set() for robot in self.robots}
        for channels in self._channels.values():
            for channel, stream in channels.values():
                found[channel.metadata["robot"]].add(stream.name)
        return {robot: sorted(names) for robot, names in found.items()}

    def messages(self, robot: str | None = None, streams: Collection[str] | None = None) -> Iterator[Recorded]:
        """
        Yield messages in the order in which they were recorded: by arrival, within milliseconds.

        Args:
            robot: Name of a robot; None: of all.
            streams: Names of streams; None: all.
        """
        for path, known in self._channels.items():
            channels = {
                number: channel
                for number, (channel, stream) in known.items()
                if robot in (None, channel.metadata["robot"]) and (streams is None or stream.name in streams)
            }
            for stored in McapFile(path).messages(channels):
                about = channels[stored.channel_id].metadata
                payload = read_text(stored.payload) if about["encoding"] == JSON_ENCODING else stored.payload
                received = Received(payload, about["encoding"], about["key"])
                yield Recorded(about["robot"], about["stream"], about["role"], stored.time_ns - self.unix_offset_ns, received)

    def infos(self, robot: str | None = None) -> list[Recorded]:
        """Return all descriptions that robots, controllers and guards have published, oldest first; each message is a dict."""
        return list(self.messages(robot, ("info",)))


def time_of(path: Path, about: Mapping[str, str], name: str) -> int:
    """
    Return a time that a recording says of itself, ns.

    Raises:
        MessageError: It does not, or it is no time.
    """
    text = about.get(name, "none")
    if not TIME.fullmatch(text) or abs(int(text)) >= STAMP_LIMIT_NS:
        raise MessageError(f"{path} must say its {name} as a number of nanoseconds below 2^62, got {text[:30]!r}")
    return int(text)
