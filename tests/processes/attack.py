# SPDX-License-Identifier: Apache-2.0
"""Attacker on the bus: a thousand messages per second over all keys, malformed, out of range or replayed."""

from __future__ import annotations

import json
import time
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import zenoh

from rti_mpc.contract.message import Command, Event, Reference, Severity, State, Telemetry
from rti_mpc.errors import MessageError
from rti_mpc.wire.cdr import decode, encode, encoding
from rti_mpc.wire.keys import Keys

RATE_HZ = 1000
BATCH_MESSAGES = 10  # sent at once
CROWD_HZ = 2000  # on each of two keys
CROWD_MESSAGES = 10  # sent at once
REMEMBERED_MESSAGES = 500  # per key, of which some are replayed
MIN_REPLAY_AGE_S = 1.0  # age of a replayed message
HUGE = {"info/controller": 50 << 20, "command": 60 << 20}  # bytes, once in a `run`

CLASSES: dict[str, type[Any]] = {
    "state": State,
    "command": Command,
    "actuation": Command,
    "reference": Reference,
    "reference/anchored": Reference,
    "telemetry": Telemetry,
    "event/robot": Event,
    "event/controller": Event,
}
STAMPS = (2**62, 2**63 - 1, -(2**62), 1 - 2**63)
PERIODS = (0, -1, 1, 99_999, 3_600_000_000_001, 2**62)
NUMBERS = (np.nan, np.inf, -np.inf, 1e308, -1.1e18)
ABSURD: dict[type[Any], dict[str, tuple[Any, ...]]] = {
    State: {"stamp_ns": STAMPS, "x": NUMBERS, "u": NUMBERS},
    Command: {"stamp_ns": STAMPS, "state_stamp_ns": STAMPS, "valid_until_ns": STAMPS, "period_ns": PERIODS, "u": NUMBERS, "state_epoch": (9,)},
    Reference: {"stamp_ns": STAMPS, "period_ns": PERIODS[:3], "y": NUMBERS},
    Telemetry: {"stamp_ns": STAMPS, "state_stamp_ns": STAMPS},
    Event: {"stamp_ns": STAMPS},
}
DOCUMENTS = (
    b"",
    b"{",
    b"[]",
    b"\xff",
    20_000 * b"[",
    b'{"epoch": Infinity}',
    b'{"role": "controller", "epoch": 1' + 400 * b"0" + b"}",
    b'{"role": "\\ud800"}',
    b'{"role": "guard", "states": 3}',
)


