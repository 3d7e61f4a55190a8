# SPDX-License-Identifier: Apache-2.0
"""Encoding of the values in a journal: exact, of a closed table, and safe to decode."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import Command, End, Reference, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.call import Call
from rti_mpc.errors import JournalError
from rti_mpc.journal.entry import METHODS, decode_entries, encode_call, join_entries
from rti_mpc.journal.value import MAX_DEPTH, Decoder, encode_value
from tests.control.test_call import REPORTED_CALLS

RNG = np.random.default_rng(1)
STATE = State(2**64 - 1, 7, -5, RNG.normal(size=5))
COMMAND = Command(1, 2, 3, 4, 5, 6, 2**62, 8, Mode.TRACKING, QpStatus.INACCURATE, 10**8, RNG.normal(size=(6, 2)))
VALUES: list[Any] = [
    *(None, True, False, 0, 255, 256, -1, 2**63, -(2**70), 0.1, -0.0, math.inf, "", "Räder ☂", b"\x00\xff", Mode.STOPPED),
    *(np.zeros((0, 3)), np.arange(6, dtype=np.int64).reshape(2, 3), np.array([True, False]), np.array(1.5)),
    *((), (1, [2, (3.0, None)]), {"a": 1, (2, 3): [b"x"]}, STATE, COMMAND),
    Reference(1, 2, -(2**63), 10**8, End.STOP, RNG.normal(size=(4, 3)), np.zeros((4, 0))),
]


def encoded(value: Any) -> bytes:
    content = bytearray()
    encode_value(value, content)
    return bytes(content)


def same(a: Any, b: Any) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if is_dataclass(a):
        return all(same(getattr(a, field.name), getattr(b, field.name)) for field in fields(a))
    return bool(a == b) and (not isinstance(a, float) or math.copysign(1.0, a) == math.copysign(1.0, b))


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_value_comes_back_in_every_bit(value: Any) -> None:
    decoder = Decoder(encoded(value))
    assert same(decoder.value(), value)
    assert decoder.done


@pytest.mark.parametrize("value", [object(), print, {1}, np.array(["text"]), lambda: None, 1j], ids=lambda value: type(value).__name__)
def test_value_of_another_type_is_refused_by_name(value: Any) -> None:
    with pytest.raises(JournalError, match=r"a journal must|of a journal must"):
        encoded(value)


def test_bytes_that_are_no_value_are_refused_and_allocate_nothing() -> None:
    whole, rng = encoded(tuple(VALUES)), np.random.default_rng(2)
    tracemalloc.start()
    for size in range(0, len(whole), 7):
        with pytest.raises(JournalError):
            Decoder(whole[:size]).value()
    refused = 0
    for _ in range(1000):
        mutant = bytearray(whole)
        mutant[rng.integers(len(mutant))] = rng.integers(256)
        try:
            Decoder(bytes(mutant)).value()
        except JournalError:
            refused += 1
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert refused > 30
    assert peak < 1_000_000


def test_values_inside_values_end_at_a_depth() -> None:
    value: Any = None
    for _ in range(MAX_DEPTH + 2):
        value = (value,)
    with pytest.raises(JournalError, match=f"at most {MAX_DEPTH} deep"):
        Decoder(encoded(value)).value()


def test_every_reported_call_of_a_controller_has_an_entry() -> None:
    assert set(METHODS) == REPORTED_CALLS | {"inject"}


def test_entries_come_back_with_their_numbers_and_arguments() -> None:
    calls = [
        Call("receive_state", (STATE, 5), {}),
        Call("in_time", (COMMAND, 6), {}),
        Call("commit", (COMMAND,), {"left_ns": 7}),
        Call("prepare", (), {}),
    ]
    entries = list(decode_entries(join_entries(map(encode_call, calls)), 11))
    assert [(entry.seq, entry.name) for entry in entries] == [(11, "receive_state"), (12, "in_time"), (13, "commit"), (14, "prepare")]
    assert same(entries[0].args[0], STATE)
    assert entries[1].args == (None, 6), "the last proposal"
    assert same(entries[2].args[0], COMMAND)
    assert entries[2].args[1] == 7


def test_entries_of_another_version_are_refused_in_a_line_that_names_both() -> None:
    with pytest.raises(JournalError, match="must be of encoding 1, got 9"):
        list(decode_entries(b"\x09\x03", 1))
    with pytest.raises(JournalError, match="one of 16 entries, got 200"):
        list(decode_entries(b"\x01\xc8", 1))
