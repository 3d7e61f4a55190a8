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

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache, partial
from math import inf
from operator import attrgetter, itemgetter
from struct import Struct
from struct import error as StructError
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
MAX_LAYOUTS = 64  # of whole messages of one class that are kept, by their sizes

# A message is read piece by piece: a run of scalars, and the array, text or bytes behind it, whose length is unpacked with them. What takes those
# replaces the last values of a list, the length and before it a row width where there is one. It begins at an offset, and returns the one behind.
Taker = Callable[[bytes, int, list[Any]], int]


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
    writer = WRITERS[type(message)]
    slots = list(writer.slots(message))
    for i in writer.widths:
        slots[i] = slots[i][1]
    for i in writer.arrays:
        array: Array = slots[i]
        slots[i] = (array if array.dtype is LITTLE_ENDIAN else array.astype(LITTLE_ENDIAN)).tobytes()
    for i, written in writer.texts:
        slots[i] = written(slots[i])
        slots[i - 1] = len(slots[i])
    return writer.layout(writer.sizes(slots)).pack(HEADER, *slots)


def decode(cls: type[M], payload: bytes) -> M:
    """
    Message in a payload; its arrays are owned, C-contiguous float64.

    Raises:
        Refused: The bytes are not exactly one such message; `reason` is one of `REFUSAL_REASONS`.
    """
    if payload[:HEADER_BYTES] != HEADER:
        raise _header_error(payload)
    reader, values, offset = READERS[cls], list[Any](), HEADER_BYTES
    try:
        for layouts, take in reader.pieces:
            layout = layouts[offset % 8]
            values += layout.unpack_from(payload, offset)
            offset += layout.size
            if take is not None:
                offset = take(payload, offset, values)
    except StructError:
        raise Refused("truncated", f"message must hold at least {offset + layout.size} bytes, got {len(payload)}") from None
    if len(payload) != offset:
        raise Refused("oversized", f"message must end after {offset} bytes, got {len(payload)}")
    for i, name, known in reader.members:
        if values[i] not in known:
            raise Refused("value", f"{name} must be one of {sorted(known)}, got {values[i]}")
        values[i] = known[values[i]]
    for i, low, high, field in reader.ranges:
        if not low <= values[i] <= high and values[i] != field.also:
            raise Refused("value", f"{field.name} must be from {field.low} to {field.high}, got {values[i]}")
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


# Layouts of what one call of `struct` packs or unpacks.


def _layout(parts: Iterable[tuple[str, int]], start: int) -> Struct:
    """Layout of parts, each a format and what it is aligned to, counted from the end of the header, with the padding before each of them."""
    text, offset = "<", start
    for code, unit in parts:
        padding = (HEADER_BYTES - offset) % unit
        text += f"{padding}x{code}"
        offset += padding + Struct("<" + code).size
    return Struct(text)


def _scalar(kind: str) -> tuple[str, int]:
    return STRUCT_FORMATS[kind], Struct("<" + STRUCT_FORMATS[kind]).size


def _words(field: Field, widths: set[str]) -> int:
    """Return how many words stand before the content of a field, 2 for the first matrix of each row width; `widths` is completed."""
    first = bool(field.width) and field.width not in widths
    widths.add(field.width)
    return 1 + first


# Writing: all at once, since what has a length tells it.


class Writer:
    """
    How messages of one class are written, from a list of what is packed: a slot for each scalar, word and content.

    Attributes:
        slots: Returns what a message has for each slot.
        widths: Places of row widths, where `slots` finds the shape of the matrix.
        arrays: Places of the contents that are arrays, each behind its size.
        texts: Places of those that are texts or bytes, each with what makes bytes of it; `slots` finds no size of them.
        sizes: Returns the sizes among the slots.
        layout: Returns the layout for sizes.
    """

    def __init__(self, fields: Sequence[Field]) -> None:
        self.widths, self.arrays, self.texts = list[int](), list[int](), list[tuple[int, Callable[[Any], bytes]]]()
        names, sizes, widths = list[str](), list[int](), set[str]()
        for field in fields:
            if field.kind not in STRUCT_FORMATS:
                if _words(field, widths) == 2:
                    self.widths.append(len(names))
                    names.append(f"{field.name}.shape")
                sizes.append(len(names))
                if field.kind == "float64[]":
                    names.append(f"{field.name}.size")
                    self.arrays.append(len(names))
                else:
                    names.append(field.name)
                    self.texts.append((len(names), partial(_line, most=field.high) if field.kind == "string" else bytes))
            names.append(field.name)
        self.slots: Callable[[Any], tuple[Any, ...]] = attrgetter(*names)
        self.sizes: Callable[[list[Any]], Any] = itemgetter(*sizes)
        self.layout = lru_cache(maxsize=MAX_LAYOUTS)(partial(_whole, fields))


