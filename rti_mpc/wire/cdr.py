# SPDX-License-Identifier: Apache-2.0
"""
Messages as CDR bytes, and back.

XCDR1, little-endian: four header bytes ``00 01 00 00``, then the fields of the
``.msg`` files in `deploy/msg`, each aligned to its own size counted from the end
of the header. ``float64[]`` is a ``uint32`` length and its elements, aligned to
eight where there are any. A matrix is preceded by its row width.

What a message must satisfy is checked here, at the door: sizes that agree, rows
where rows are needed, finite numbers, known enumeration values. Nothing is
allocated from a declared length before as many bytes are there.
"""

from __future__ import annotations

from collections.abc import Callable
from struct import Struct
from typing import Any, TypeVar

import numpy as np

from rti_mpc.array import Array
from rti_mpc.errors import MessageError
from rti_mpc.message import Command, End, Event, Reference, Severity, State, Telemetry
from rti_mpc.status import Mode, QpStatus

Message = State | Reference | Command | Telemetry | Event
M = TypeVar("M", bound=Message)

PACKAGE = "rti_mpc_msgs/msg"
VERSION = 1  # major: a receiver refuses any other
HEADER = b"\x00\x01\x00\x00"
START = len(HEADER)  # alignment counts from here

STATE = Struct("<4sQQq")
REFERENCE = Struct("<4sQQqqB3x")
COMMAND = Struct("<4sQQqQQqqQBB6xq")
TELEMETRY = Struct("<4sQQqQqBB2xI10d6Q4I")
EVENT = Struct("<4sQQq")
WORD = Struct("<I")
WORD_PADDED = Struct("<I4x")

ENDS = {int(end): end for end in End}
MODES = {int(mode): mode for mode in Mode}
STATUSES = {int(status): status for status in QpStatus}
SEVERITIES = {int(severity): severity for severity in Severity}


def schema(cls: type[Any]) -> str:
    """Schema of a message class, such as ``rti_mpc_msgs/msg/State@1``."""
    return f"{PACKAGE}/{cls.__name__}@{VERSION}"


def encoding(cls: type[Any]) -> str:
    """Encoding that travels with every payload, such as ``application/cdr;rti_mpc_msgs/msg/State@1``."""
    return f"application/cdr;{schema(cls)}"


def encode(message: Message) -> bytes:
    """Bytes of a message."""
    return ENCODERS[type(message)](message)


def decode(cls: type[M], payload: bytes) -> M:
    """
    Message in a payload; its arrays are owned, C-contiguous float64.

    Raises:
        MessageError: If the bytes are not exactly one such message; `reason` is one of `REASONS`.
    """
    if payload[:START] != HEADER:
        raise _header_error(payload)
    message: M = DECODERS[cls](payload)
    return message


class Refused(MessageError):
    """
    A payload is not the message expected.

    Attributes:
        reason: One of `REASONS`, for counters.
    """

    def __init__(self, reason: str, text: str) -> None:
        self.reason = reason
        super().__init__(text)


REASONS = ("empty", "truncated", "oversized", "big_endian", "header", "length", "not_finite", "value", "text", "encoding", "version", "schema")


def _header_error(payload: bytes) -> Refused:
    got = payload[:START].hex(" ")
    if not payload:
        return Refused("empty", "payload must hold a CDR message, got no bytes")
    if len(payload) < START:
        return Refused("truncated", f"payload must begin with the CDR header {HEADER.hex(' ')}, got {got}")
    if payload[:2] == b"\x00\x00":
        return Refused("big_endian", f"payload must be little-endian CDR, header {HEADER.hex(' ')}, got the big-endian header {got}")
    return Refused("header", f"payload must begin with the CDR header {HEADER.hex(' ')}, got {got}")


def _unpack(layout: Struct, payload: bytes) -> tuple[Any, ...]:
    if len(payload) < layout.size:
        raise Refused("truncated", f"message must hold at least {layout.size} bytes, got {len(payload)}")
    return layout.unpack_from(payload)


def _word(payload: bytes, offset: int, name: str) -> int:
    if len(payload) < offset + 4:
        raise Refused("truncated", f"{name} must begin at byte {offset}, got {len(payload)} bytes")
    value: int = WORD.unpack_from(payload, offset)[0]
    return value