class Attack:
    """
    One peer that sends.

    Attributes:
        sent: Messages so far.
    """

    def __init__(self, endpoint: str, keys: Keys, seed: int) -> None:
        config = zenoh.Config()
        for name, value in {"mode": '"peer"', "connect/endpoints": f'["{endpoint}"]', "listen/endpoints": '["tcp/127.0.0.1:0"]'}.items():
            config.insert_json5(name, value)
        config.insert_json5("scouting/multicast/enabled", "false")
        self.sent = 0
        self._session = zenoh.open(config)
        self._keys = keys
        self._rng = np.random.default_rng(seed)
        self._heard: defaultdict[str, deque[tuple[float, bytes, str]]] = defaultdict(lambda: deque(maxlen=REMEMBERED_MESSAGES))
        self._memory = self._session.declare_subscriber(keys.below("**"), zenoh.handlers.RingChannel(4096), allowed_origin=zenoh.Locality.REMOTE)
        self._tokens = [self._session.liveliness().declare_token(keys.alive(f"standby.{number}")) for number in range(100)]
        self._tokens += [self._session.liveliness().declare_token(keys.alive(name)) for name in ("standby.²", "standby.-1", "Ä", 200 * "x")]

    def __enter__(self) -> Attack:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()

    def run(self, messages: int) -> None:
        """Send this number of messages, at `RATE_HZ`."""
        due_s, last = time.monotonic(), self.sent + messages
        for stream, size in HUGE.items():
            self._put(stream, bytes(size), "application/json", block=True)
        while self.sent < last:
            self.listen()
            due = self.sent + BATCH_MESSAGES
            while self.sent < due:
                self._send()
            due_s += BATCH_MESSAGES / RATE_HZ
            time.sleep(max(0.0, due_s - time.monotonic()))

    def crowd(self, seconds: float) -> None:
        """Send twenty malformed messages after each state, and 2000 per second of an old state and of a foreign command."""
        states = self._session.declare_subscriber(self._keys.state, zenoh.handlers.RingChannel(16), allowed_origin=zenoh.Locality.REMOTE)
        others = {"state": encode(self.last(State, "state")), "command": encode(replace(self.last(Command, "command"), epoch=1, seq=1))}
        due_s = end_s = time.monotonic() + seconds
        due_s -= seconds
        while due_s < end_s:
            while states.try_recv() is not None:
                for _ in range(20):
                    self._put("state", self._rng.bytes(100), encoding(State))
            for stream, payload in others.items():
                for _ in range(CROWD_MESSAGES):
                    self._put(stream, payload, encoding(CLASSES[stream]))
            due_s += CROWD_MESSAGES / CROWD_HZ
            time.sleep(max(0.0, due_s - time.monotonic()))
        states.undeclare()

    def listen(self) -> None:
        """Remember what others send."""
        while (sample := self._memory.try_recv()) is not None:
            stream = str(sample.key_expr).removeprefix(self._keys.below(""))
            if len(sample.payload) < 1 << 20:
                self._heard[stream].append((time.monotonic(), sample.payload.to_bytes(), str(sample.encoding)))

    def heard(self, stream: str) -> bool:
        """Whether other processes have sent a message on a stream."""
        self.listen()
        return bool(self._heard[stream])

    def forge(self, cls: type[Any], stream: str, **change: Any) -> None:
        """Send the last message of a stream with some fields changed, well-formed."""
        self.listen()
        self._put(stream, encode(replace(decode(cls, self._heard[stream][-1][1]), **change)), encoding(cls))

    def last(self, cls: type[Any], stream: str) -> Any:
        """Return the last message that others sent."""
        self.listen()
        return decode(cls, self._heard[stream][-1][1])

    def _send(self) -> None:
        kinds: tuple[Callable[[], None], ...] = (self._malformed, self._out_of_range, self._replayed, self._foreign, self._request, self._presence)
        kinds[self._rng.choice(len(kinds), p=(0.3, 0.3, 0.3, 0.06, 0.02, 0.02))]()

    def _malformed(self) -> None:
        """Bytes of a message with some changed, cut off, or of another encoding."""
        stream = self._stream()
        _, payload, kind = self._sample(stream)
        if payload is None:
            return
        mutant = bytearray(payload[: int(self._rng.integers(len(payload) + 1))] if self._rng.random() < 0.3 else payload)
        for at in self._rng.integers(0, max(1, len(mutant)), size=4):
            if at < len(mutant):
                mutant[at] = self._rng.integers(256)
        try:
            decode(CLASSES[stream], bytes(mutant))
        except MessageError:
            self._put(stream, bytes(mutant), kind)
        else:  # a message all the same
            self._put(stream, bytes(mutant), str(self._rng.choice(["", "application/json", kind.replace("@2", "@1"), 200 * "x"])))

    def _out_of_range(self) -> None:
        """A message with a number out of range."""
        stream = self._stream()
        _, payload, kind = self._sample(stream)
        if payload is None:
            return
        cls = CLASSES[stream]
        message = decode(cls, payload)
        absurd = ABSURD[cls] | {"epoch": (2**63, 2**64 - 1), "seq": (message.seq + 10**6 + 10**4, 2**64 - 1)}
        name = str(self._rng.choice(list(absurd)))
        value = absurd[name][self._rng.integers(len(absurd[name]))]
        if isinstance(value, float):
            array = np.array(getattr(message, name))
            array.flat[: 1 + len(array) // 2] = value
            value = array if array.size else np.array([value])
        self._put(stream, encode(replace(message, **{name: value})), kind)

    def _replayed(self) -> None:
        """A message that was sent before, behind later ones."""
        stream = str(self._rng.choice(list(self._heard))) if self._heard else "state"
        sent_s, payload, kind = self._sample(stream)
        if payload is not None and sent_s < time.monotonic() - MIN_REPLAY_AGE_S and not stream.startswith(("info", "alive")):
            self._put(stream, payload, kind)

    def _foreign(self) -> None:
        """Descriptions and events of unknown roles, and messages on unknown streams."""
        role = f"role_{self._rng.integers(1000)}"
        document = DOCUMENTS[self._rng.integers(len(DOCUMENTS))]
        what = self._rng.integers(4)
        if what == 0:
            self._put("info/controller", document, "application/json")
        elif what == 1:
            self._put(f"info/{role}", json.dumps({"role": role}).encode(), "application/json")
        elif what == 2:
            self._put(f"event/{role}", encode(Event(1, self.sent, 0, role, Severity.ERROR, "code", "text")), encoding(Event))
        else:
            self._put(role, self._rng.bytes(100), "zenoh/bytes")

    def _request(self) -> None:
        """A malformed request."""
        self.sent += 1
        payload = DOCUMENTS[self._rng.integers(len(DOCUMENTS))]
        self._session.get(self._keys.request, zenoh.handlers.RingChannel(1), payload=payload, timeout=0.5)

    def _presence(self) -> None:
        """A presence that appears and disappears."""
        self.sent += 1
        self._session.liveliness().declare_token(self._keys.alive(f"standby.{self._rng.integers(10**6)}")).undeclare()

    def _stream(self) -> str:
        return str(self._rng.choice(list(CLASSES)))

    def _sample(self, stream: str) -> tuple[float, bytes | None, str]:
        heard = self._heard[stream]
        return heard[self._rng.integers(len(heard))] if heard else (0.0, None, "")

    def _put(self, stream: str, payload: bytes, kind: str, *, block: bool = False) -> None:
        self.sent += 1
        control = zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP
        self._session.put(self._keys.below(stream), payload, encoding=kind, congestion_control=control, express=True)
