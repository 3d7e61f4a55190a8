# SPDX-License-Identifier: Apache-2.0
"""Keys of the streams: ``<prefix>/<robot>/<stream>``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Generic

from rti_mpc.contract.message import Command, Event, Journal, Reference, State, Telemetry
from rti_mpc.errors import ConfigError
from rti_mpc.wire import streams
from rti_mpc.wire.cdr import M
from rti_mpc.wire.streams import Stream

# No wildcards and selectors of Zenoh's; and no . at the beginning, since recordings are exported into a folder by the robot's name.
WORD = r"[A-Za-z0-9_-][A-Za-z0-9_.-]*"
PATTERNS = {"robot": rf"^{WORD}$", "prefix": rf"^{WORD}(/{WORD})*$"}
NAMES = {
    "robot": "a word of letters, digits, _ . -, without a . at its beginning",
    "prefix": "words of letters, digits, _ . -, without a . at their beginning, joined by single slashes",
}


class Key(str, Generic[M]):
    """
    Key of a stream, as Zenoh takes it; may hold wildcards.

    Attributes:
        stream: Row of the table in `rti_mpc.wire.streams`.
    """

    stream: Stream[M]

    def __new__(cls, text: str, stream: Stream[M]) -> Key[M]:
        """Make a key from its text and its stream."""
        key = super().__new__(cls, text)
        key.stream = stream
        return key


@dataclass(frozen=True, slots=True)
class Keys:
    """
    Keys of one robot.

    Attributes:
        prefix: Common prefix, one or more words, see `NAMES`.
        robot: Name of the robot, a word.

    Raises:
        ConfigError: One of them is none.
    """

    prefix: str = "rti_mpc"
    robot: str = "pioneer"

    def __post_init__(self) -> None:
        for name, pattern in PATTERNS.items():
            value = getattr(self, name)
            if not isinstance(value, str) or not re.fullmatch(pattern, value):
                raise ConfigError(f"{name} must be {NAMES[name]}, got {value!r}")

    def below(self, name: str) -> str:
        """Return the key of any name below this robot, such as ``"**"``."""
        return f"{self.prefix}/{self.robot}/{name}"

    def of(self, stream: Stream[M], role: str = "") -> Key[M]:
        """Return the key of a stream; for a stream by role, with the role or a wildcard."""
        return Key(self.below(f"{stream.name}/{role}" if stream.by_role else stream.name), stream)

    @property
    def state(self) -> Key[State]:
        """`State`, by the robot."""
        return self.of(streams.STATE)

    @property
    def reference(self) -> Key[Reference]:
        """`Reference`, by a planner."""
        return self.of(streams.REFERENCE)

    @property
    def anchored(self) -> Key[Reference]:
        """`Reference` with its real stamp, by the controller, for one that starts on arrival."""
        return self.of(streams.ANCHORED)

    @property
    def command(self) -> Key[Command]:
        """`Command`, by the controller."""
        return self.of(streams.COMMAND)

    @property
    def actuation(self) -> Key[Command]:
        """`Command`, by the guard."""
        return self.of(streams.ACTUATION)

    @property
    def telemetry(self) -> Key[Telemetry]:
        """`Telemetry`, by the controller."""
        return self.of(streams.TELEMETRY)

    @property
    def standby_telemetry(self) -> Key[Telemetry]:
        """`Telemetry`, by a standby."""
        return self.of(streams.SHADOW_TELEMETRY)

    @property
    def journal(self) -> Key[Journal]:
        """`Journal`, by each controller, whatever its role."""
        return self.of(streams.JOURNAL)

    @property
    def request(self) -> Key[Any]:
        """Queryable of the controller, JSON."""
        return self.of(streams.REQUEST)

    @property
    def stop(self) -> Key[Any]:
        """Queryable of controllers and guards for an operator's stop and its release, JSON."""
        return self.of(streams.STOP)

    @property
    def origin(self) -> Key[Any]:
        """Queryable of controllers for the files that a recording keeps of them, JSON."""
        return self.of(streams.ORIGIN)

    @property
    def events(self) -> Key[Event]:
        """All events, for subscribers."""
        return self.event("*")

    def event(self, role: str) -> Key[Event]:
        """`Event`, by one role."""
        return self.of(streams.EVENT, role)

    @property
    def infos(self) -> Key[Any]:
        """All descriptions, for subscribers."""
        return self.info("*")

    def info(self, role: str) -> Key[Any]:
        """JSON: names, units, limits, versions, by one role."""
        return self.of(streams.INFO, role)

    @property
    def lives(self) -> Key[Any]:
        """All liveliness tokens, for watchers."""
        return self.alive("*")

    def alive(self, role: str) -> Key[Any]:
        """Liveliness token of one role."""
        return self.of(streams.ALIVE, role)
