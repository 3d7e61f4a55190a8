# SPDX-License-Identifier: Apache-2.0
"""Where each stream lives: ``<prefix>/<robot>/<stream>``."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass

from rti_mpc.errors import ConfigError
from rti_mpc.message import Command, Event, Reference, State, Telemetry
from rti_mpc.wire import document
from rti_mpc.wire.layout import MOST_BYTES

ROLES = ("controller", "standby", "guard", "robot", "reference", "viewer", "recorder", "router", "operator", "relay")  # known to everybody
STRANGERS = 16  # other roles of which is heard: a name costs nothing
ROLE = re.compile(r"[a-z][a-z0-9_]{0,31}(\.[0-9]{1,7})?", re.ASCII)  # one of several is numbered, such as standby.17

# Longest payload of a stream, by its first word, in bytes; of others as much as of a command.
LONGEST: dict[str, int] = {
    "state": MOST_BYTES[State],
    "reference": MOST_BYTES[Reference],
    "command": MOST_BYTES[Command],
    "actuation": MOST_BYTES[Command],
    "telemetry": MOST_BYTES[Telemetry],
    "event": MOST_BYTES[Event],
    "info": document.MOST_BYTES,
}

RESERVED = set("*$?#")  # wildcards and selectors of Zenoh


@dataclass(frozen=True, slots=True)
class Keys:
    """
    Keys of one robot.

    Attributes:
        prefix: Common prefix, one or more chunks.
        robot: Name of the robot, one or more chunks.
    """

    prefix: str = "rti_mpc"
    robot: str = "pioneer"

    def __post_init__(self) -> None:
        for name in ("prefix", "robot"):
            value = getattr(self, name)
            if not all(value.split("/")) or value.startswith("@") or RESERVED & set(value):
                raise ConfigError(f"{name} must be words joined by single slashes, without any of * $ ? # or a leading @, got {value!r}")

    def stream(self, name: str) -> str:
        """Key of a stream by its name."""
        return f"{self.prefix}/{self.robot}/{name}"

    @property
    def state(self) -> str:
        """`State`, by the robot."""
        return self.stream("state")

    @property
    def reference(self) -> str:
        """`Reference`, by a planner."""
        return self.stream("reference")

    @property
    def anchored(self) -> str:
        """`Reference` with its real stamp, by the controller, for one that came to start on arrival."""
        return self.stream("reference/anchored")

    @property
    def command(self) -> str:
        """`Command`, by the controller."""
        return self.stream("command")

    @property
    def actuation(self) -> str:
        """`Command`, by the guard."""
        return self.stream("actuation")

    @property
    def telemetry(self) -> str:
        """`Telemetry`, by the controller."""
        return self.stream("telemetry")

    @property
    def shadow_telemetry(self) -> str:
        """`Telemetry`, by a controller that stands by."""
        return self.stream("telemetry/standby")

    @property
    def events(self) -> str:
        """All events, for subscribers."""
        return self.event("*")

    def event(self, role: str) -> str:
        """`Event`, by one role."""
        return self.stream(f"event/{role}")

    @property
    def infos(self) -> str:
        """All descriptions, for subscribers."""
        return self.info("*")

    def info(self, role: str) -> str:
        """JSON: names, units, limits, versions, by one role."""
        return self.stream(f"info/{role}")

    @property
    def request(self) -> str:
        """Queryable of the controller, JSON."""
        return self.stream("request")

    @property
    def stop(self) -> str:
        """Queryable of controllers and guards for an operator's stop and its release, JSON; what else is asked for does not delay it."""
        return self.stream("stop")

    @property
    def lives(self) -> str:
        """All liveliness tokens, for watchers."""
        return self.alive("*")

    def alive(self, role: str) -> str:
        """Liveliness token of one role."""
        return self.stream(f"alive/{role}")


def role_of(key: str) -> str:
    """Return the role that a key of an event, a description or a token ends with; empty if it is no name of one."""
    role = key.rpartition("/")[2]
    return role if ROLE.fullmatch(role) else ""


def admitted(key: str, known: Collection[str]) -> bool:
    """
    Return whether to listen to the role that a key ends with: of any in `ROLES`, and of `STRANGERS` others.

    Args:
        key: Of an event, a description or a token.
        known: Keys of this stream that were admitted before.
    """
    if key in known or role_of(key) in ROLES:
        return True
    return bool(role_of(key)) and sum(role_of(other) not in ROLES for other in known) < STRANGERS


def most_bytes(key: str) -> int:
    """Return how many bytes a payload on a key may have; its wildcards may stand for roles."""
    return next((LONGEST[word] for word in reversed(key.split("/")) if word in LONGEST), MOST_BYTES[Command])
