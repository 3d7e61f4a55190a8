# SPDX-License-Identifier: Apache-2.0
"""
Zenoh session of one process, which carries the buses of its robots (`rti_mpc.wire.bus.Bus`).

* Received messages wait in a ring of fixed size that drops the oldest: an unread
  subscriber blocks nobody, and no Python code runs in a thread of Zenoh.
* Messages are dropped, not waited for, where a link is congested.
* A session does not receive what it publishes itself.
* `ZenohSession.close` is bounded, unblocks every `recv`, and the interpreter then exits.
"""

from __future__ import annotations

import math
import os
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Generic, Protocol

import zenoh
from zenoh import ext

from rti_mpc.wire import document
from rti_mpc.wire.cdr import M, encode
from rti_mpc.wire.introduction import Introduction
from rti_mpc.wire.keys import Key
from rti_mpc.wire.received import WOKEN, Received
from rti_mpc.wire.session import BusSettings, certificate, endpoints, guest_config, meets, open_session, zenoh_config
from rti_mpc.wire.streams import JSON_ENCODING

CLOSE_TIMEOUT_S = 0.5
HEARTBEAT_S = 1.0  # period at which a cached publisher sends the number of its last message
MAX_ENCODING_CHARS = 256  # of an encoding that are read
RING_TOKENS = 1024  # changes of presence that wait for their receiver
WAKE_BYTES = 16  # of the message by which a process wakes its own receiver
RING_QUERIES = 16  # requests that wait for their answer
CLOSED_WORDS = ("closed", "Undeclared")  # in Zenoh's errors about a session that is closed or a publisher that is undeclared

give_way: Callable[[], None] = getattr(os, "sched_yield", lambda: None)  # not on every system


class Declared(Protocol):
    """A declaration that lasts until it is undeclared."""

    def undeclare(self) -> object:
        """End the declaration."""


class Publisher(Generic[M]):
    """Publisher of a stream. `put` never blocks, and does nothing once the publisher is undeclared or the session closed."""

    def __init__(self, publisher: zenoh.Publisher | ext.AdvancedPublisher, *, realtime: bool = False) -> None:
        self._publisher = publisher
        self._realtime = realtime

    @property
    def heard(self) -> bool:
        """Whether anybody listens now; always true for a cached publisher, whose last message waits for late joiners."""
        if not isinstance(self._publisher, zenoh.Publisher):
            return True
        status: Any = self._publisher.matching_status  # an object, always true, whatever its type hint says
        return bool(status.matching)

    def put(self, message: M) -> None:
        """Send a message to all who listen now, and to late joiners if the publisher is cached."""
        self.put_bytes(encode(message))

    def put_bytes(self, payload: bytes) -> None:
        """Send bytes as they are."""
        try:
            self._publisher.put(payload)
        except zenoh.ZError as error:
            if not any(word in str(error) for word in CLOSED_WORDS):
                raise
        if self._realtime:
            give_way()  # to Zenoh's sending thread: the caller goes on computing, and there may be few cores

    def undeclare(self) -> None:
        """Leave the key."""
        publisher: Any = self._publisher
        publisher.undeclare()


