# SPDX-License-Identifier: Apache-2.0
"""
Description of the streams as ROS 2 messages, so that tools of ROS read a recording.

JSON objects are stored as ``std_msgs/msg/String``: readers of ROS 2 recordings stop at
channels of any other encoding.
"""

from __future__ import annotations

from struct import Struct
from typing import Any

from rti_mpc.errors import MessageError
from rti_mpc.wire.cdr import HEADER, MESSAGE_PACKAGE
from rti_mpc.wire.layout import msg_text

PROFILE = "ros2"
SCHEMA_ENCODING = "ros2msg"
MESSAGE_ENCODING = "cdr"
TEXT_SCHEMA = ("std_msgs/msg/String", "string data\n")
LENGTH = Struct("<I")


def ros2_schema(message: type[Any] | None) -> tuple[str, str]:
    """Return name and definition of the ROS 2 message of a stream, by its class of messages; None for JSON."""
    return TEXT_SCHEMA if message is None else (f"{MESSAGE_PACKAGE}/{message.__name__}", msg_text(message))


def topic(key: str) -> str:
    """Return the topic of a key."""
    return f"/{key}"


def write_text(text: bytes) -> bytes:
    """Return the bytes of a ``std_msgs/msg/String`` that holds a text in UTF-8."""
    return HEADER + LENGTH.pack(len(text) + 1) + text + b"\0"


def read_text(payload: bytes) -> bytes:
    """
    Return the text in a ``std_msgs/msg/String``, UTF-8.

    Raises:
        MessageError: The bytes are none.
    """
    begin = len(HEADER) + LENGTH.size
    if payload[: len(HEADER)] != HEADER or len(payload) <= begin or begin + LENGTH.unpack_from(payload, len(HEADER))[0] != len(payload):
        raise MessageError(f"payload must be a {TEXT_SCHEMA[0]}, got {len(payload)} other bytes")
    return payload[begin:-1]
