# SPDX-License-Identifier: Apache-2.0
"""
Codec between messages and CDR bytes, by the field table in `rti_mpc.wire.layout`.

XCDR1, little-endian: four header bytes ``00 01 00 00``, then the fields, each
aligned to its own size counted from the end of the header. ``float64[]`` is a
``uint32`` length and its elements, aligned to eight where there are any.

Decoding checks all that a message must satisfy: sizes that agree, rows where rows are
needed, finite numbers, integers in range, known enumeration values. No memory is
allocated for a declared length before that many bytes are there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby
from math import inf
from operator import attrgetter
from struct import Struct
from typing import Any, TypeVar

import numpy as np

from rti_mpc.array import Array, bounded
from rti_mpc.contract.message import Command, Event, Journal, Reference, State, Telemetry
from rti_mpc.errors import MessageError
from rti_mpc.wire.layout import LAYOUTS, MIN_PERIOD_NS, NUMBER_LIMIT, Field

Message = State | Reference | Command | Telemetry | Journal | Event
M = TypeVar("M", bound=Message)

MESSAGE_PACKAGE = "rti_mpc_msgs/msg"
MESSAGE_VERSION = 2  # a receiver refuses messages of any other version
MAX_QUOTED_CHARS = 40  # of a text that an error quotes
HEADER = b"\x00\x01\x00\x00"
HEADER_BYTES = len(HEADER)  # alignment is counted from the end of the header

STRUCT_FORMATS = {"uint8": "B", "uint32": "I", "uint64": "Q", "int64": "q", "float64": "d"}  # key: type of a scalar in .msg files
LITTLE_ENDIAN = np.dtype("<f8")
FLOAT64 = np.dtype(np.float64)
UINT32 = Struct("<I")

# Both continue at an offset from the end of the header. A writer returns the bytes of its fields; a reader appends their
# values to a list and returns the offset after them.
Writer = Callable[[Any, int], bytes]
Reader = Callable[[bytes, int, list[Any]], int]


class Refused(MessageError):
    """
    A payload that is not the expected message.

    Attributes:
        reason: One of `REFUSAL_REASONS`, for counters.
    """

    def __init__(self, reason: str, text: str) -> None:
        self.reason = reason
        super().__init__(text)


REFUSAL_REASONS = (
    *("empty", "truncated", "oversized", "big_endian", "header", "length", "not_finite", "value", "text"),
    *("encoding", "version", "schema", "epoch"),
)


def schema(cls: type[Any]) -> str:
    """Schema of a message class, such as ``rti_mpc_msgs/msg/State@2``."""
    return f"{MESSAGE_PACKAGE}/{cls.__name__}@{MESSAGE_VERSION}"


def encoding(cls: type[Any]) -> str:
    """Encoding that travels with every payload, such as ``application/cdr;rti_mpc_msgs/msg/State@2``."""
    return f"application/cdr;{schema(cls)}"


def encode(message: Message) -> bytes:
    """Bytes of a message."""
    parts, offset = [HEADER], 0
    for write in WRITERS[type(message)]:
        part = write(message, offset)
        parts.append(part)
        offset += len(part)
    return b"".join(parts)


def decode(cls: type[M], payload: bytes) -> M:
    """
    Message in a payload; its arrays are owned, C-contiguous float64.

    Raises:
        Refused: The bytes are not exactly one such message; `reason` is one of `REFUSAL_REASONS`.
    """
    if payload[:HEADER_BYTES] != HEADER:
        raise _header_error(payload)
    values: list[Any] = []
    offset = 0
    for read in READERS[cls]:
        offset = read(payload, offset, values)
    if len(payload) != HEADER_BYTES + offset:
        raise Refused("oversized", f"message must end after {HEADER_BYTES + offset} bytes, got {len(payload)}")
    message: M = cls(*values)
    if (check := FIELD_RELATIONS.get(cls)) is not None:
        check(message)
    return message


def _header_error(payload: bytes) -> Refused:
    got = payload[:HEADER_BYTES].hex(" ")
    if not payload:
        return Refused("empty", "payload must hold a CDR message, got no bytes")
    if len(payload) < HEADER_BYTES:
        return Refused("truncated", f"payload must begin with the CDR header {HEADER.hex(' ')}, got {got}")
    if payload[:2] == b"\x00\x00":
        return Refused("big_endian", f"payload must be little-endian CDR, header {HEADER.hex(' ')}, got the big-endian header {got}")
    return Refused("header", f"payload must begin with the CDR header {HEADER.hex(' ')}, got {got}")


# Scalars: one call for each run of them.


def _layouts(fields: Sequence[Field]) -> tuple[Struct, ...]:
    """Layouts of a run of scalars, one for each offset modulo 8 at which it may begin."""
    layouts = []
    for start in range(8):
        text, offset = "<", start
        for field in fields:
            size = Struct("<" + STRUCT_FORMATS[field.kind]).size
            text += f"{-offset % size}x{STRUCT_FORMATS[field.kind]}"
            offset += -offset % size + size
        layouts.append(Struct(text))
    return tuple(layouts)


def _scalar_writer(fields: Sequence[Field]) -> Writer:
    layouts = _layouts(fields)
    if len(fields) == 1:
        name = fields[0].name
        return lambda message, offset: layouts[offset % 8].pack(getattr(message, name))
    values = attrgetter(*(field.name for field in fields))
    return lambda message, offset: layouts[offset % 8].pack(*values(message))


def _scalar_reader(fields: Sequence[Field]) -> Reader:
    layouts = _layouts(fields)
    members = [(i, field.name, {int(member): member for member in enum}) for i, field in enumerate(fields) if (enum := field.member_of) is not None]
    ranges = [
        (i, -inf if field.low is None else field.low, inf if field.high is None else field.high, field)
        for i, field in enumerate(fields)
        if field.low is not None or field.high is not None
    ]

    def read(payload: bytes, offset: int, values: list[Any]) -> int:
        layout = layouts[offset % 8]
        end = offset + layout.size
        if len(payload) < HEADER_BYTES + end:
            raise Refused("truncated", f"message must hold at least {HEADER_BYTES + end} bytes, got {len(payload)}")
        first = len(values)
        values += layout.unpack_from(payload, HEADER_BYTES + offset)
        for i, name, known in members:
            value = values[first + i]
            if value not in known:
                raise Refused("value", f"{name} must be one of {sorted(known)}, got {value}")
            values[first + i] = known[value]
        for i, low, high, field in ranges:
            if not low <= (value := values[first + i]) <= high and value != field.also:
                raise Refused("value", f"{field.name} must be from {field.low} to {field.high}, got {value}")
        return end

    return read


# Arrays.


def _heads(words: int, *, filled: bool) -> tuple[Struct, ...]:
    """Layouts of the words before an array's numbers, and the padding before and after them, one for each offset modulo 8."""
    layouts = []
    for start in range(8):
        before = -start % 4
        after = -(start + before + UINT32.size * words) % 8 if filled else 0  # numbers are aligned to eight
        layouts.append(Struct(f"<{before}x{words}I{after}x"))
    return tuple(layouts)


