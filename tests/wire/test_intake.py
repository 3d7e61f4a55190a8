# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rti_mpc.contract.epoch import epoch_above, highest_believed
from rti_mpc.contract.message import Command, End, Reference, Severity, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.wire.bus import Received
from rti_mpc.wire.cdr import Message, encode, encoding
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.layout import MAX_PAYLOAD_BYTES

STATE = State(5, 1, 0, np.arange(5.0))
REFERENCE = Reference(5, 1, 0, 10**8, End.HOLD, np.zeros((4, 3)), np.zeros((4, 0)))
COMMAND = Command(5, 1, 0, 1, 1, 0, 10**9, 0, Mode.TRACKING, QpStatus.SOLVED, 10**8, np.zeros((7, 2)))
SECOND_NS = 10**9


def received(message: Message) -> Received:
    return Received(encode(message), encoding(type(message)), "key")


def test_a_message_from_our_source_passes() -> None:
    intake = Intake(State, stale_s=1.0, widths={"x": 5})
    message = intake.accept(received(STATE), 0)
    assert message is not None
    assert np.array_equal(message.x, STATE.x)
    assert intake.notices(0) == []


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        ("", "encoding"),
        ("zenoh/bytes", "encoding"),
        ("application/json;rti_mpc_msgs/msg/State@2", "encoding"),
        ("application/cdr", "schema"),
        ("application/cdr;rti_mpc_msgs/msg/Command@2", "schema"),
        ("application/cdr;rti_mpc_msgs/msg/State@1", "version"),
        ("application/cdr;rti_mpc_msgs/msg/State", "version"),
        ("x" * 10**6, "encoding"),
    ],
)
def test_other_encodings_schemas_and_versions_are_refused(other: str, reason: str) -> None:
    intake = Intake(State, stale_s=1.0)
    assert intake.accept(replace(received(STATE), encoding=other), 0) is None
    assert intake.refused == {reason: 1}
    (notice,) = intake.notices(0)
    assert notice.code == "message_refused"
    assert len(notice.text) < 400


@pytest.mark.parametrize(
    ("message", "widths"),
    [
        (STATE, {"x": 4}),
        (REFERENCE, {"y": 2}),
        (replace(REFERENCE, p=np.zeros((4, 3))), {"y": 3, "p": 4}),
        (COMMAND, {"u": 3}),
    ],
)
def test_rows_of_another_width_are_refused(message: Message, widths: dict[str, int]) -> None:
    intake = Intake(type(message), stale_s=1.0, widths=widths)
    assert intake.accept(received(message), 0) is None
    assert intake.refused == {"length": 1}
    assert intake.source.epoch is None


def test_inputs_of_a_state_may_be_left_out_but_not_be_of_another_number() -> None:
    intake = Intake(State, stale_s=1.0, widths={"x": 5, "u": 2})
    assert intake.accept(received(replace(STATE, seq=1, u=np.zeros(0))), 0) is not None
    assert intake.accept(received(replace(STATE, seq=2, u=np.zeros(2))), 1) is not None
    assert intake.accept(received(replace(STATE, seq=3, u=np.zeros(3))), 2) is None
    assert Intake(State, stale_s=1.0, widths={"x": 5}).accept(received(replace(STATE, x=np.zeros(0))), 0) is None
    assert Intake(Command, stale_s=1.0, widths={"u": 2}).accept(received(replace(COMMAND, u=np.zeros((7, 0)))), 0) is None


def test_stage_parameters_may_be_left_out() -> None:
    assert Intake(Reference, stale_s=1.0, widths={"y": 3, "p": 4}).accept(received(REFERENCE), 0) is not None


def test_a_second_publisher_takes_nothing_over() -> None:
    intake = Intake(State, stale_s=1.0)
    for seq in range(10):
        assert intake.accept(received(replace(STATE, seq=2 * seq)), seq) is not None
        assert intake.accept(received(replace(STATE, epoch=4, seq=2 * seq + 1)), seq) is None
    assert intake.source.epoch == 5
    assert intake.source.dropped == 10
    (notice,) = intake.notices(10)
    assert (notice.severity, notice.code) == (Severity.WARNING, "source_refused")
    assert "epoch 4" in notice.text


def test_a_restarted_publisher_takes_over_and_is_announced() -> None:
    intake = Intake(State, stale_s=1.0)
    intake.accept(received(STATE), 0)
    assert intake.notices(0) == []
    assert intake.accept(received(replace(STATE, epoch=6, seq=0)), 1) is not None
    assert [notice.code for notice in intake.notices(1)] == ["source_changed"]


YEAR_2026, YEAR_2105 = 1_770_000_000, 4_270_000_000


