# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
import struct
import subprocess
import sys
import tracemalloc
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Command, End, Event, Journal, JournalKind, Reference, Severity, State, Telemetry
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.errors import MessageError
from rti_mpc.rti.active_set import COST_FLOOR
from rti_mpc.wire.cdr import MAX_LAYOUTS, MESSAGE_PACKAGE, REFUSAL_REASONS, WRITERS, Message, Refused, decode, encode, encoding, schema
from rti_mpc.wire.layout import LAYOUTS, msg_text

ROOT = Path(__file__).parents[2]
RNG = np.random.default_rng(1)
HUGE = 2**64 - 1

STATE = State(HUGE, 7, -5, RNG.normal(size=5), RNG.normal(size=2), HUGE, 3)
REFERENCE = Reference(1, 2, STAMP_ON_ARRIVAL, 10**8, End.STOP, RNG.normal(size=(4, 3)), RNG.normal(size=(4, 2)))
COMMAND = Command(1, 2, 3, HUGE, 5, -6, 2**62 - 1, HUGE, Mode.TRACKING, QpStatus.MAX_ITER, 10**8, RNG.normal(size=(7, 2)))
WAY = {"rest_period_ns": 10**7, "u_rest": RNG.normal(size=(3, 2)), "x_rest": RNG.normal(size=(3, 5)), "K": RNG.normal(size=(2, 5))}
NUMBERS = {"res_prim": 1e-3, "res_dual": np.nan, "cost": np.inf, "violation": 0.0}
TIMES = {"prepare_us": 1.5, "feedback_us": 2.5, "latency_us": 3.5, "state_age_s": 0.1, "slack_s": -0.5, "delay_s": 0.05}
COUNTS = {"skipped": 8, "fallbacks": 9, "softened": 11, "shifted": 2, "braked": 3, "rested": 4, "parameter_version": 10}
SECOND = {"second_seq": 2**63, "second_status": QpStatus.MAX_ITER, "second_difference": 1e-5, "second_iterations": 40, "second_us": 700.0}
ARRAYS = {
    "x0": RNG.normal(size=5),
    "x": RNG.normal(size=(8, 5)),
    "u": RNG.normal(size=(7, 2)),
    "y_ref": RNG.normal(size=(7, 3)),
    "y": RNG.normal(size=3),
}
TELEMETRY = Telemetry(1, 2, 3, 4, 5, Mode.FALLBACK, QpStatus.INFEASIBLE, 6, **NUMBERS, **TIMES, **COUNTS, **SECOND, **ARRAYS)
JOURNAL = Journal(HUGE, 2, 3, -4, 5, JournalKind.CALLS, b"\x00\xff\x80")
EVENT = Event(1, 2, 3, "robot", Severity.ERROR, "command_expired", "Räder stehen")

MESSAGES: list[Message] = [
    STATE,
    replace(STATE, x=np.zeros(1), u=np.zeros(0), command_epoch=0, command_seq=0),
    REFERENCE,
    replace(REFERENCE, p=np.zeros((4, 0))),
    replace(REFERENCE, y=np.zeros((1, 1)), p=np.zeros((1, 1)), end=End.HOLD),
    COMMAND,
    replace(COMMAND, u=np.zeros((1, 1)), mode=Mode.STOPPED, status=QpStatus.NONE),
    replace(COMMAND, rest_period_ns=10**7, u_rest=RNG.normal(size=(3, 2))),
    replace(COMMAND, **WAY),
    replace(COMMAND, **(WAY | {"u": RNG.normal(size=(1, 1)), "u_rest": np.zeros((3, 1)), "K": np.zeros((1, 5))})),
    TELEMETRY,
    replace(TELEMETRY, x0=np.zeros(0), x=np.zeros((0, 5)), u=np.zeros((0, 2)), y_ref=np.zeros((0, 3)), y=np.zeros(0)),
    replace(TELEMETRY, y_ref=np.zeros((0, 3)), second_seq=0, second_status=QpStatus.NONE, second_difference=np.nan),
    *(replace(JOURNAL, data=bytes(range(n)), kind=JournalKind.SNAPSHOT) for n in range(5)),
    EVENT,
    *(replace(EVENT, source="r" * n, code="c" * k, text="") for n in range(4) for k in range(4)),
]

store = get_typestore(Stores.EMPTY)
for path in sorted((ROOT / "deploy" / "msg").glob("*.msg")):
    store.register(get_types_from_msg(path.read_text(), f"{MESSAGE_PACKAGE}/{path.stem}"))


def same(a: Any, b: Any) -> bool:
    """Equal values; of arrays the elements, as rows or flat."""
    if isinstance(b, bytes):
        return bytes(a) == b
    return a == b if isinstance(a, str) else np.array_equal(np.ravel(a), np.ravel(b), equal_nan=True)