class Subscriber:
    """Subscriber to one key expression, with a ring of the newest samples, oldest first. It is empty after `ZenohSession.close`."""

    def __init__(
        self,
        subscriber: zenoh.Subscriber[Any] | ext.AdvancedSubscriber[Any],
        key: Key[Any],
        capacity: int,
        own: str,
        put_here: Callable[[bytes], object] | None = None,
    ) -> None:
        """
        Take over a subscriber of Zenoh's.

        Args:
            subscriber: With a ring as its handler.
            key: Its key expression.
            capacity: Of the ring.
            own: Number of the session, if its own messages may arrive.
            put_here: Puts a payload into the ring, by a message that does not leave this process; None where `wake` is not needed.
        """
        self._subscriber = subscriber
        self._put_here = put_here
        self._wake = b"" if put_here is None else secrets.token_bytes(WAKE_BYTES)  # known to nobody else
        self._capacity = capacity
        self._handler = subscriber.handler
        self._key = "" if "*" in key else str(key)
        self._max_bytes = key.stream.max_bytes
        self._own = own  # a cache also answers its own session
        self._encoding: tuple[zenoh.Encoding | None, str] = None, ""  # the last one, and its text: comparing costs a fifth of making the text

    def recv(self) -> Received | None:
        """Next sample, waiting for it; `WOKEN` after `wake`; None once the session is closed."""
        try:
            while (received := self._received(self._handler.recv())) is None:
                pass
        except zenoh.ZError:
            return None
        return received

    def try_recv(self) -> Received | None:
        """Next sample, None if there is none now; who asks is awake, so a `wake` is over."""
        try:
            while (sample := self._handler.try_recv()) is not None:
                if (received := self._received(sample)) is not None and received is not WOKEN:
                    return received
        except zenoh.ZError:
            return None
        return None

    def drain(self) -> list[Received]:
        """All samples there are now, oldest first; no more than the ring holds, even if others arrive meanwhile."""
        return list(islice(iter(self.try_recv, None), self._capacity))

    def wake(self) -> None:
        """
        Have `recv`, in another thread, return `WOKEN`, now or when it is next called, unless messages are taken before by `try_recv`.

        Does nothing once the session is closed.
        """
        assert self._put_here is not None, "a subscriber to be woken must be declared so"
        with suppress(zenoh.ZError):
            self._put_here(self._wake)

    def undeclare(self) -> None:
        """Stop receiving; a waiting `recv` returns None."""
        subscriber: Any = self._subscriber
        subscriber.undeclare()

    def _received(self, sample: zenoh.Sample) -> Received | None:
        if self._own and (info := sample.source_info) is not None and str(info.source_id.zid) == self._own:
            return None
        if sample.encoding != self._encoding[0]:
            self._encoding = sample.encoding, str(sample.encoding)[:MAX_ENCODING_CHARS]
        key, size = self._key or str(sample.key_expr), len(sample.payload)
        if size > self._max_bytes:
            return Received(b"", self._encoding[1], key, withheld=size)  # not even copied
        payload = sample.payload.to_bytes()
        return WOKEN if payload == self._wake and self._wake else Received(payload, self._encoding[1], key)


