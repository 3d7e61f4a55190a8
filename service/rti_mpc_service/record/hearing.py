# SPDX-License-Identifier: Apache-2.0
"""
Hearing of one robot: its streams, each received by a thread of its own that notes the time of arrival.

What waits for a thread waits in Zenoh's ring, which drops the oldest: a recorder that is
held up delays nobody.
"""

from __future__ import annotations

import base64
import logging
import time
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from threading import Thread
from typing import Any

from rti_mpc.errors import MessageError
from rti_mpc.wire import document
from rti_mpc.wire.bus import RING_MESSAGES, Bus, Subscriber
from rti_mpc.wire.received import Received
from rti_mpc.wire.streams import INFO, PING, PONG, STREAMS, Kind, Stream
from rti_mpc_service.record.inbox import Arrived, Inbox

HEARD: tuple[Stream[Any], ...] = tuple(stream for stream in STREAMS if stream.kind is Kind.MESSAGE and stream not in (PING, PONG))
ASK_TIMEOUT_S = 2.0
MAX_BUNDLE_BYTES = 1 << 24  # of a controller's files
MAX_PIECES = 1000  # of them; a controller sends the longest in 420

log = logging.getLogger(__name__)


def hear(bus: Bus, inbox: Inbox, describe: Callable[[str, Received], object]) -> None:
    """Put all messages of a robot into an inbox, until the bus is closed, and hand over descriptions at once: who publishes one may soon be dead."""
    robot = bus.keys.robot
    for stream in HEARD:
        subscriber = bus.subscriber(bus.keys.of(stream, "*"), capacity=RING_MESSAGES)

        def follow(subscriber: Subscriber = subscriber, stream: Stream[Any] = stream) -> None:
            while (received := subscriber.recv()) is not None:
                inbox.put(Arrived(robot, stream, time.monotonic_ns(), received))
                if stream is INFO:
                    describe(robot, received)

        Thread(target=follow, name=f"{robot}/{stream.name}", daemon=True).start()


def fetch_origin(bus: Bus, owner: int, give: Callable[[Mapping[str, str]], object]) -> None:
    """Ask a controller for its files, in a thread of its own, and give them; a line in the log if it has none."""

    def ask() -> None:
        pieces, begin = list[str](), 0
        for _ in range(MAX_PIECES):
            answers = (answer for answer in bus.answers(bus.keys.origin, {"from": begin}, ASK_TIMEOUT_S) if answer.get("owner") == owner)
            answer = next(answers, {})
            piece, size = answer.get("piece"), answer.get("size", 0)
            if not (isinstance(piece, str) and piece and type(size) is int and size <= MAX_BUNDLE_BYTES):
                break
            pieces.append(piece)
            begin += len(piece)
            if begin < size:
                continue
            with suppress(ValueError, MessageError, zlib.error):
                bundle = zlib.decompressobj().decompress(base64.b64decode("".join(pieces)), MAX_BUNDLE_BYTES)
                give({name: str(text) for name, text in document.read(bundle, most=MAX_BUNDLE_BYTES).items()})
                return
            break
        log.warning("%s: a controller has not sent its configuration and model: they are missing in the recording", bus.keys.robot)

    Thread(target=ask, name=f"{bus.keys.robot}/origin", daemon=True).start()