@pytest.mark.parametrize(
    ("unix_s", "followed", "epoch", "passes"),
    [
        (0, None, YEAR_2105 << 20, True),  # our clock stands at 1970, theirs does not
        (0, None, 1 << 52, True),
        (0, None, (1 << 52) + 1, False),
        (YEAR_2026, None, 0, True),
        (YEAR_2026, None, 1000 * YEAR_2026, True),  # a robot's, ms
        (YEAR_2026, None, (YEAR_2026 << 20) + 2**52, True),
        (YEAR_2026, None, (YEAR_2026 << 20) + 2**52 + 1, False),
        (YEAR_2026, 1 << 60, (1 << 60) + (1 << 22), True),  # above whatever was let pass others can be
        (YEAR_2026, 1 << 60, (1 << 60) + (1 << 22) + 1, False),
        (YEAR_2026, 5, 2**63, False),
        (YEAR_2026, 5, 2**64 - 1, False),
    ],
)
def test_epochs_are_believed_that_time_can_have_reached(unix_s: int, followed: int | None, epoch: int, passes: bool) -> None:
    intake = Intake(State, stale_s=1.0, unix_s=lambda: unix_s)
    intake.source.epoch = followed
    assert (intake.accept(received(replace(STATE, epoch=epoch)), 0) is not None) is passes
    assert intake.refused["epoch"] == (not passes)


def test_what_those_who_take_an_epoch_believe_is_believed_by_those_who_choose_one_above_it() -> None:
    """Where clocks differ by less than a minute; and their choice is believed at once, or by others when time has gone on."""
    now_s = [YEAR_2026]
    taker, late = (Intake(State, stale_s=1.0, unix_s=lambda: now_s[0]) for _ in range(2))
    chooser = Intake(State, stale_s=1.0, unix_s=lambda: now_s[0] - 60, choosing=True)
    highest = highest_believed(YEAR_2026)
    for intake in (taker, chooser):
        assert intake.accept(received(replace(STATE, epoch=highest)), 0) is not None
    assert chooser.highest_epoch([received(replace(STATE, epoch=highest))]) == highest
    for number in range(0, 1 << 20, 99_991):
        choice = received(replace(STATE, epoch=epoch_above(highest, number)))
        now_s[0] = YEAR_2026
        assert taker.read(choice) is not None
        assert late.read(choice) is None
        now_s[0] += 1
        assert late.read(choice) is not None


@pytest.mark.parametrize("message", [STATE, REFERENCE, COMMAND])
def test_what_is_longer_than_its_key_takes_is_refused_unread(message: Message) -> None:
    intake, most = Intake(type(message), stale_s=1.0), MAX_PAYLOAD_BYTES[type(message)]
    assert intake.accept(Received(b"", encoding(type(message)), "key", withheld=most + 1), 0) is None
    assert intake.accept(replace(received(message), payload=encode(message).ljust(most + 1)), 0) is None
    assert intake.refused == {"oversized": 2}
    (notice,) = intake.notices(0)
    assert f"at most {most} bytes, got {most + 1}" in notice.text


def test_what_a_cache_repeats_is_dropped_in_silence() -> None:
    intake = Intake(Reference, stale_s=1.0)
    assert intake.accept(received(REFERENCE), 0) is not None
    assert intake.accept(received(REFERENCE), 1) is None
    assert intake.source.dropped == 1
    assert intake.notices(1) == []


def test_notices_are_rate_limited_by_code_and_count_what_was_not_said() -> None:
    intake = Intake(State, stale_s=1.0, quiet_s=1.0)
    said = []
    for millisecond in range(3000):
        now_ns = millisecond * 10**6
        assert intake.accept(Received(b"", encoding(State), "key"), now_ns) is None
        said += intake.notices(now_ns)
    assert len(said) == 3
    assert said[-1].text.endswith("2001 refused so far")
    intake.accept(received(STATE), 0)
    intake.accept(received(replace(STATE, epoch=1)), 0)
    assert [notice.code for notice in intake.notices(3 * SECOND_NS)] == ["message_refused", "source_refused"]


def test_nothing_a_peer_sends_raises() -> None:
    rng = np.random.default_rng(4)
    intakes = [Intake(State, 1.0, {"x": 5}), Intake(Reference, 1.0, {"y": 3}), Intake(Command, 1.0, {"u": 2})]
    seeds = [np.frombuffer(encode(message), np.uint8) for message in (STATE, REFERENCE, COMMAND)]
    for n in range(6000):
        intake, seed = intakes[n % 3], seeds[rng.integers(3)]
        payload = seed[: rng.integers(len(seed) + 1)].copy() if rng.random() < 0.3 else seed.copy()
        payload = np.append(payload, rng.integers(0, 256, size=rng.integers(20), dtype=np.uint8)) if rng.random() < 0.2 else payload
        spots = rng.integers(0, max(1, len(payload)), size=rng.integers(8))
        payload[spots[spots < len(payload)]] = rng.integers(256, dtype=np.uint8)
        intake.accept(Received(payload.tobytes(), encoding((State, Reference, Command)[n % 3]), "key"), n)
        intake.notices(n)
    for intake in intakes:
        assert {"truncated", "oversized", "header"} <= set(intake.refused)