class ZenohSession:
    """Connection of one process to the others, of any robot: the part of Zenoh that a bus needs."""

    def __init__(
        self,
        settings: BusSettings,
        *,
        timeout_s: float = math.inf,
        stop: threading.Event | None = None,
        say: Callable[[str], object] = lambda _: None,
    ) -> None:
        """
        Open a session.

        Args:
            settings: Settings of the session.
            timeout_s: Time for which a client waits for its router.
            stop: Ends that wait when set.
            say: Receiver of a line about processes that are not reached.

        Raises:
            ConfigError: Zenoh refuses a setting, an endpoint is taken, or no router was there in time.
            Stopped: The wait was ended by `stop`.
        """
        self._settings = settings
        self._config = zenoh_config(settings)
        self._session = open_session(settings, timeout_s, stop, say)
        self._over = threading.Event()
        self._following: list[threading.Thread] = []
        if meets(self._config):
            self._introduction = Introduction(self._peers, lambda: zenoh.open(guest_config(settings)), self._over)
            self._following.append(threading.Thread(target=self._introduction.follow, name="introduction", daemon=True))
            self._following[-1].start()

    def __enter__(self) -> ZenohSession:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """
        Close the session within half a second, even where Zenoh takes longer; every `recv` then returns None.

        Unless it does, threads that follow are over by then: one that comes back from Zenoh while the interpreter ends would abort the process.
        """
        self._over.set()
        closing = threading.Thread(target=self._session.close, daemon=True)
        closing.start()
        over_s = time.monotonic() + CLOSE_TIMEOUT_S
        for thread in (closing, *self._following):
            if thread is not threading.current_thread():
                thread.join(max(0.0, over_s - time.monotonic()))

    @property
    def routers(self) -> frozenset[str]:
        """Numbers of the routers that this process is linked to; empty for peers, and once it is closed."""
        try:
            return frozenset(str(router) for router in self._session.info.routers_zid())
        except zenoh.ZError:
            return frozenset()

    def again(self, timeout_s: float, stop: threading.Event) -> ZenohSession:
        """
        Open another session with the same settings, as a client.

        Raises:
            ConfigError: No router was there in time.
            Stopped: The wait was ended by `stop`.
        """
        return ZenohSession(replace(self._settings, mode="client", listen=()), timeout_s=timeout_s, stop=stop)

    @property
    def certificate(self) -> Path | None:
        """Certificate with which it has joined, PEM; None without TLS."""
        return certificate(self._config)

    @property
    def connects_to(self) -> str:
        """Endpoints that it connects to, and what is wrong there, in words; empty if it waits for others to connect."""
        return endpoints(self._config)

    @property
    def links(self) -> int | None:
        """Number of other processes that this one is linked to; None once it is closed."""
        try:
            return len(self._session.info.peers_zid()) + len(self._session.info.routers_zid())
        except zenoh.ZError:
            return None

    def _peers(self) -> set[str]:
        """Return the numbers of the peers that this process is linked to."""
        return {str(peer) for peer in self._session.info.peers_zid()}

    def publisher(self, key: Key[M]) -> Publisher[M]:
        """Publisher of a stream, with the quality of service that the table gives it."""
        qos = key.stream.qos
        options: Any = {
            "encoding": key.stream.encoding,
            "priority": getattr(zenoh.Priority, qos.priority),
            "express": qos.express,
            "congestion_control": getattr(zenoh.CongestionControl, qos.congestion),
            "allowed_destination": zenoh.Locality.REMOTE,
        }
        if not qos.cached:
            return Publisher(self._session.declare_publisher(key, **options), realtime=qos.express)
        # Without heartbeats a subscriber would not notice that the last message was dropped.
        options["sample_miss_detection"] = ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None)
        return Publisher(ext.declare_advanced_publisher(self._session, key, cache=ext.CacheConfig(qos.cached), publisher_detection=True, **options))

    def subscriber(self, key: Key[Any], capacity: int, *, history: bool, wakes: bool = False) -> Subscriber:
        """Subscriber to a stream, see `rti_mpc.wire.bus.Bus.subscriber`."""
        capacity = key.stream.capacity(capacity)
        ring: Any = zenoh.handlers.RingChannel(capacity)
        origin = zenoh.Locality.REMOTE
        if wakes:
            assert not key.stream.qos.cached
            put_here = partial(self._session.put, key, allowed_destination=zenoh.Locality.SESSION_LOCAL)
            return Subscriber(self._session.declare_subscriber(key, ring), key, capacity, "", put_here)
        if not (history and key.stream.qos.cached):
            return Subscriber(self._session.declare_subscriber(key, ring, allowed_origin=origin), key, capacity, own="")
        request = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        recovery = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        subscriber = ext.declare_advanced_subscriber(self._session, key, ring, allowed_origin=origin, history=request, recovery=recovery)
        return Subscriber(subscriber, key, capacity, own=str(self._session.info.zid()))

    def serve(self, key: Key[Any], answer: Callable[[Received], bytes | None]) -> Declared:
        """Answer queries, in a thread of its own, until what is returned is undeclared; None is no answer."""
        ring: Any = zenoh.handlers.RingChannel(RING_QUERIES)
        queryable = self._session.declare_queryable(key, ring)

        def act(query: zenoh.Query) -> None:
            with query:
                payload = answer(_withheld(query.payload, key, key.stream.max_bytes))
                if payload is not None:
                    query.reply(key, payload, encoding=JSON_ENCODING)

        self._following.append(_follow(queryable.handler, act))
        return queryable

    def ask(self, key: Key[Any], payload: bytes, timeout_s: float) -> Iterator[Received]:
        """Yield the answers of all processes that serve a key, as they arrive."""
        replies = self._session.get(
            key,
            timeout=timeout_s,
            payload=payload,
            encoding=JSON_ENCODING,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            priority=getattr(zenoh.Priority, key.stream.qos.priority),
            express=key.stream.qos.express,
        )
        for reply in replies:
            if reply.ok is not None:
                yield _withheld(reply.ok.payload, key, document.MAX_DOCUMENT_BYTES)

    def token(self, key: Key[Any]) -> Declared:
        """Show presence until what is returned is undeclared, the session closed or the process gone."""
        return self._session.liveliness().declare_token(key)

    def present(self, key: Key[Any], timeout_s: float) -> bool:
        """Whether anybody shows presence within the timeout, this process included."""
        return any(reply.ok is not None for reply in self._session.liveliness().get(key, timeout=timeout_s))

    def watch(self, key: Key[Any], tell: Callable[[str, bool], None]) -> Declared:
        """Report, in a thread of its own, each key with whether its owner is present, for all now and then at every change."""
        ring: Any = zenoh.handlers.RingChannel(RING_TOKENS)
        subscriber = self._session.liveliness().declare_subscriber(key, ring, history=True)
        self._following.append(_follow(subscriber.handler, lambda sample: tell(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)))
        return subscriber


def _withheld(payload: zenoh.ZBytes | None, key: str, max_bytes: int) -> Received:
    """Return a payload, without its bytes if they are too many."""
    size = 0 if payload is None else len(payload)
    return Received(b"" if payload is None or size > max_bytes else payload.to_bytes(), JSON_ENCODING, key, withheld=size if size > max_bytes else 0)


def _follow(handler: Any, act: Callable[[Any], None]) -> threading.Thread:
    """Act on each item of a handler, in a thread of its own, which is returned, until the session is closed."""

    def follow() -> None:
        while True:
            try:
                item = handler.recv()
            except zenoh.ZError:
                return
            try:
                act(item)
            except zenoh.ZError:  # the requester or the session is gone
                continue

    thread = threading.Thread(target=follow, daemon=True)
    thread.start()
    return thread