def _vector(payload: bytes, offset: int, name: str) -> tuple[Array, int]:
    """Elements of a ``float64[]`` that begins at `offset`, and the offset after it."""
    size = _word(payload, offset, name)
    offset += 4
    if size:
        offset += (START - offset) % 8
    end = offset + 8 * size
    if end > len(payload):
        raise Refused("truncated", f"{name} must hold the {size} numbers it declares, got {max(0, len(payload) - offset) // 8}")
    return np.frombuffer(payload, "<f8", size, offset).astype(np.float64), end


def _rows(flat: Array, width: int, name: str) -> Array:
    if flat.size % width if width else flat.size:
        raise Refused("length", f"{name} must hold whole rows of {width} numbers, got {flat.size}")
    return flat.reshape(flat.size // width if width else 0, width)


def _finite(array: Array, name: str) -> Array:
    finite = np.isfinite(array)
    if not finite.all():
        raise Refused("not_finite", f"{name} must be finite, got {array[~finite][0]} among {array.size} numbers")
    return array


def _filled(array: Array, name: str) -> Array:
    if not array.size:
        raise Refused("length", f"{name} must hold at least one row, got none")
    return array


def _member(values: dict[int, Any], value: int, name: str) -> Any:
    try:
        return values[value]
    except KeyError:
        raise Refused("value", f"{name} must be one of {sorted(values)}, got {value}") from None


def _positive(value: int, name: str) -> int:
    if value < 1:
        raise Refused("value", f"{name} must be positive, got {value}")
    return value


def _finish(payload: bytes, end: int) -> None:
    if len(payload) != end:
        raise Refused("oversized", f"message must end after {end} bytes, got {len(payload)}")


def _pack_vector(offset: int, array: Array) -> bytes:
    size = array.size
    length = (WORD_PADDED if size and offset % 8 == 0 else WORD).pack(size)
    return length + array.astype("<f8", copy=False).tobytes()


def _encode_state(message: State) -> bytes:
    head = STATE.pack(HEADER, message.epoch, message.seq, message.stamp_ns)
    return head + _pack_vector(STATE.size - START, message.x)


def _decode_state(payload: bytes) -> State:
    _, epoch, seq, stamp_ns = _unpack(STATE, payload)
    x, end = _vector(payload, STATE.size, "x")
    _finish(payload, end)
    return State(epoch, seq, stamp_ns, _finite(_filled(x, "x"), "x"))


def _encode_reference(message: Reference) -> bytes:
    m = message
    head = REFERENCE.pack(HEADER, m.epoch, m.seq, m.stamp_ns, m.period_ns, m.end) + WORD.pack(m.y.shape[1])
    y = _pack_vector(len(head) - START, m.y)
    width = WORD.pack(m.p.shape[1])
    return head + y + width + _pack_vector(len(head) + len(y) + 4 - START, m.p)


def _decode_reference(payload: bytes) -> Reference:
    _, epoch, seq, stamp_ns, period_ns, end_code = _unpack(REFERENCE, payload)
    ny = _word(payload, REFERENCE.size, "ny")
    flat, end = _vector(payload, REFERENCE.size + 4, "y")
    y = _finite(_filled(_rows(flat, ny, "y"), "y"), "y")
    width = _word(payload, end, "np")
    p, end = _vector(payload, end + 4, "p")
    _finish(payload, end)
    if p.size != len(y) * width:
        raise Refused("length", f"p must hold {len(y)} rows of {width} numbers, as many as y, got {p.size}")
    p = _finite(p.reshape(len(y), width), "p")
    return Reference(epoch, seq, stamp_ns, _positive(period_ns, "period_ns"), _member(ENDS, end_code, "end"), y, p)


def _encode_command(message: Command) -> bytes:
    m = message
    head = COMMAND.pack(
        HEADER,
        m.epoch,
        m.seq,
        m.stamp_ns,
        m.state_epoch,
        m.state_seq,
        m.state_stamp_ns,
        m.valid_until_ns,
        m.config_hash,
        m.mode,
        m.status,
        m.period_ns,
    )
    return head + WORD.pack(m.u.shape[1]) + _pack_vector(COMMAND.size + 4 - START, m.u)


def _decode_command(payload: bytes) -> Command:
    _, *values, mode, status, period_ns = _unpack(COMMAND, payload)
    nu = _word(payload, COMMAND.size, "nu")
    flat, end = _vector(payload, COMMAND.size + 4, "u")
    _finish(payload, end)
    u = _finite(_filled(_rows(flat, nu, "u"), "u"), "u")
    values += _member(MODES, mode, "mode"), _member(STATUSES, status, "status"), _positive(period_ns, "period_ns"), u
    return Command(*values)


def _encode_telemetry(message: Telemetry) -> bytes:
    m = message
    parts = [
        TELEMETRY.pack(
            HEADER,
            m.epoch,
            m.seq,
            m.stamp_ns,
            m.state_seq,
            m.state_stamp_ns,
            m.mode,
            m.status,
            m.iterations,
            m.res_prim,
            m.res_dual,
            m.cost,
            m.violation,
            m.prepare_us,
            m.feedback_us,
            m.latency_us,
            m.state_age_s,
            m.slack_s,
            m.delay_s,
            m.skipped,
            m.fallbacks,
            m.softened,
            m.shifted,
            m.braked,
            m.rested,
            m.parameter_version,
            m.x.shape[1],
            m.u.shape[1],
            m.y_ref.shape[1],
        )
    ]
    offset = TELEMETRY.size - START
    for array in (m.x0, m.x, m.u, m.y_ref, m.d):
        parts.append(_pack_vector(offset, array))
        offset += len(parts[-1])
    return b"".join(parts)


def _decode_telemetry(payload: bytes) -> Telemetry:
    _, *values, nx, nu, ny = _unpack(TELEMETRY, payload)
    x0, end = _vector(payload, TELEMETRY.size, "x0")
    x, end = _vector(payload, end, "x")
    u, end = _vector(payload, end, "u")
    y_ref, end = _vector(payload, end, "y_ref")
    d, end = _vector(payload, end, "d")
    _finish(payload, end)
    if x0.size not in (0, nx):
        raise Refused("length", f"x0 must hold {nx} numbers, got {x0.size}")
    values[5:7] = _member(MODES, values[5], "mode"), _member(STATUSES, values[6], "status")
    *values, delay_s, skipped, fallbacks, softened, shifted, braked, rested, version = values
    values += skipped, fallbacks, version, x0, _rows(x, nx, "x"), _rows(u, nu, "u"), _rows(y_ref, ny, "y_ref"), d
    values += delay_s, softened, shifted, braked, rested
    return Telemetry(*values)


def _pack_string(offset: int, text: str) -> bytes:
    encoded = text.encode("utf-8", "replace") + b"\x00"
    return bytes(-offset % 4) + WORD.pack(len(encoded)) + encoded


def _string(payload: bytes, offset: int, name: str) -> tuple[str, int]:
    offset += -offset % 4
    size = _word(payload, offset, name)
    end = offset + 4 + size
    if end > len(payload):
        raise Refused("truncated", f"{name} must hold the {size} bytes it declares, got {len(payload) - offset - 4}")
    encoded = payload[offset + 4 : end]
    if encoded[-1:] != b"\x00":
        raise Refused("text", f"{name} must end with a zero byte")
    try:
        return encoded[:-1].decode("utf-8"), end
    except UnicodeDecodeError as error:
        raise Refused("text", f"{name} must be UTF-8, got {error.reason} at byte {error.start}") from None


def _encode_event(message: Event) -> bytes:
    payload = EVENT.pack(HEADER, message.epoch, message.seq, message.stamp_ns)
    payload += _pack_string(len(payload), message.source)
    payload += bytes((message.severity,))
    payload += _pack_string(len(payload), message.code)
    return payload + _pack_string(len(payload), message.text)


def _decode_event(payload: bytes) -> Event:
    _, epoch, seq, stamp_ns = _unpack(EVENT, payload)
    source, end = _string(payload, EVENT.size, "source")
    if len(payload) <= end:
        raise Refused("truncated", f"severity must be at byte {end}, got {len(payload)} bytes")
    severity = _member(SEVERITIES, payload[end], "severity")
    code, end = _string(payload, end + 1, "code")
    text, end = _string(payload, end, "text")
    _finish(payload, end)
    return Event(epoch, seq, stamp_ns, source, severity, code, text)


ENCODERS: dict[type[Any], Callable[[Any], bytes]] = {
    State: _encode_state,
    Reference: _encode_reference,
    Command: _encode_command,
    Telemetry: _encode_telemetry,
    Event: _encode_event,
}
DECODERS: dict[type[Any], Callable[[bytes], Any]] = {
    State: _decode_state,
    Reference: _decode_reference,
    Command: _decode_command,
    Telemetry: _decode_telemetry,
    Event: _decode_event,
}
