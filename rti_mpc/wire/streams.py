# SPDX-License-Identifier: Apache-2.0
"""
Table of the streams of one robot: key, message, who may publish, quality of service, rate and size.

The bus publishes and subscribes by this table, and the documentation's page of messages
is generated from it. A test starts each process and compares what it publishes with
`publishers`.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, Literal

from rti_mpc.contract.message import Command, Event, Journal, Reference, State, Telemetry
from rti_mpc.wire import document
from rti_mpc.wire.cdr import M, encoding
from rti_mpc.wire.layout import MAX_PAYLOAD_BYTES

KNOWN_ROLES = ("controller", "standby", "guard", "robot", "reference", "viewer", "recorder", "router", "operator", "relay", "echo")
ROLE_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,31}(\.[0-9]{1,7})?", re.ASCII)  # where several processes share a role they are numbered: standby.17
MAX_UNKNOWN_ROLES = 16  # further roles whose messages are read; limited, since any peer can invent roles

JSON_ENCODING = "application/json"  # of descriptions, requests and answers
MAX_REQUEST_BYTES = 32_768  # parsing JSON holds the interpreter's lock for 30 ms per megabyte
MAX_RING_BYTES = 1 << 30  # size of one receiver's ring filled with the longest payloads


class Kind(Enum):
    """Use of a key."""

    MESSAGE = "publisher"
    QUERY = "queryable"  # with a JSON object as request and as answer
    TOKEN = "liveliness token"


@dataclass(frozen=True)
class Qos:
    """
    Quality of service.

    Attributes:
        priority: Zenoh's name of the priority.
        express: Whether messages are sent at once, without batching.
        cached: Messages of each publisher that those who have missed them receive a second later; late joiners receive the last one. 0: none.
        congestion: Whether messages are dropped or wait where a link is congested.
    """

    priority: Literal["REAL_TIME", "DATA", "DATA_LOW"] = "DATA"
    express: bool = False
    cached: int = 0
    congestion: Literal["DROP", "BLOCK"] = "DROP"


QOS_FAST = Qos("REAL_TIME", express=True)  # overtakes all other messages
QOS_CACHED = Qos(cached=1)
QOS_LOW = Qos("DATA_LOW")
QOS_LOW_CACHED = Qos("DATA_LOW", cached=8)  # about two seconds, more would be memory: low priority is dropped where a link is busy
QOS_QUERY = Qos(congestion="BLOCK")
QOS_FAST_QUERY = Qos("REAL_TIME", express=True, congestion="BLOCK")


@dataclass(frozen=True)
class Stream(Generic[M]):
    """
    One row of the table.

    Attributes:
        name: Key below ``<prefix>/<robot>/``, without the role that some keys end with.
        message: Class of the messages; None for a JSON object, or for no content.
        publishers: Roles that may publish, answer or show presence on it. A standby may become the leader, so it has both roles.
        qos: Quality of service; for a query that of the request.
        rate: Rate of the messages, in words.
        about: Purpose, in words.
        kind: Use of the key.
        by_role: Whether the key ends with the role of the publisher.
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
    def encoding(self) -> str:
        """Encoding of its messages; of a query also that of the answers."""
        return JSON_ENCODING if self.message is None else encoding(self.message)

    @property
    def max_bytes(self) -> int:
        """Largest payload, in bytes."""
        if self.kind is not Kind.MESSAGE:
            return MAX_REQUEST_BYTES if self.kind is Kind.QUERY else 0
        return document.MAX_DOCUMENT_BYTES if self.message is None else MAX_PAYLOAD_BYTES[self.message]

    def capacity(self, messages: int) -> int:
        """Return the number of messages wanted, limited so that the longest ones fit into `MAX_RING_BYTES`."""
        return min(messages, MAX_RING_BYTES // self.max_bytes)


def _query(name: str, servers: tuple[str, ...], qos: Qos, about: str, asker: str = "operator") -> Stream[Any]:
    return Stream(name, None, servers, qos, "on request", about, kind=Kind.QUERY, askers=(asker,))


CONTROLLER_ROLES = ("controller", "standby")  # roles of one process, which changes between them

STATE = Stream("state", State, ("robot", "relay"), QOS_FAST, "once per measurement, up to 1 kHz", "state of the robot")
REFERENCE = Stream("reference", Reference, ("reference",), QOS_CACHED, "whenever the planner has a new one", "reference to follow")
ANCHORED = Stream(
    "reference/anchored",
    Reference,
    ("controller",),
    QOS_CACHED,
    "once per reference with STAMP_ON_ARRIVAL",
    "copy of a reference that starts on arrival, with the stamp of its start",
)
COMMAND = Stream("command", Command, ("controller", "relay"), QOS_FAST, "once per sample", "plan of inputs")
ACTUATION = Stream(
    "actuation", Command, ("guard", "relay"), QOS_FAST, "once per command", "command that the guard has passed, or the guard's own ramp to rest"
)
TELEMETRY = Stream("telemetry", Telemetry, ("controller",), QOS_LOW, "once per sample", "measurements and results of one sample")
SHADOW_TELEMETRY = Stream("telemetry/standby", Telemetry, ("standby",), QOS_LOW, "once per sample", "telemetry of a standby controller")
JOURNAL = Stream(
    "journal",
    Journal,
    CONTROLLER_ROLES,
    QOS_LOW_CACHED,
    "a few times per second",
    "calls that each controller's commands depend on, and snapshots of its state, to repeat them later",
)
EVENT = Stream(
    "event",
    Event,
    (*CONTROLLER_ROLES, "guard", "robot", "reference", "viewer", "recorder"),
    QOS_CACHED,
    "once per mode change; faults of one code at most once per second",
    "mode changes and faults",
    by_role=True,
)
INFO: Stream[Any] = Stream(
    "info",
    None,
    (*CONTROLLER_ROLES, "guard", "robot"),
    QOS_CACHED,
    "at the start, and at every change",
    "description of the publisher in JSON: names, units, limits, versions",
    by_role=True,
)
REQUEST = _query("request", CONTROLLER_ROLES, QOS_QUERY, "reading and changing parameters, injecting failures")
STOP = _query("stop", (*CONTROLLER_ROLES, "guard"), QOS_FAST_QUERY, "an operator's stop and its release, never delayed by other requests")
ORIGIN = _query("origin", CONTROLLER_ROLES, QOS_QUERY, "configuration, model, versions and host of a controller, for recordings", "recorder")
ALIVE: Stream[Any] = Stream(
    "alive",
    None,
    (*CONTROLLER_ROLES, "guard", "robot", "reference", "viewer", "recorder", "router", "relay", "echo"),
    Qos(),
    "as long as the process runs",
    "presence of a process, for people and fleet management; never a safety signal",
    kind=Kind.TOKEN,
    by_role=True,
)
# Streams for fault injection and measurements only.
RELAY = _query("relay", ("relay",), QOS_QUERY, "faults to inject into a link or a sensor")
PING = Stream("echo/ping", State, ("operator",), QOS_FAST, "once per measurement", "message of a state's size, to measure the round trip on the bus")
PONG = Stream("echo/pong", Command, ("echo",), QOS_FAST, "once per ping", "answer to a ping, of a command's size")

STREAMS: tuple[Stream[Any], ...] = (
    *(STATE, REFERENCE, ANCHORED, COMMAND, ACTUATION, TELEMETRY, SHADOW_TELEMETRY),
    *(JOURNAL, EVENT, INFO, REQUEST, STOP, ORIGIN, ALIVE, RELAY, PING, PONG),
)


def role_of(key: str) -> str:
    """Return the role at the end of the key of an event, a description or a token; empty if it does not end with a role."""
    role = key.rpartition("/")[2]
    return role if ROLE_PATTERN.fullmatch(role) else ""


def admitted(key: str, known: Collection[str]) -> bool:
    """
    Return whether to read messages of the role at the end of a key: all of `KNOWN_ROLES`, and up to `MAX_UNKNOWN_ROLES` others.

    Args:
        key: Key of an event, a description or a token.
        known: Keys of this stream that were admitted before.
    """
    if key in known or role_of(key) in KNOWN_ROLES:
        return True
    return bool(role_of(key)) and sum(role_of(other) not in KNOWN_ROLES for other in known) < MAX_UNKNOWN_ROLES