@pytest.mark.parametrize("message", MESSAGES)
def test_rosbags_decodes_our_bytes_to_equal_values(message: Message) -> None:
    decoded = store.deserialize_cdr(encode(message), schema(type(message)).partition("@")[0])
    for field in fields(message):
        assert same(getattr(decoded, field.name.lower()), getattr(message, field.name)), field.name


@pytest.mark.parametrize("message", MESSAGES)
def test_we_decode_what_rosbags_serialises(message: Message) -> None:
    name = schema(type(message)).partition("@")[0]
    ours = encode(message)
    theirs = bytes(store.serialize_cdr(store.deserialize_cdr(ours, name), name))
    assert theirs == ours
    decoded = decode(type(message), theirs)
    for field in fields(message):
        assert same(getattr(decoded, field.name), getattr(message, field.name)), field.name


def test_row_widths_on_the_wire_are_those_of_the_arrays() -> None:
    decoded = store.deserialize_cdr(encode(TELEMETRY), f"{MESSAGE_PACKAGE}/Telemetry")
    assert (decoded.nx, decoded.nu, decoded.ny) == (5, 2, 3)
    assert store.deserialize_cdr(encode(REFERENCE), f"{MESSAGE_PACKAGE}/Reference").np == 2
    assert store.deserialize_cdr(encode(COMMAND), f"{MESSAGE_PACKAGE}/Command").nu == 2


def test_msg_files_list_the_enumerations_we_use() -> None:
    for cls, enums in {Reference: (End,), Command: (Mode, QpStatus), Journal: (JournalKind,), Event: (Severity,)}.items():
        text = (ROOT / "deploy" / "msg" / f"{cls.__name__}.msg").read_text()
        for member in (member for enum in enums for member in enum):
            assert f"uint8 {member.name}={int(member)}\n" in text


@pytest.mark.parametrize("cls", LAYOUTS)
def test_msg_files_and_dataclasses_have_the_fields_of_the_table_in_its_order(cls: type[Message]) -> None:
    assert (ROOT / "deploy" / "msg" / f"{cls.__name__}.msg").read_text() == msg_text(cls), "run `make msg`"
    assert [field.name for field in fields(cls)] == [field.name for field in LAYOUTS[cls]]


@pytest.mark.parametrize("cls", LAYOUTS)
def test_fields_have_names_that_ros_2_accepts(cls: type[Message]) -> None:
    names = re.findall(r"^\w+(?:\[\])? (\w+) ", msg_text(cls), re.MULTILINE)
    assert len(names) >= len(LAYOUTS[cls])
    assert [name for name in names if not re.fullmatch(r"[a-z](_?[a-z0-9])*", name)] == []


@pytest.mark.parametrize("message", MESSAGES)
def test_decoded_messages_have_the_shapes_and_own_their_arrays(message: Message) -> None:
    decoded = decode(type(message), encode(message))
    for field in fields(message):
        before, after = getattr(message, field.name), getattr(decoded, field.name)
        assert type(after) is type(before)
        if isinstance(before, np.ndarray):
            assert after.shape == before.shape or before.size == after.size == 0
            assert after.dtype == np.float64
            assert after.flags.c_contiguous
            assert after.flags.writeable
            assert after.flags.aligned


def test_strided_arrays_are_encoded_by_value() -> None:
    u = np.arange(24.0).reshape(6, 4)
    strided = replace(COMMAND, u=u[::2, ::2])
    assert np.array_equal(decode(Command, encode(strided)).u, u[::2, ::2])


def test_layouts_are_kept_for_a_few_sizes_only() -> None:
    for size in range(MAX_LAYOUTS + 10):
        assert decode(Journal, encode(replace(JOURNAL, data=bytes(size)))).data == bytes(size)
    assert WRITERS[Journal].layout.cache_info().currsize == MAX_LAYOUTS


def test_numbers_of_another_type_are_encoded_by_value() -> None:
    assert np.array_equal(decode(State, encode(replace(STATE, x=np.arange(3)))).x, [0.0, 1.0, 2.0])


def test_encoding_names_the_schema_and_its_major_version() -> None:
    assert encoding(State) == "application/cdr;rti_mpc_msgs/msg/State@2"


def words(message: Message, at: int, *values: int) -> bytes:
    """Payload with 32-bit words overwritten, `at` counted from the end of the header."""
    payload = bytearray(encode(message))
    struct.pack_into(f"<{len(values)}I", payload, 4 + at, *values)
    return bytes(payload)


def byte(message: Message, at: int, value: int) -> bytes:
    payload = bytearray(encode(message))
    payload[4 + at] = value
    return bytes(payload)


