# SPDX-License-Identifier: Apache-2.0
"""
The bus: bytes in and out over Zenoh, with every trap of it closed off.

* Whatever is received waits in a ring of fixed size that drops the oldest: an
  unread subscriber stops nobody, and no Python runs in a thread of Zenoh.
* Whatever is sent is dropped rather than waited for where a link is congested.
* A session hears nothing of what it publishes itself.
* `Bus.close` is bounded, unblocks every `recv`, and the interpreter then exits.
"""

from __future__ import annotations

import json
import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any, Generic

import zenoh
from zenoh import ext

from rti_mpc.errors import MessageError
from rti_mpc.wire import document
from rti_mpc.wire.cdr import M, encode, encoding
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.keys import Key, Keys
from rti_mpc.wire.reach import remind
from rti_mpc.wire.session import BusSettings as BusSettings
from rti_mpc.wire.session import endpoints, open_session, zenoh_config
from rti_mpc.wire.streams import MAX_REQUEST_BYTES, role_of

CLOSE_TIMEOUT_S = 0.5
HEARTBEAT_S = 1.0  # of a cached publisher, which tells the number of its last message
MAX_ENCODING = 256  # characters of an encoding that are looked at
RING_MESSAGES = 1024  # that wait for a receiver: half a second of it being held up, at 2000 a second of anybody's
RING_TOKENS = 1024  # changes of presence that wait to be told
RING_QUERIES = 16  # requests that wait to be answered
JSON = "application/json"  # encoding of descriptions, requests and answers
RETRY_S = 0.1  # between two looks for somebody who is not there yet


@dataclass(frozen=True, slots=True)
class Received:
    """
    A payload as it came, not yet looked at.

    Attributes:
        payload: Its bytes; none where they are more than its key takes.
        encoding: What the sender says they are.
        key: Where it was published.
        withheld: How many bytes were sent, where there are none in `payload` for it.
    """

    payload: bytes
    encoding: str
    key: str
    withheld: int = 0

    @property
    def size(self) -> int:
        """How many bytes were sent."""
        return self.withheld or len(self.payload)


give_way: Callable[[], None] = getattr(os, "sched_yield", lambda: None)  # not on every system


def unix_s() -> int:
    """Return the Unix time, s: of no two hosts the same, and good enough to tell what epochs there can be."""
    return time.time_ns() // 1_000_000_000


class Publisher(Generic[M]):
    """Sends the messages of a stream. `put` never blocks, and after `Bus.close` does nothing."""

    def __init__(self, publisher: zenoh.Publisher | ext.AdvancedPublisher, *, realtime: bool = False) -> None:
        self._publisher = publisher
        self._realtime = realtime

    @property
    def heard(self) -> bool:
        """Whether anybody listens now; of a cached publisher always true, since its last message waits for them."""
        if not isinstance(self._publisher, zenoh.Publisher):
            return True
        status: Any = self._publisher.matching_status  # an object, always true, whatever its type hint says
        return bool(status.matching)

    def put(self, message: M) -> None:
        """Send a message to whoever listens now, and to late joiners if the publisher is cached."""
        self.put_bytes(encode(message))

    def put_bytes(self, payload: bytes) -> None:
        """Send bytes as they are."""
        try:
            self._publisher.put(payload)
        except zenoh.ZError as error:
            if "closed" not in str(error):
                raise
        if self._realtime:
            give_way()  # to the thread that sends it: whoever puts goes on computing, and cores may be few

    def undeclare(self) -> None:
        """Leave the key."""
        publisher: Any = self._publisher
        publisher.undeclare()


class Subscriber:
    """Receives from one key expression into a ring: the newest samples, oldest first. After `Bus.close`, nothing."""

    def __init__(self, subscriber: zenoh.Subscriber[Any] | ext.AdvancedSubscriber[Any], key: Key[Any], capacity: int, own: str) -> None:
        self._subscriber = subscriber
        self._capacity = capacity
        self._handler = subscriber.handler
        self._key = "" if "*" in key else str(key)
        self._max_bytes = key.stream.max_bytes
        self._own = own  # a cache answers its own session, too
        self._encoding: tuple[zenoh.Encoding | None, str] = None, ""  # the last one, and its text: to compare costs a fifth of making it

    def recv(self) -> Received | None:
        """Next sample, waiting for it; None once the bus is closed."""
        try:
            while (received := self._received(self._handler.recv())) is None:
                pass
        except zenoh.ZError:
            return None
        return received

    def try_recv(self) -> Received | None:
        """Next sample, None if there is none now."""
        try:
            while (sample := self._handler.try_recv()) is not None:
                if (received := self._received(sample)) is not None:
                    return received
        except zenoh.ZError:
            return None
        return None

    def drain(self) -> list[Received]:
        """All samples there are now, oldest first, and of those that come meanwhile no more than the ring holds."""
        return list(islice(iter(self.try_recv, None), self._capacity))

    def _received(self, sample: zenoh.Sample) -> Received | None:
        if self._own and (info := sample.source_info) is not None and str(info.source_id.zid) == self._own:
            return None
        if sample.encoding != self._encoding[0]:
            self._encoding = sample.encoding, str(sample.encoding)[:MAX_ENCODING]
        key, size = self._key or str(sample.key_expr), len(sample.payload)
        if size > self._max_bytes:
            return Received(b"", self._encoding[1], key, withheld=size)  # not even copied
        return Received(sample.payload.to_bytes(), self._encoding[1], key)


