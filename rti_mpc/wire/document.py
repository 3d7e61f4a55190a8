# SPDX-License-Identifier: Apache-2.0
"""
Reader of JSON objects from peers: descriptions, requests and answers.

Parsing JSON holds the interpreter's lock for 30 ms per megabyte, so nothing long is
parsed. What is accepted is safe to convert, compare and print: no number is infinite or
longer than 64 bits, nothing is deeply nested, and all text can be encoded.
"""

from __future__ import annotations

import json
import math
from typing import Any

from rti_mpc.wire.cdr import Refused

MAX_DOCUMENT_BYTES = 1 << 16  # of a description or an answer; requests are shorter
MAX_DEPTH = 16  # of objects and lists inside one another
INTEGER_LIMIT = 1 << 64  # every integer is smaller in magnitude
MAX_DIGITS = 20  # of such an integer


def read(payload: bytes, size: int | None = None, most: int = MAX_DOCUMENT_BYTES) -> dict[str, Any]:
    """
    Return the JSON object in a payload.

    Args:
        payload: Bytes of the object.
        size: Number of bytes that were sent, if the payload is withheld.
        most: Largest number of bytes.

    Raises:
        MessageError: The payload is no JSON object, too long or too deep, or a number is out of range.
    """
    size = len(payload) if size is None else size
    if size > most:
        raise Refused("oversized", f"message must have at most {most} bytes, got {size}")
    try:
        value = json.loads(payload.decode(), parse_int=_integer, parse_float=_number, parse_constant=_number)
        json.dumps(value, ensure_ascii=False).encode()  # raises for half of a surrogate pair
    except Refused:
        raise
    except (ValueError, RecursionError):
        raise Refused("text", "message must be a JSON object") from None
    if not isinstance(value, dict):
        raise Refused("text", "message must be a JSON object")
    level: list[Any] = [value]
    for _ in range(MAX_DEPTH):
        level = [inner for outer in level for inner in (outer.values() if isinstance(outer, dict) else outer) if isinstance(inner, (dict, list))]
        if not level:
            return value
    raise Refused("value", f"message must hold at most {MAX_DEPTH} objects and lists inside one another")


def _integer(text: str) -> int:
    if len(text) > 1 + MAX_DIGITS or not -INTEGER_LIMIT < (number := int(text)) < INTEGER_LIMIT:
        raise Refused("value", f"an integer must be below 2^64, got {text[:MAX_DIGITS]}")
    return number


def _number(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise Refused("value", f"a number must be finite, got {text[:MAX_DIGITS]}")
    return number