ONE_STATE = encode(STATE)
MALFORMED = [
    (State, b"", "empty"),
    (State, ONE_STATE[:3], "truncated"),
    (State, ONE_STATE[:4], "truncated"),
    (State, ONE_STATE[:27], "truncated"),
    (State, ONE_STATE[:28], "truncated"),
    (State, ONE_STATE[:-1], "truncated"),
    (State, ONE_STATE + b"\x00", "oversized"),
    (State, b"\x00\x00" + ONE_STATE[2:], "big_endian"),
    (State, b"\x00\x03" + ONE_STATE[2:], "header"),
    (State, b"\x00\x07" + ONE_STATE[2:], "header"),
    (State, words(STATE, 24, 2**32 - 1), "truncated"),
    (State, words(STATE, 72, 2**32 - 1), "truncated"),
    (State, words(STATE, 72, 1), "oversized"),
    (State, encode(replace(STATE, u=np.array([np.nan]))), "not_finite"),
    (State, encode(replace(STATE, stamp_ns=2**62)), "value"),
    (State, encode(replace(STATE, stamp_ns=2**63 - 1)), "value"),
    (State, encode(replace(STATE, stamp_ns=-(2**63))), "value"),
    (State, encode(replace(STATE, x=np.zeros(0))), "length"),
    (State, encode(replace(STATE, x=np.array([1.0, np.nan]))), "not_finite"),
    (State, encode(replace(STATE, x=np.array([np.inf, -np.inf]))), "not_finite"),
    (Reference, encode(replace(REFERENCE, y=np.full((4, 3), np.nan))), "not_finite"),
    (Reference, encode(replace(REFERENCE, p=np.full((4, 2), -np.inf))), "not_finite"),
    (Reference, encode(replace(REFERENCE, y=np.zeros((0, 3)), p=np.zeros((0, 0)))), "length"),
    (Reference, encode(replace(REFERENCE, p=np.zeros((3, 2)))), "length"),
    (Reference, encode(replace(REFERENCE, period_ns=0)), "value"),
    (Reference, encode(replace(REFERENCE, period_ns=-1)), "value"),
    (Reference, words(REFERENCE, 36, 5), "length"),
    (Reference, words(REFERENCE, 36, 0), "length"),
    (Reference, words(REFERENCE, 36, 2**32 - 1), "length"),
    (Reference, words(REFERENCE, 40, 2**32 - 1), "truncated"),
    (Reference, words(REFERENCE, 48 + 96, 2**32 - 1), "length"),
    (Reference, byte(REFERENCE, 32, 2), "value"),
    (Command, encode(replace(COMMAND, u=np.array([[np.nan]]))), "not_finite"),
    (Command, encode(replace(COMMAND, u=np.zeros((0, 2)))), "length"),
    (Reference, encode(replace(REFERENCE, stamp_ns=STAMP_ON_ARRIVAL + 1)), "value"),
    (Reference, encode(replace(REFERENCE, period_ns=2**62)), "value"),
    (Command, encode(replace(COMMAND, period_ns=0)), "value"),
    (Command, encode(replace(COMMAND, period_ns=2**62)), "value"),
    (Command, encode(replace(COMMAND, stamp_ns=-(2**62))), "value"),
    (Command, encode(replace(COMMAND, state_stamp_ns=2**62)), "value"),
    (Command, encode(replace(COMMAND, valid_until_ns=2**63 - 1)), "value"),
    (Command, encode(replace(COMMAND, **(WAY | {"rest_period_ns": 0}))), "value"),
    (Command, encode(replace(COMMAND, **(WAY | {"rest_period_ns": -1}))), "value"),
    (Command, encode(replace(COMMAND, **(WAY | {"x_rest": np.zeros((2, 5))}))), "length"),
    (Command, encode(replace(COMMAND, **(WAY | {"K": np.zeros((1, 5))}))), "length"),
    (Command, encode(replace(COMMAND, **(WAY | {"u_rest": np.full((3, 2), np.nan)}))), "not_finite"),
    (Command, byte(COMMAND, 64, 7), "value"),
    (Command, byte(COMMAND, 65, 255), "value"),
    (Command, words(COMMAND, 80, 3), "length"),
    (Telemetry, byte(TELEMETRY, 40, 99), "value"),
    (Telemetry, words(TELEMETRY, 184, 4), "length"),
    (Telemetry, encode(TELEMETRY)[:-8], "truncated"),
    (Telemetry, encode(replace(TELEMETRY, y=np.zeros(2))), "length"),
    (Journal, byte(JOURNAL, 40, 3), "value"),
    (Journal, words(JOURNAL, 44, 4), "truncated"),
    (Journal, words(JOURNAL, 44, 2), "oversized"),
    (Event, words(EVENT, 24, 2**32 - 1), "truncated"),
    (Event, words(EVENT, 24, 0), "text"),
    (Event, words(EVENT, 24, 5), "text"),
    (Event, byte(EVENT, 28, 0xFF), "text"),
    (Event, byte(EVENT, 34, 3), "value"),
    (Event, encode(EVENT) + b"\x00", "oversized"),
    (Event, encode(EVENT).replace(b"stehen", b"ste\x1b[m"), "text"),
    (Event, encode(EVENT).replace(b"stehen", b"st\neen"), "text"),
    (Event, encode(replace(EVENT, source=60 * "r")).replace(b"\x3d\x00\x00\x00rr", b"\x41\x00\x00\x00rr"), "text"),
    (Event, encode(STATE), "text"),
]


