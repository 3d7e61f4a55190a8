# SPDX-License-Identifier: Apache-2.0
"""
Compact encoding of the values in a journal.

A value is a tag of one byte and its content, little-endian. Types are those of a closed
table: decoding calls no code but the constructors of `RECORDS` and `ENUMS`, allocates
nothing for a declared length before that many bytes are there, and ends with a
`JournalError` at the first byte that does not fit.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import fields
from enum import Enum
from typing import Any

import numpy as np

from rti_mpc.contract.lives import Heard
from rti_mpc.contract.message import Command, End, Reference, Severity, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.state_stream import Arrival
from rti_mpc.errors import JournalError

ENCODING_VERSION = 1  # first byte of whatever is encoded; another one is refused
MAX_DEPTH = 64  # of values inside values

# Places in these tables are on the wire: append only.
RECORDS: tuple[type[Any], ...] = (State, Reference, Command)
ENUMS: tuple[type[Enum], ...] = (Mode, QpStatus, End, Severity, Arrival, Heard)
DTYPES = tuple(np.dtype(name) for name in ("<f8", "<i8", "<i4", "?", "u1"))

RECORD_FIELDS = tuple(tuple(field.name for field in fields(cls)) for cls in RECORDS)
RECORD_PLACES = {cls: place for place, cls in enumerate(RECORDS)}
ENUM_PLACES = {cls: place for place, cls in enumerate(ENUMS)}
MEMBERS = tuple(tuple(cls) for cls in ENUMS)
DTYPE_PLACES = {dtype: place for place, dtype in enumerate(DTYPES)}

INT64, FLOAT64, COUNT, PAIR = struct.Struct("<q"), struct.Struct("<d"), struct.Struct("<I"), struct.Struct("<BB")
NONE, FALSE, TRUE, SMALL, INT, LONG, FLOAT, TEXT, BYTES, ENUM, ARRAY, TUPLE, LIST, DICT, RECORD = range(15)


def encode_value(value: Any, into: bytearray) -> None:
    """
    Append a value.

    Raises:
        JournalError: Its type is none of the table; what was appended is then of no use.
    """
    if (write := WRITERS.get(type(value))) is not None:
        write(value, into)
    elif type(value) in ENUM_PLACES:
        into.append(ENUM)
        place = ENUM_PLACES[type(value)]
        into += PAIR.pack(place, MEMBERS[place].index(value))
    elif type(value) in RECORD_PLACES:
        place = RECORD_PLACES[type(value)]
        into += PAIR.pack(RECORD, place)
        for name in RECORD_FIELDS[place]:
            encode_value(getattr(value, name), into)
    elif isinstance(value, np.number | np.bool_):
        encode_value(value.item(), into)
    else:
        raise JournalError(f"a journal must hold values of its table only, got one of {type(value).__module__}.{type(value).__qualname__}")


def encode_slowly(value: Any, into: bytearray, pause: Callable[[], object]) -> None:
    """As `encode_value`, with a pause after each value that holds no others in a list or a tuple."""
    if type(value) in (list, tuple):
        into.append(LIST if type(value) is list else TUPLE)
        into += COUNT.pack(len(value))
        for item in value:
            encode_slowly(item, into, pause)
    else:
        encode_value(value, into)
        pause()


def _write_int(value: int, into: bytearray) -> None:
    if 0 <= value < 256:
        into += PAIR.pack(SMALL, value)
    elif -(2**63) <= value < 2**63:
        into.append(INT)
        into += INT64.pack(value)
    else:
        content = value.to_bytes((value.bit_length() + 8) // 8, "little", signed=True)
        into.append(LONG)
        into += COUNT.pack(len(content)) + content


def _write_array(value: np.ndarray[Any, Any], into: bytearray) -> None:
    if (place := DTYPE_PLACES.get(value.dtype)) is None:
        raise JournalError(f"an array of a journal must have one of the types {[*map(str, DTYPES)]}, got {value.dtype}")
    into += bytes((ARRAY, place, value.ndim)) + struct.pack(f"<{value.ndim}I", *value.shape) + value.tobytes()


def _write_bytes(tag: int) -> Callable[[bytes, bytearray], None]:
    def write(value: bytes, into: bytearray) -> None:
        into.append(tag)
        into += COUNT.pack(len(value))
        into += value

    return write


def _write_text(value: str, into: bytearray) -> None:
    _write_bytes(TEXT)(value.encode("utf-8", "surrogatepass"), into)


def _write_items(tag: int) -> Callable[[Any, bytearray], None]:
    def write(value: Any, into: bytearray) -> None:
        into.append(tag)
        into += COUNT.pack(len(value))
        for item in value:
            encode_value(item, into)

    return write


def _write_dict(value: dict[Any, Any], into: bytearray) -> None:
    into.append(DICT)
    into += COUNT.pack(len(value))
    for key, item in value.items():
        encode_value(key, into)
        encode_value(item, into)


WRITERS: dict[type[Any], Callable[[Any, bytearray], None]] = {
    type(None): lambda _, into: into.append(NONE),
    bool: lambda value, into: into.append(TRUE if value else FALSE),
    int: _write_int,
    float: lambda value, into: into.extend(bytes((FLOAT,)) + FLOAT64.pack(value)),
    str: _write_text,
    bytes: _write_bytes(BYTES),
    np.ndarray: _write_array,
    tuple: _write_items(TUPLE),
    list: _write_items(LIST),
    dict: _write_dict,
}


class Decoder:
    """
    Values from bytes, one after the other.

    Attributes:
        at: Offset of the next value.
    """

    def __init__(self, content: bytes, at: int = 0) -> None:
        self._content = content
        self.at = at

    @property
    def done(self) -> bool:
        """Whether all bytes are read."""
        return self.at == len(self._content)

    def take(self, size: int) -> bytes:
        """Return the next bytes."""
        end = self.at + size
        if end > len(self._content):
            raise JournalError(f"a journal must hold the {size} bytes that it declares at byte {self.at}, got {len(self._content) - self.at}")
        taken, self.at = self._content[self.at : end], end
        return taken

    def value(self, depth: int = 0) -> Any:
        """
        Return the next value.

        Raises:
            JournalError: The bytes are none.
        """
        if depth > MAX_DEPTH:
            raise JournalError(f"values of a journal must be at most {MAX_DEPTH} deep, got more")
        tag = self.take(1)[0]
        if tag <= TRUE:
            return (None, False, True)[tag]
        if tag == SMALL:
            return self.take(1)[0]
        if tag in (INT, FLOAT):
            return (INT64 if tag == INT else FLOAT64).unpack(self.take(8))[0]
        if tag == ENUM:
            place, member = self.take(2)
            return at(at(MEMBERS, place), member)
        if tag == RECORD:
            place = self.take(1)[0]
            cls, names = at(RECORDS, place), at(RECORD_FIELDS, place)
            return cls(*[self.value(depth + 1) for _ in names])
        if tag == ARRAY:
            return self._array()
        if tag > RECORD:
            raise JournalError(f"a value of a journal must begin with a tag up to {RECORD}, got {tag} at byte {self.at - 1}")
        return self._sized(tag, COUNT.unpack(self.take(4))[0], depth + 1)

    def _sized(self, tag: int, count: int, depth: int) -> Any:
        """Return a value that has a length."""
        if tag == LONG:
            return int.from_bytes(self.take(count), "little", signed=True)
        if tag == BYTES:
            return self.take(count)
        if tag == TEXT:
            try:
                return self.take(count).decode("utf-8", "surrogatepass")
            except UnicodeDecodeError as error:
                raise JournalError(f"a text of a journal must be UTF-8, got {error.reason}") from None
        if count > len(self._content) - self.at:  # each item has one byte at least
            raise JournalError(f"a journal must hold the {count} values that it declares at byte {self.at}, got {len(self._content) - self.at} bytes")
        if tag == DICT:
            return {self._key(depth): self.value(depth) for _ in range(count)}
        items = [self.value(depth) for _ in range(count)]
        return tuple(items) if tag == TUPLE else items

    def _key(self, depth: int) -> Any:
        key = self.value(depth)
        try:
            hash(key)
        except TypeError:
            raise JournalError(f"a key in a journal must be a number, a text or a tuple, got {type(key).__name__}") from None
        return key

    def _array(self) -> np.ndarray[Any, Any]:
        place, dimensions = self.take(2)
        dtype, shape = at(DTYPES, place), struct.unpack(f"<{dimensions}I", self.take(4 * dimensions))
        size = 1
        for length in shape:
            size *= length
        content = self.take(size * dtype.itemsize)
        if dtype == np.bool_ and max(content, default=0) > 1:
            raise JournalError(f"truth values of a journal must be 0 or 1, got {max(content)}")
        try:
            return np.frombuffer(content, dtype).reshape(shape).copy()
        except ValueError as error:
            raise JournalError(f"an array of a journal must have a shape, got {shape}: {error}") from None


def at(table: tuple[Any, ...], place: int) -> Any:
    """Return an entry of a table."""
    if place >= len(table):
        raise JournalError(f"a journal must name one of {len(table)} entries, got {place}")
    return table[place]


def check_version(content: bytes) -> None:
    """Refuse content of another encoding."""
    if content[:1] != bytes((ENCODING_VERSION,)):
        raise JournalError(
            f"a journal must be of encoding {ENCODING_VERSION}, got {content[0] if content else 'no bytes'}: use the version that made it"
        )