def _array_writer(field: Field, *, with_width: bool) -> Writer:
    name = field.name
    empty, filled = (_heads(1 + with_width, filled=filled) for filled in (False, True))

    def write(message: Any, offset: int) -> bytes:
        array: Array = getattr(message, name)
        size = array.size
        if array.dtype is not LITTLE_ENDIAN:
            array = array.astype(LITTLE_ENDIAN)
        head = (filled if size else empty)[offset % 8]
        words = head.pack(array.shape[1], size) if with_width else head.pack(size)
        return words + array.tobytes() if size else words

    return write


def _array_reader(field: Field, *, width_at: int | None) -> Reader:
    """
    Reader of an array.

    Args:
        field: Field of the array.
        width_at: Index, among the values read, of an earlier matrix with the same row width; None if the width is stored before this array.
    """
    name, has_rows = field.name, bool(field.width)
    finite, filled = field.finite, field.filled

    def read(payload: bytes, offset: int, values: list[Any]) -> int:
        width = 0
        if has_rows and width_at is None:
            width, offset = _word(payload, offset, field.width)
        elif width_at is not None:
            width = values[width_at].shape[1]
        size, offset = _word(payload, offset, name)
        if size:
            offset += -offset % 8
        end = offset + 8 * size
        if HEADER_BYTES + end > len(payload):
            raise Refused("truncated", f"{name} must hold the {size} numbers it declares, got {max(0, len(payload) - HEADER_BYTES - offset) // 8}")
        array = np.frombuffer(payload, LITTLE_ENDIAN, size, HEADER_BYTES + offset).astype(FLOAT64)
        if filled and not size:
            raise Refused("length", f"{name} must hold at least one row, got none")
        if finite and not bounded(array, NUMBER_LIMIT):
            wrong = array[~(np.abs(array) <= NUMBER_LIMIT)][0]
            raise Refused("not_finite", f"{name} must be finite and at most {NUMBER_LIMIT:g}, got {wrong} among {size} numbers")
        values.append(_rows(array, width, name) if has_rows else array)
        return end

    return read


def _word(payload: bytes, offset: int, name: str) -> tuple[int, int]:
    offset += -offset % 4
    if len(payload) < HEADER_BYTES + offset + 4:
        raise Refused("truncated", f"{name} must begin at byte {HEADER_BYTES + offset}, got {len(payload)} bytes")
    value: int = UINT32.unpack_from(payload, HEADER_BYTES + offset)[0]
    return value, offset + 4


def _counted(payload: bytes, offset: int, name: str) -> tuple[bytes, int]:
    """Return the bytes whose number is at an offset, and the offset after them."""
    size, offset = _word(payload, offset, name)
    content = payload[HEADER_BYTES + offset : HEADER_BYTES + offset + size]
    if len(content) < size:
        raise Refused("truncated", f"{name} must hold the {size} bytes it declares, got {len(content)}")
    return content, offset + size


