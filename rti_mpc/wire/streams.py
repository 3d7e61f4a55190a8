# SPDX-License-Identifier: Apache-2.0
"""
Table of the streams of one robot: key, message, who may publish, quality of service, rate and size.

The bus publishes and subscribes as the table says, the page of messages of the
documentation is made from it, and so are the roles that everybody knows. A test
starts each process and holds what it publishes against `publishers`.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, Literal

from rti_mpc.contract.message import Command, Event, Reference, State, Telemetry
from rti_mpc.wire import document
from rti_mpc.wire.cdr import M
from rti_mpc.wire.layout import MAX_BYTES

ROLES = ("controller", "standby", "guard", "robot", "reference", "viewer", "recorder", "router", "operator", "relay", "echo")  # known to everybody
ROLE = re.compile(r"[a-z][a-z0-9_]{0,31}(\.[0-9]{1,7})?", re.ASCII)  # one of several is numbered, such as standby.17
MAX_UNKNOWN_ROLES = 16  # other roles of which is heard: a name costs nothing

MAX_REQUEST_BYTES = 32_768  # to parse JSON holds the interpreter's lock, for 30 ms a megabyte
RING_BYTES = 1 << 30  # in one ring of a receiver, at most, where peers send nothing but the longest payloads


class Kind(Enum):
    """How a key is used."""

    MESSAGE = "publisher"
    QUERY = "queryable"  # with a JSON object as request and as answer
    TOKEN = "liveliness token"


@dataclass(frozen=True)
class Qos:
    """
    Quality of service.

    Attributes:
        priority: Zenoh's name of it.
        express: Whether it is sent at once, unbatched.
        cached: Whether late joiners get the last message of each publisher.
        congestion: Whether it is dropped where a link is congested, or waits.
    """

    priority: Literal["REAL_TIME", "DATA", "DATA_LOW"] = "DATA"
    express: bool = False
    cached: bool = False
    congestion: Literal["DROP", "BLOCK"] = "DROP"


FAST = Qos("REAL_TIME", express=True)  # before all else on its way
LAST = Qos(cached=True)
LOW = Qos("DATA_LOW")
ASKED = Qos(congestion="BLOCK")
ASKED_FAST = Qos("REAL_TIME", express=True, congestion="BLOCK")


@dataclass(frozen=True)
class Stream(Generic[M]):
    """
    One row of the table.

    Attributes:
        name: Key below ``<prefix>/<robot>/``; without the role that the keys of some end with.
        message: Class of the messages; None: a JSON object, or nothing.
        publishers: Roles that may publish, answer or show presence on it. A controller that stands by is ready to lead: it has both its roles.
        qos: Quality of service; of a query its request's.
        rate: How often, in words.
        about: What it is for, in words.
        kind: How the key is used.
        by_role: Whether the key ends with the role of the publisher, each under its own.
        askers: Roles that may send queries.
    """

    name: str
    message: type[M] | None
    publishers: tuple[str, ...]
    qos: Qos
    rate: str
    about: str
    kind: Kind = Kind.MESSAGE
    by_role: bool = False
    askers: tuple[str, ...] = ()

    @property
    def max_bytes(self) -> int:
        """Largest payload, in bytes."""
        if self.kind is not Kind.MESSAGE:
            return MAX_REQUEST_BYTES if self.kind is Kind.QUERY else 0
        return document.MAX_BYTES if self.message is None else MAX_BYTES[self.message]

    def capacity(self, messages: int) -> int:
        """Return how many messages a ring may hold, of those that a receiver wants, within `RING_BYTES`."""
        return min(messages, RING_BYTES // self.max_bytes)


def _query(name: str, servers: tuple[str, ...], qos: Qos, about: str) -> Stream[Any]:
    return Stream(name, None, servers, qos, "as asked", about, kind=Kind.QUERY, askers=("operator",))


CONTROLLERS = ("controller", "standby")  # one program, which changes its role

STATE = Stream("state", State, ("robot", "relay"), FAST, "as the robot measures, up to 1 kHz", "state of the robot")
REFERENCE = Stream("reference", Reference, ("reference",), LAST, "now and then", "what to follow")
ANCHORED = Stream("reference/anchored", Reference, ("controller",), LAST, "as such come", "a reference that starts on arrival, with its stamp")
COMMAND = Stream("command", Command, ("controller", "relay"), FAST, "each sample", "plan of inputs")
ACTUATION = Stream("actuation", Command, ("guard", "relay"), FAST, "each command", "what the guard lets pass, or its own ramp to rest")
TELEMETRY = Stream("telemetry", Telemetry, ("controller",), LOW, "each sample", "everything of one sample")
SHADOW_TELEMETRY = Stream("telemetry/standby", Telemetry, ("standby",), LOW, "each sample", "the same of a controller that stands by")
EVENT = Stream(
    "event",
    Event,
    (*CONTROLLERS, "guard", "robot", "reference", "viewer"),
    LAST,
    "each mode change, each fault at most once a second",
    "mode changes and faults",
    by_role=True,
)
INFO: Stream[Any] = Stream(
    "info",
    None,
    (*CONTROLLERS, "guard", "robot"),
    LAST,
    "at the start, and as it changes",
    "description in JSON: names, units, limits, versions",
    by_role=True,
)
REQUEST = _query("request", CONTROLLERS, ASKED, "parameters, and failures on request")
STOP = _query("stop", (*CONTROLLERS, "guard"), ASKED_FAST, "an operator's stop and its release; what else is asked for does not delay it")
ALIVE: Stream[Any] = Stream(
    "alive",
    None,
    (*CONTROLLERS, "guard", "robot", "reference", "viewer", "router", "relay", "echo"),
    Qos(),
    "while it lives",
    "presence, for people and fleets; never a safety signal",
    kind=Kind.TOKEN,
    by_role=True,
)
# Of fault injection and of measurements, alone.
RELAY = _query("relay", ("relay",), ASKED, "faults of a link or a sensor")
PING = Stream("echo/ping", State, ("operator",), FAST, "each sample", "of a state's size, to measure the bus")
PONG = Stream("echo/pong", Command, ("echo",), FAST, "each ping", "its answer, of a command's size")

STREAMS: tuple[Stream[Any], ...] = (
    *(STATE, REFERENCE, ANCHORED, COMMAND, ACTUATION, TELEMETRY, SHADOW_TELEMETRY),
    *(EVENT, INFO, REQUEST, STOP, ALIVE, RELAY, PING, PONG),
)


def role_of(key: str) -> str:
    """Return the role that a key of an event, a description or a token ends with; empty if it is no name of one."""
    role = key.rpartition("/")[2]
    return role if ROLE.fullmatch(role) else ""


def admitted(key: str, known: Collection[str]) -> bool:
    """
    Return whether to listen to the role that a key ends with: of any in `ROLES`, and of `MAX_UNKNOWN_ROLES` others.

    Args:
        key: Of an event, a description or a token.
        known: Keys of this stream that were admitted before.
    """
    if key in known or role_of(key) in ROLES:
        return True
    return bool(role_of(key)) and sum(role_of(other) not in ROLES for other in known) < MAX_UNKNOWN_ROLES
