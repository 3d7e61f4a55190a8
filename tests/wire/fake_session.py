# SPDX-License-Identifier: Apache-2.0
"""Fake session without network and other processes, which records all declarations."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rti_mpc.wire.bus import Declared, Received
from rti_mpc.wire.cdr import Message, encode
from rti_mpc.wire.keys import Key
from rti_mpc.wire.streams import Kind, role_of

Said = tuple[Kind, str, str]  # how a key is used, the name of its stream, and the role that it ends with


class FakeSession:
    """
    A session as `rti_mpc.wire.zenoh_session.ZenohSession`, as far as a bus needs one.

    Attributes:
        said: Everything that was ever declared to be published, answered or shown.
        put: What was put on each key last.
        living: How many of those are declared now.
        asked: Names of the streams on which somebody was asked.
        links: As of a session.
        connects_to: As of a session.
        certificate: As of a session.
        routers: As of a session.
    """

    def __init__(self) -> None:
        self.said: set[Said] = set()
        self.put: dict[str, bytes] = {}
        self.living = 0
        self.asked: set[str] = set()
        self.links: int | None = None
        self.connects_to = ""
        self.certificate: Path | None = None
        self.routers: frozenset[str] = frozenset()
        self._closed = threading.Event()

    def __enter__(self) -> FakeSession:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._closed.set()

    def again(self, timeout_s: float, stop: threading.Event) -> FakeSession:
        return self

    def publisher(self, key: Key[Any]) -> Any:
        return self._say(key)

    def serve(self, key: Key[Any], answer: Callable[[Received], bytes | None]) -> Declared:
        return self._say(key)

    def token(self, key: Key[Any]) -> Declared:
        return self._say(key)

    def subscriber(self, key: Key[Any], capacity: int, *, history: bool, wakes: bool = False) -> Any:
        return FakeSubscriber(self._closed)

    def watch(self, key: Key[Any], tell: Callable[[str, bool], None]) -> Declared:
        return FakeSubscriber(self._closed)

    def ask(self, key: Key[Any], payload: bytes, timeout_s: float) -> Iterator[Received]:
        self.asked.add(key.stream.name)
        return iter(())

    def present(self, key: Key[Any], timeout_s: float) -> bool:
        return False

    def _say(self, key: Key[Any]) -> FakePublisher:
        self.said.add((key.stream.kind, key.stream.name, role_of(key).partition(".")[0] if key.stream.by_role else ""))
        self.living += 1
        return FakePublisher(self, key)


class FakePublisher:
    """Whatever is declared."""

    heard = False

    def __init__(self, session: FakeSession, key: Key[Any]) -> None:
        self._session = session
        self._key = key

    def put(self, message: Message) -> None:
        self.put_bytes(encode(message))

    def put_bytes(self, payload: bytes) -> None:
        self._session.put[self._key] = payload

    def undeclare(self) -> None:
        self._session.living -= 1


class FakeSubscriber:
    """Hears nothing until the session is closed."""

    def __init__(self, closed: threading.Event) -> None:
        self._closed = closed

    def recv(self) -> None:
        self._closed.wait()

    def try_recv(self) -> None:
        pass

    def drain(self) -> list[Received]:
        return []

    def wake(self) -> None:
        pass

    def undeclare(self) -> None:
        pass