@pytest.mark.parametrize(("cls", "payload", "reason"), MALFORMED)
def test_malformed_bytes_are_refused_with_their_reason(cls: type[Message], payload: bytes, reason: str) -> None:
    with pytest.raises(Refused) as refusal:
        decode(cls, payload)
    assert refusal.value.reason == reason
    assert reason in REFUSAL_REASONS
    assert isinstance(refusal.value, MessageError)
    assert len(str(refusal.value)) < 200


@pytest.mark.parametrize("message", [STATE, REFERENCE, COMMAND, TELEMETRY, JOURNAL, EVENT])
def test_every_truncation_is_refused(message: Message) -> None:
    payload = encode(message)
    for size in range(len(payload)):
        with pytest.raises(Refused):
            decode(type(message), payload[:size])


@pytest.mark.parametrize("message", [STATE, REFERENCE, COMMAND, TELEMETRY, EVENT])
def test_mutated_bytes_give_a_message_or_a_refusal(message: Message) -> None:
    rng = np.random.default_rng(2)
    payload = np.frombuffer(encode(message), np.uint8)
    refused = 0
    for _ in range(3000):
        mutant = payload[: rng.integers(len(payload) + 1)].copy() if rng.random() < 0.2 else payload.copy()
        at = rng.integers(0, max(1, min(len(mutant), 160)), size=rng.integers(1, 6))
        mutant[at[at < len(mutant)]] = rng.choice([0, 1, 127, 128, 255, rng.integers(256)])
        try:
            decode(type(message), mutant.tobytes())
        except Refused:
            refused += 1
    assert 0 < refused < 3000


@pytest.mark.parametrize("cls", [State, Reference, Command, Telemetry, Event])
def test_random_bytes_behind_our_header_are_refused(cls: type[Message]) -> None:
    rng = np.random.default_rng(3)
    for size in rng.integers(0, 400, size=500):
        with pytest.raises(Refused):
            decode(cls, b"\x00\x01\x00\x00" + rng.bytes(size))


def test_declared_lengths_allocate_nothing() -> None:
    payload = words(STATE, 24, 2**32 - 1)
    tracemalloc.start()
    with pytest.raises(Refused):
        decode(State, payload)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100_000


@pytest.mark.parametrize("name", ["x", "u"])
def test_numbers_whose_squares_are_finite_are_accepted_and_no_larger_ones(name: str) -> None:
    largest = np.array([1e18, -1e18, 5e-324, -0.0])
    assert np.array_equal(getattr(decode(State, encode(replace(STATE, **{name: largest}))), name), largest)
    with pytest.raises(Refused, match=f"{name} must be finite and at most 1e"):
        decode(State, encode(replace(STATE, **{name: np.array([1e308])})))


def test_rows_that_a_robot_plays_last_as_long_as_the_shortest_period_of_a_controller() -> None:
    assert decode(Command, encode(replace(COMMAND, period_ns=100_000))).period_ns == 100_000
    for wrong in ({"period_ns": 99_999}, WAY | {"rest_period_ns": 99_999}):
        with pytest.raises(Refused, match="period_ns must be"):
            decode(Command, encode(replace(COMMAND, **wrong)))


def test_texts_are_printed_as_one_line_and_cut_to_what_receivers_take() -> None:
    said = decode(Event, encode(replace(EVENT, code=100 * "c", text="first\nsecond\x1b[31m \ud800 " + 5000 * "ä")))
    assert said.code == 63 * "c"
    assert said.text.startswith("first second [31m ")
    assert 4090 < len(said.text.encode()) < 4096


@pytest.mark.parametrize("module", ["rti_mpc.wire", "rti_mpc.wire.cdr", "rti_mpc.wire.intake", "rti_mpc.wire.bus"])
def test_the_wire_loads_neither_casadi_nor_osqp(module: str) -> None:
    check = f"import sys, {module}; assert not {{'casadi', 'osqp', 'qpsolvers', 'scipy'}} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", check], cwd=ROOT, check=True, timeout=20)


def test_message_says_what_the_certificate_of_a_plan_is_relative_to() -> None:
    """Or whoever reads `res_dual` off a recording would take it for a hundred times what it is."""
    assert f"above the optimum, relative to {COST_FLOOR:g} plus the cost, normalised;" in msg_text(Telemetry)
