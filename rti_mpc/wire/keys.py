# SPDX-License-Identifier: Apache-2.0
"""Where each stream lives: ``<prefix>/<robot>/<stream>``."""

from __future__ import annotations

from dataclasses import dataclass

from rti_mpc.errors import ConfigError

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
    def lives(self) -> str:
        """All liveliness tokens, for watchers."""
        return self.alive("*")

    def alive(self, role: str) -> str:
        """Liveliness token of one role."""
        return self.stream(f"alive/{role}")