def _rows(flat: Array, width: int, name: str) -> Array:
    if flat.size % width if width else flat.size:
        raise Refused("length", f"{name} must hold whole rows of {width} numbers, got {flat.size}")
    return flat.reshape(flat.size // width if width else 0, width)


# Strings.


def _string_writer(field: Field) -> Writer:
    def write(message: Any, offset: int) -> bytes:
        text: str = getattr(message, field.name)
        if not text.isprintable():  # for example a line break in a quoted text
            text = "".join(c if c.isprintable() else " " for c in text)
        encoded = text.encode("utf-8", "replace")[: field.high and field.high - 1].decode("utf-8", "ignore").encode() + b"\x00"
        return bytes(-offset % 4) + UINT32.pack(len(encoded)) + encoded

    return write


def _string_reader(field: Field) -> Reader:
    name = field.name

    def read(payload: bytes, offset: int, values: list[Any]) -> int:
        encoded, end = _counted(payload, offset, name)
        if field.high is not None and len(encoded) > field.high:
            raise Refused("text", f"{name} must have at most {field.high} bytes, got {len(encoded)}")
        if encoded[-1:] != b"\x00":
            raise Refused("text", f"{name} must end with a zero byte")
        try:
            text = encoded[:-1].decode("utf-8")
        except UnicodeDecodeError as error:
            raise Refused("text", f"{name} must be UTF-8, got {error.reason} at byte {error.start}") from None
        if not text.isprintable():
            raise Refused("text", f"{name} must hold characters that can be printed, got {text[:MAX_QUOTED_CHARS]!r}")
        values.append(text)
        return end

    return read


# Bytes.


def _bytes_writer(field: Field) -> Writer:
    name = field.name

    def write(message: Any, offset: int) -> bytes:
        content: bytes = getattr(message, name)
        return bytes(-offset % 4) + UINT32.pack(len(content)) + content

    return write


def _bytes_reader(field: Field) -> Reader:
    name = field.name

    def read(payload: bytes, offset: int, values: list[Any]) -> int:
        content, end = _counted(payload, offset, name)
        values.append(content)
        return end

    return read


# Conditions on several fields of one message.


def _check_reference(message: Reference) -> None:
    rows, (got, width) = len(message.y), message.p.shape
    if width and got != rows:
        raise Refused("length", f"p must hold {rows} rows of {width} numbers, as many as y, got {got}")
    if not width:
        message.p = message.p.reshape(rows, 0)


def _check_command(message: Command) -> None:
    rows, states, gain = len(message.u_rest), len(message.x_rest), message.K.shape
    if rows and message.rest_period_ns < MIN_PERIOD_NS:
        raise Refused("value", f"rest_period_ns must be at least {MIN_PERIOD_NS} for a way to rest of {rows} rows, got {message.rest_period_ns}")
    if states not in (0, rows):
        raise Refused("length", f"x_rest must hold {rows} rows, as many as u_rest, or none, got {states}")
    if gain[0] not in (0, message.u.shape[1]):
        raise Refused("length", f"K must hold {message.u.shape[1]} rows, one for each input, or none, got {gain[0]}")


def _check_telemetry(message: Telemetry) -> None:
    for name, vector, width in (("x0", message.x0, message.x.shape[1]), ("y", message.y, message.y_ref.shape[1])):
        if vector.size not in (0, width):
            raise Refused("length", f"{name} must hold {width} numbers, got {vector.size}")


FIELD_RELATIONS: dict[type[Any], Callable[[Any], None]] = {Reference: _check_reference, Command: _check_command, Telemetry: _check_telemetry}


def _codec(fields: Sequence[Field]) -> tuple[tuple[Writer, ...], tuple[Reader, ...]]:
    """Writers and readers of a message, one for each run of scalars, array, string and sequence of bytes."""
    writers: list[Writer] = []
    readers: list[Reader] = []
    first: dict[str, int] = {}  # position of the first array with each row width
    position = 0
    for scalar, run in groupby(fields, key=lambda field: field.kind in STRUCT_FORMATS):
        group = list(run)
        if scalar:
            writers.append(_scalar_writer(group))
            readers.append(_scalar_reader(group))
            position += len(group)
            continue
        for field in group:
            if field.kind == "string":
                writers.append(_string_writer(field))
                readers.append(_string_reader(field))
            elif field.kind == "uint8[]":
                writers.append(_bytes_writer(field))
                readers.append(_bytes_reader(field))
            else:
                writers.append(_array_writer(field, with_width=bool(field.width) and field.width not in first))
                readers.append(_array_reader(field, width_at=first.get(field.width)))
                if field.width:
                    first.setdefault(field.width, position)
            position += 1
    return tuple(writers), tuple(readers)


CODECS = {cls: _codec(fields) for cls, fields in LAYOUTS.items()}
WRITERS = {cls: writers for cls, (writers, _) in CODECS.items()}
READERS = {cls: readers for cls, (_, readers) in CODECS.items()}
