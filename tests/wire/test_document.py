# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import pytest

from rti_mpc.errors import MessageError
from rti_mpc.wire.document import MAX_DEPTH, MAX_DOCUMENT_BYTES, read


def nested(depth: int) -> bytes:
    return b'{"a":' + depth * b"[" + depth * b"]" + b"}"


def test_an_object_is_read_as_it_was_written() -> None:
    value = {
        "role": "controller",
        "config_hash": 2**64 - 1,
        "epoch": -1,
        "dt_s": 1e-3,
        "lbu": [None, -0.5],
        "name": "Räder \N{ROBOT FACE}",
        "ok": True,
    }
    assert read(json.dumps(value).encode()) == value
    assert read(b"{}".ljust(MAX_DOCUMENT_BYTES)) == {}
    assert read(nested(MAX_DEPTH - 1))


@pytest.mark.parametrize(
    ("payload", "wrong"),
    [
        (b"", "JSON object"),
        (b"[]", "JSON object"),
        (b"null", "JSON object"),
        (b"\xff", "JSON object"),
        ('{"a": 1}'.encode("utf-16"), "JSON object"),
        ('{"a": 1}'.encode("utf-16-le"), "JSON object"),
        ('{"a": 1}'.encode("utf-32-be"), "JSON object"),
        ('{"a": 1}'.encode("utf-8-sig"), "JSON object"),
        (b'{"a": 1', "JSON object"),
        (b'{"a": "\\ud800"}', "JSON object"),  # cannot be printed
        (30_000 * b"[", "JSON object"),
        (nested(MAX_DEPTH), "inside one another"),
        (nested(10_000), "inside one another|JSON object"),
        (b'{"version": Infinity}', "finite"),
        (b'{"version": -Infinity}', "finite"),
        (b'{"version": NaN}', "finite"),
        (b'{"version": 1e400}', "finite"),
        (b'{"version": 1' + 400 * b"0" + b"}", "2\\^64"),
        (b'{"version": -' + 5000 * b"9" + b"}", "2\\^64"),  # which Python would not even convert
        (b'{"version": 18446744073709551616}', "2\\^64"),
        (b"{}".ljust(MAX_DOCUMENT_BYTES + 1), "at most"),
    ],
)
def test_all_else_is_refused_in_one_line(payload: bytes, wrong: str) -> None:
    with pytest.raises(MessageError, match=wrong) as refusal:
        read(payload)
    assert len(str(refusal.value)) < 100


def test_bytes_that_were_withheld_count() -> None:
    with pytest.raises(MessageError, match="at most 65536 bytes, got 52428800"):
        read(b"", 50 << 20)