def _whole(fields: Sequence[Field], sizes: int | tuple[int, ...]) -> Struct:
    """Layout of a whole message, with the header, for sizes of its arrays, in numbers, and of its texts and bytes."""
    left, widths = iter((sizes,) if isinstance(sizes, int) else sizes), set[str]()
    parts = [(f"{HEADER_BYTES}s", 1)]
    for field in fields:
        if field.kind in STRUCT_FORMATS:
            parts.append(_scalar(field.kind))
            continue
        size = next(left)
        parts += _words(field, widths) * [_scalar("uint32")]
        parts.append((f"{8 * size}s", 8 if size else 1) if field.kind == "float64[]" else (f"{size}s", 1))
    return _layout(parts, 0)


def _line(text: str, most: int | None) -> bytes:
    """Return a text as one line of printable characters with a zero byte behind them, cut to the most bytes that it may have."""
    if not text.isprintable():  # for example a line break in a quoted text
        text = "".join(c if c.isprintable() else " " for c in text)
    return text.encode("utf-8", "replace")[: most and most - 1].decode("utf-8", "ignore").encode() + b"\x00"


# Reading: piece by piece, since each length tells where the next piece begins.


class Reader:
    """
    How messages of one class are read.

    Attributes:
        pieces: Layouts of each run of scalars and the words behind it, one for each offset modulo 8 at which it may begin; and what takes those.
        members: Fields that are of an enumeration: their place, name and members by number.
        ranges: Fields with limits: their place, limits and field.
    """

    def __init__(self, fields: Sequence[Field]) -> None:
        self.pieces: list[tuple[tuple[Struct, ...], Taker | None]] = []
        self.members = [(i, field.name, {int(m): m for m in enum}) for i, field in enumerate(fields) if (enum := field.member_of) is not None]
        self.ranges = [
            (i, -inf if field.low is None else field.low, inf if field.high is None else field.high, field)
            for i, field in enumerate(fields)
            if field.kind in STRUCT_FORMATS and (field.low is not None or field.high is not None)
        ]
        widths, known = dict[str, int](), set[str]()  # position of the first matrix with each row width
        run: list[tuple[str, int]] = []
        for position, field in enumerate(fields):
            if field.kind in STRUCT_FORMATS:
                run.append(_scalar(field.kind))
                continue
            self._add(run + _words(field, known) * [_scalar("uint32")], _taker(field, widths.get(field.width)))
            widths.setdefault(field.width, position)
            run = []
        if run:
            self._add(run, None)

    def _add(self, parts: list[tuple[str, int]], take: Taker | None) -> None:
        self.pieces.append((tuple(_layout(parts, start) for start in range(8)), take))


def _taker(field: Field, width_at: int | None) -> Taker:
    if field.kind != "float64[]":
        return _bytes_taker(field)
    return _matrix_taker(field, width_at) if field.width else _array_taker(field)


def _array_taker(field: Field) -> Taker:
    name, finite, filled = field.name, field.finite, field.filled

    def take(payload: bytes, offset: int, values: list[Any]) -> int:
        size = values.pop()
        if size:
            offset += (HEADER_BYTES - offset) % 8
        elif filled:
            raise Refused("length", f"{name} must hold at least one row, got none")
        end: int = offset + 8 * size
        if end > len(payload):
            raise Refused("truncated", f"{name} must hold the {size} numbers it declares, got {max(0, len(payload) - offset) // 8}")
        array = np.frombuffer(payload, LITTLE_ENDIAN, size, offset).astype(FLOAT64)
        if finite and not bounded(array, NUMBER_LIMIT):
            wrong = array[~(np.abs(array) <= NUMBER_LIMIT)][0]
            raise Refused("not_finite", f"{name} must be finite and at most {NUMBER_LIMIT:g}, got {wrong} among {size} numbers")
        values.append(array)
        return end

    return take


def _matrix_taker(field: Field, width_at: int | None) -> Taker:
    """
    Taker of a matrix.

    Args:
        field: Field of the matrix.
        width_at: Index, among the values read, of an earlier matrix with the same row width; None if the width is stored before this one.
    """
    take = _array_taker(field)

    def take_rows(payload: bytes, offset: int, values: list[Any]) -> int:
        width = values.pop(-2) if width_at is None else values[width_at].shape[1]
        end = take(payload, offset, values)
        flat: Array = values[-1]
        if flat.size % width if width else flat.size:
            raise Refused("length", f"{field.name} must hold whole rows of {width} numbers, got {flat.size}")
        values[-1] = flat.reshape(flat.size // width if width else 0, width)
        return end

    return take_rows


def _bytes_taker(field: Field) -> Taker:
    name, is_text = field.name, field.kind == "string"

    def take(payload: bytes, offset: int, values: list[Any]) -> int:
        size = values.pop()
        content = payload[offset : offset + size]
        if len(content) < size:
            raise Refused("truncated", f"{name} must hold the {size} bytes it declares, got {len(content)}")
        values.append(_text(content, field) if is_text else content)
        return offset + len(content)

    return take


def _text(encoded: bytes, field: Field) -> str:
    name = field.name
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
    return text


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


WRITERS = {cls: Writer(fields) for cls, fields in LAYOUTS.items()}
READERS = {cls: Reader(fields) for cls, fields in LAYOUTS.items()}