class Bus:
    """
    One process on the bus of one robot.

    Attributes:
        keys: Where the streams are.
        closed: Whether `close` was called.
    """

    def __init__(
        self,
        settings: BusSettings,
        keys: Keys,
        *,
        timeout_s: float = math.inf,
        stop: threading.Event | None = None,
        say: Callable[[str], object] = lambda _: None,
    ) -> None:
        """
        Join the bus.

        Args:
            settings: How.
            keys: Of which robot.
            timeout_s: How long a client waits for its router.
            stop: Ends that wait when set.
            say: Takes a line about who is not reached.

        Raises:
            ConfigError: Zenoh refuses a setting, an endpoint is taken, or no router was there in time.
            Stopped: The wait was ended by `stop`.
        """
        self.keys = keys
        self.closed = False
        self._say = say
        self._config = zenoh_config(settings)
        self._over = threading.Event()
        self._session = open_session(settings, timeout_s, stop, say)
        self._declared: list[Any] = []  # queryables and watches, which live as long as their objects
        self._publishers: dict[str, Publisher[Any]] = {}  # by key: whoever changes its role and back publishes there as before
        self._tokens: dict[str, zenoh.LivelinessToken] = {}  # by role

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bus within half a second, even where Zenoh takes longer; every `recv` returns None."""
        if self.closed:
            return
        self.closed = True
        self._over.set()
        closing = threading.Thread(target=self._session.close, daemon=True)
        closing.start()
        closing.join(CLOSE_TIMEOUT_S)

    def expect(self, what: str, heard: Callable[[], object]) -> None:
        """
        Remind of what does not come, and whom this process is linked to, until it has.

        Args:
            what: Such as ``"state"``.
            heard: Whether it has come.
        """

        def wanted() -> str:
            if heard():
                return ""
            try:
                links = len(self._session.info.peers_zid()) + len(self._session.info.routers_zid())
            except zenoh.ZError:  # the bus is closed
                return ""
            if links:
                return f"no {what} of {self.keys.prefix}/{self.keys.robot} yet, from {links} others on the bus: is it running, and of this name?"
            where = endpoints(self._config)
            return f"not connected, no {what} yet: " + (f"nobody answers at {where}" if where else "nobody has come to the endpoints listened on")

        remind(self._say, wanted, self._over)

    def publisher(self, key: Key[M]) -> Publisher[M]:
        """Publisher of the messages of a stream, the same one whenever a key is asked for again."""
        if key not in self._publishers:
            self._publishers[key] = self._publisher(key)
        return self._publishers[key]

    def subscriber(self, key: Key[Any], *, capacity: int = 1, history: bool = True) -> Subscriber:
        """
        Subscriber to a stream.

        Args:
            key: What to listen to; may hold wildcards.
            capacity: Messages kept, the oldest dropped first; fewer where so many of the longest would not fit into
                `rti_mpc.wire.streams.RING_BYTES`. A receiver that wants the last message alone keeps `RING_MESSAGES` all the same, and takes
                the newest that is accepted: what anybody sends behind it must not push it out.
            history: Whether to ask publishers for their last message, those which come later included, where the stream is cached.
        """
        capacity = key.stream.capacity(capacity)
        ring: Any = zenoh.handlers.RingChannel(capacity)
        origin = zenoh.Locality.REMOTE
        if not (history and key.stream.qos.cached):
            return Subscriber(self._session.declare_subscriber(key, ring, allowed_origin=origin), key, capacity, own="")
        request = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        recovery = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        subscriber = ext.declare_advanced_subscriber(self._session, key, ring, allowed_origin=origin, history=request, recovery=recovery)
        return Subscriber(subscriber, key, capacity, own=str(self._session.info.zid()))

    def intake(
        self,
        cls: type[M],
        stale_s: float,
        widths: Mapping[str, int] | None = None,
        *,
        choosing: bool = False,
        unfit: Callable[[M], str] = lambda _: "",
    ) -> Intake[M]:
        """
        Return a door for messages of one class, that knows what epochs may be now.

        Args:
            cls: Class of the messages.
            stale_s: Time without an accepted message after which another source may take over.
            widths: Numbers a row must have, by array.
            choosing: Whether an epoch is chosen above those heard.
            unfit: Why a message cannot be for us, as a code; empty if it can.
        """
        return Intake(cls, stale_s, widths, unix_s=unix_s, choosing=choosing, unfit=unfit)

    def publish_json(self, key: Key[Any], value: dict[str, Any]) -> None:
        """Publish a JSON object that late joiners get, too."""
        self.publisher(key).put_bytes(json.dumps(value).encode())

    def withdraw_json(self, key: Key[Any]) -> None:
        """Publish on a key no more, and let late joiners find nothing there."""
        if (publisher := self._publishers.pop(key, None)) is not None:
            publisher.undeclare()

    def _publisher(self, key: Key[M]) -> Publisher[M]:
        message, qos = key.stream.message, key.stream.qos
        options: Any = {
            "encoding": JSON if message is None else encoding(message),
            "priority": getattr(zenoh.Priority, qos.priority),
            "express": qos.express,
            "congestion_control": getattr(zenoh.CongestionControl, qos.congestion),
            "allowed_destination": zenoh.Locality.REMOTE,
        }
        if not qos.cached:
            return Publisher(self._session.declare_publisher(key, **options), realtime=qos.express)
        # A last message that was dropped would not be missed without heartbeats.
        options["sample_miss_detection"] = ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None)
        return Publisher(ext.declare_advanced_publisher(self._session, key, cache=ext.CacheConfig(1), publisher_detection=True, **options))

    def serve(self, key: Key[Any], handler: Callable[[dict[str, Any]], dict[str, Any] | None]) -> None:
        """
        Answer requests on a key, in a thread of its own.

        What the handler raises, and requests that are not a JSON object or longer
        than `MAX_REQUEST_BYTES`, are answered ``{"ok": false, "error": ...}``; None is no
        answer: another gives it.
        """
        ring: Any = zenoh.handlers.RingChannel(RING_QUERIES)
        queryable = self._session.declare_queryable(key, ring)
        self._declared.append(queryable)
        self._follow(queryable.handler, lambda query: _answer(key, query, handler))

    def request(self, key: Key[Any], value: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        """
        Answer of whoever serves a key; where several do, a refusal before a consent.

        Raises:
            TimeoutError: If nobody answers in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            if answers := list(self.answers(key, value, left_s)):
                return min(answers, key=lambda answer: answer.get("ok") is True)
            time.sleep(min(RETRY_S, left_s))  # nobody serves it yet
        raise TimeoutError(f"{key} must be served, got no answer within {timeout_s} s")

    def answers(self, key: Key[Any], value: dict[str, Any], timeout_s: float) -> Iterator[dict[str, Any]]:
        """Yield the answers of all who serve a key, as they come."""
        replies = self._session.get(
            key,
            timeout=timeout_s,
            payload=json.dumps(value).encode(),
            encoding=JSON,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            priority=getattr(zenoh.Priority, key.stream.qos.priority),
            express=key.stream.qos.express,
        )
        for reply in replies:
            if reply.ok is not None:
                yield _object(reply.ok.payload, document.MAX_BYTES)

    def alive(self, role: str) -> zenoh.LivelinessToken:
        """Show presence in a role until the token is undeclared, the bus closed or the process gone."""
        self._tokens[role] = self._session.liveliness().declare_token(self.keys.alive(role))
        return self._tokens[role]

    def is_alive(self, role: str, timeout_s: float = 0.5) -> bool:
        """Whether anybody shows presence in a role, ourselves included; just started, it may take a moment to meet the others."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            left_s = deadline_s - time.monotonic()
            replies = self._session.liveliness().get(self.keys.alive(role), timeout=max(left_s, 0.01))
            if any(reply.ok is not None for reply in replies):
                return True
            if left_s <= 0.0:
                return False
            time.sleep(min(RETRY_S, left_s))

    def watch_alive(self, callback: Callable[[str, bool], None]) -> None:
        """Call back, in a thread of its own, with a role and whether it is present, for those present now and at every change."""
        ring: Any = zenoh.handlers.RingChannel(RING_TOKENS)
        subscriber = self._session.liveliness().declare_subscriber(self.keys.lives, ring, history=True)
        self._declared.append(subscriber)

        def tell(sample: zenoh.Sample) -> None:
            if role := role_of(str(sample.key_expr)):
                callback(role, sample.kind == zenoh.SampleKind.PUT)

        self._follow(subscriber.handler, tell)

    def _follow(self, handler: Any, act: Callable[[Any], None]) -> None:
        def follow() -> None:
            while True:
                try:
                    item = handler.recv()
                except zenoh.ZError:  # the bus is closed
                    return
                act(item)

        threading.Thread(target=follow, daemon=True).start()


def _object(payload: zenoh.ZBytes | None, most: int) -> dict[str, Any]:
    """Return the JSON object in a payload, or a refusal."""
    size = 0 if payload is None else len(payload)
    try:
        return document.read(b"" if payload is None or size > most else payload.to_bytes(), size, most)
    except MessageError as error:
        return {"ok": False, "error": str(error)}


def _answer(key: str, query: zenoh.Query, handler: Callable[[dict[str, Any]], dict[str, Any] | None]) -> None:
    with query:
        request = _object(query.payload, MAX_REQUEST_BYTES)
        try:
            answer = request if request.get("ok") is False else handler(request)
            if answer is None:
                return
            text = json.dumps(answer)
        except Exception as error:  # a handler's fault is the requester's to hear, not ours to die of
            text = json.dumps({"ok": False, "error": str(error)})
        try:
            query.reply(key, text.encode(), encoding=JSON)
        except zenoh.ZError:
            return  # the requester, or the bus, is gone
