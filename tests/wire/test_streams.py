# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest
import zenoh

from rti_mpc.wire.bus import RING_MESSAGES
from rti_mpc.wire.layout import LAYOUTS
from rti_mpc.wire.streams import COMMAND, EVENT, INFO, KNOWN_ROLES, MAX_RING_BYTES, REFERENCE, STATE, STREAMS, TELEMETRY, Kind, Stream, admitted

MESSAGES = [stream for stream in STREAMS if stream.kind is Kind.MESSAGE]


def test_no_two_streams_share_a_key() -> None:
    assert len({stream.name for stream in STREAMS}) == len(STREAMS)


def test_every_message_has_a_stream() -> None:
    assert {stream.message for stream in STREAMS} == {*LAYOUTS, None}


@pytest.mark.parametrize("stream", STREAMS, ids=lambda stream: stream.name)
def test_a_row_names_roles_that_everybody_knows_and_words_of_zenoh(stream: Stream[object]) -> None:
    assert stream.publishers
    assert {*stream.publishers, *stream.askers} <= set(KNOWN_ROLES)
    assert bool(stream.askers) == (stream.kind is Kind.QUERY)
    assert hasattr(zenoh.Priority, stream.qos.priority)
    assert hasattr(zenoh.CongestionControl, stream.qos.congestion)


@pytest.mark.parametrize("stream", MESSAGES, ids=lambda stream: stream.name)
def test_no_message_waits_for_a_congested_link(stream: Stream[object]) -> None:
    assert stream.qos.congestion == "DROP"


@pytest.mark.parametrize("stream", MESSAGES, ids=lambda stream: stream.name)
def test_a_ring_of_the_longest_messages_is_bounded(stream: Stream[object]) -> None:
    assert stream.capacity(10**9) * stream.max_bytes <= MAX_RING_BYTES


@pytest.mark.parametrize("stream", [STATE, COMMAND, EVENT, INFO], ids=lambda stream: stream.name)
def test_what_is_foreign_displaces_nothing_where_that_counts(stream: Stream[object]) -> None:
    assert stream.capacity(RING_MESSAGES) == RING_MESSAGES


def test_rings_of_long_messages_are_shorter() -> None:
    assert (REFERENCE.capacity(RING_MESSAGES), TELEMETRY.capacity(RING_MESSAGES)) == (128, 512)


def test_roles_of_the_table_are_admitted_however_many_others_there_are() -> None:
    strangers = {f"event/stranger_{k}" for k in range(1000)}
    assert all(admitted(f"event/{role}", strangers) for stream in STREAMS for role in stream.publishers)
    assert not admitted("event/one_more", strangers)
