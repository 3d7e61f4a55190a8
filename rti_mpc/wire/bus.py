# SPDX-License-Identifier: Apache-2.0
"""Bus of one robot: its streams, requests and presences, over a session that may carry the buses of several."""

from __future__ import annotations

import json
import math
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any
from weakref import WeakSet

from rti_mpc.contract.message import Notice
from rti_mpc.errors import MessageError
from rti_mpc.wire import connection, document, presence
from rti_mpc.wire.cdr import M
from rti_mpc.wire.certificate import warn_of_end
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.keys import Key, Keys
from rti_mpc.wire.reach import remind
from rti_mpc.wire.received import WOKEN as WOKEN
from rti_mpc.wire.received import Received as Received
from rti_mpc.wire.session import BusSettings as BusSettings
from rti_mpc.wire.streams import ALIVE, MAX_REQUEST_BYTES, role_of
from rti_mpc.wire.zenoh_session import CLOSE_TIMEOUT_S, ZenohSession
from rti_mpc.wire.zenoh_session import Declared as Declared
from rti_mpc.wire.zenoh_session import Publisher as Publisher
from rti_mpc.wire.zenoh_session import Subscriber as Subscriber

RING_MESSAGES = 1024  # messages that wait for a receiver: those of half a second at 2000 per second
MAX_NUMBER = 10_000_000  # below it are the numbers of processes that share a role
RETRY_INTERVAL_S = 0.1  # between two attempts to reach a process that is not there yet
SETTLED_S = 0.5  # without a new link, after which all others are taken to be met
SETTLING_S = 5.0  # for which that is waited for at most, where others come and go


def unix_s() -> int:
    """Return the Unix time in s; it differs between hosts, but limits the epochs that can exist."""
    return time.time_ns() // 1_000_000_000


def new_epoch() -> int:
    """
    Return an epoch for a new life of a robot, a planner or a listener: the Unix time in ms.

    In seconds, one that is restarted within a second would have the epoch of its last life, and its messages would count as repeated.
    Controllers and guards choose theirs by `rti_mpc.contract.epoch`.
    """
    return time.time_ns() // 1_000_000


class Bus:
    """
    Streams of one robot.

    Attributes:
        keys: Keys of the robot's streams.
        closed: Whether `close` was called.
    """

    def __init__(
        self,
        session: ZenohSession,
        keys: Keys,
        *,
        stop: threading.Event | None = None,
        say: Callable[[str], object] = lambda _: None,
    ) -> None:
        """
        Open the streams of one robot on a session, which may carry those of other robots as well.

        Args:
            session: The connection of the process; `close` leaves it open.
            keys: Keys of the robot's streams.
            stop: Ends waits for others when set.
            say: Receiver of a line about processes that are not reached.
        """
        self.keys = keys
        self.closed = False
        self._session = session
        self._leave: Callable[[], None] = self._undeclare
        self._stop = stop or threading.Event()
        self._say = say
        self._over = threading.Event()
        self._publishers: dict[str, Publisher[Any]] = {}  # by key, kept so that a process which changes its role and back uses the same one
        self._subscribers: WeakSet[Subscriber] = WeakSet()  # weak, because a subscriber ends with its last use
        self._tokens: dict[str, Declared] = {}  # by role
        self._declared: list[Declared] = []  # queryables and watches

    @classmethod
    def join(
        cls,
        settings: BusSettings,
        keys: Keys,
        *,
        timeout_s: float = math.inf,
        stop: threading.Event | None = None,
        say: Callable[[str], object] = lambda _: None,
    ) -> Bus:
        """
        Join with a session of its own, which ends with the bus.

        Args:
            settings: Settings of the session.
            keys: Keys of the robot's streams.
            timeout_s: Time for which a client waits for its router.
            stop: Ends that wait, and later ones for others, when set.
            say: Receiver of a line about processes that are not reached.

        Raises:
            ConfigError: Zenoh refuses a setting, an endpoint is taken, or no router was there in time.
            Stopped: The wait was ended by `stop`.
        """
        session = ZenohSession(settings, timeout_s=timeout_s, stop=stop, say=say)
        bus = cls(session, keys, stop=stop, say=say)
        bus._leave = session.close
        return bus

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
        self._leave()

    def _undeclare(self) -> None:
        """Undeclare everything that was declared here."""
        declared: list[Declared] = [*self._publishers.values(), *self._subscribers, *self._tokens.values(), *self._declared]

        def undeclare() -> None:
            for item in declared:
                item.undeclare()

        leaving = threading.Thread(target=undeclare, daemon=True)
        leaving.start()
        leaving.join(CLOSE_TIMEOUT_S)

    def beside(self, keys: Keys) -> Bus:
        """Return the bus of another robot on the same session, which ends with this one."""
        return Bus(self._session, keys, stop=self._stop, say=self._say)

    def expect(self, what: str, heard: Callable[[], object]) -> None:
        """
        Report from time to time that a message has not arrived yet, and how many processes this one is linked to, until it has.

        Args:
            what: Name of the message, such as ``"state"``.
            heard: Whether it has arrived.
        """

        def wanted() -> str:
            if heard():
                return ""
            if links := self._session.links:
                others = f"{links} other{'s' * (links > 1)} on the bus"
                return f"no {what} of {self.keys.prefix}/{self.keys.robot} yet, from {others}: is it running, under this name?"
            return f"not connected, no {what} yet: {why}" if (why := self.unconnected) else ""

        remind(self._say, wanted, self._over)

    @property
    def unconnected(self) -> str:
        """Why nothing can be heard: no process is linked to this one; empty if one is, or it cannot be known."""
        if self._session.links != 0:
            return ""
        return self._unanswered() or "no process has connected yet"

    def _unanswered(self) -> str:
        """Where no process answers, and why; empty if this one waits for others to connect."""
        where = self._session.connects_to
        return f"no process answers at {where}" if where else ""

    def watch_connection(self, tell: Callable[[Notice], object]) -> None:
        """
        Report what becomes of the connection, in threads of its own.

        That all links are lost, unless this process waits for others to connect, and that there are links again; and from
        `rti_mpc.wire.certificate.WARN_DAYS` before it on, once a day, the end of this process's certificate.
        """
        connection.watch(lambda: self._session.links, self._unanswered, tell, self._over)
        if (path := self._session.certificate) is not None:
            warn_of_end(path, tell, self._over)

    def publisher(self, key: Key[M]) -> Publisher[M]:
        """Return the publisher of a stream; the same one for the same key."""
        if key not in self._publishers:
            self._publishers[key] = self._session.publisher(key)
        return self._publishers[key]

    def subscriber(self, key: Key[Any], *, capacity: int = 1, history: bool = True, wakes: bool = False) -> Subscriber:
        """
        Return a subscriber to a stream.

        Args:
            key: Key of the stream; may hold wildcards.
            capacity: Messages kept, the oldest dropped first; fewer if that many of the longest would not fit into
                `rti_mpc.wire.streams.MAX_RING_BYTES`. A receiver that needs only the last message should keep `RING_MESSAGES` as well, and take
                the newest that is accepted: messages of others that follow it must not displace it.
            history: Whether to ask publishers for their last message, later ones included, if the stream is cached.
            wakes: Whether `Subscriber.wake` is needed; not of a stream that is cached.
        """
        subscriber = self._session.subscriber(key, capacity, history=history, wakes=wakes)
        self._subscribers.add(subscriber)
        return subscriber

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
        Return an intake for messages of one class, which limits epochs by the present time.

        Args:
            cls: Class of the messages.
            stale_s: Time without an accepted message after which another source may take over.
            widths: Numbers that a row must have, by the name of the array.
            choosing: Whether an epoch is to be chosen above those heard.
            unfit: Returns why a message is not for this receiver, as a code; empty if it is.
        """
        return Intake(cls, stale_s, widths, unix_s=unix_s, choosing=choosing, unfit=unfit)

    def publish_json(self, key: Key[Any], value: dict[str, Any]) -> None:
        """Publish a JSON object, which late joiners receive as well."""
        self.publisher(key).put_bytes(json.dumps(value).encode())

    def withdraw(self, key: Key[Any]) -> None:
        """Stop publishing on a key, so that late joiners find nothing there."""
        if (publisher := self._publishers.pop(key, None)) is not None:
            publisher.undeclare()

    def serve(self, key: Key[Any], handler: Callable[[dict[str, Any]], dict[str, Any] | None]) -> None:
        """
        Answer requests on a key, in a thread of its own.

        Requests that are not a JSON object or longer than `MAX_REQUEST_BYTES`, and those for
        which the handler raises, are answered ``{"ok": false, "error": ...}``. If the handler
        returns None, nothing is answered: another process answers.
        """

        def answer(received: Received) -> bytes | None:
            request = _object(received, MAX_REQUEST_BYTES)
            try:
                value = request if request.get("ok") is False else handler(request)
                return None if value is None else json.dumps(value, allow_nan=False).encode()
            except Exception as error:  # a fault of a handler is reported to the requester, and must not end this process
                return json.dumps({"ok": False, "error": str(error)}).encode()

        self._declared.append(self._session.serve(key, answer))

    def request(self, key: Key[Any], value: dict[str, Any], timeout_s: float) -> dict[str, Any]:
        """
        Return the answer of the process that serves a key; where several do, a refusal before a consent.

        Raises:
            TimeoutError: Nobody answers in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            if answers := list(self.answers(key, value, left_s)):
                return min(answers, key=lambda answer: answer.get("ok") is True)
            time.sleep(min(RETRY_INTERVAL_S, left_s))  # nobody serves it yet
        raise TimeoutError(f"{key} must be served, got no answer within {timeout_s} s")

    def answers(self, key: Key[Any], value: dict[str, Any], timeout_s: float) -> Iterator[dict[str, Any]]:
        """Yield the answers of all processes that serve a key, as they arrive."""
        for received in self._session.ask(key, json.dumps(value).encode(), timeout_s):
            yield _object(received, document.MAX_DOCUMENT_BYTES)

    def alive(self, role: str) -> Declared:
        """
        Show presence in a role until the token is undeclared, the bus closed or the process gone.

        If a router with TLS passes it on to nobody, as its list denies what this process sends, that is reported once.
        """
        if not self._tokens and self._session.certificate is not None:
            own = self.keys.alive(f"{role.partition('.')[0]}.{secrets.randbelow(MAX_NUMBER)}")
            presence.watch(self._session, own, partial(self._unheard, role), self._over)
        self._tokens[role] = self._session.token(self.keys.alive(role))
        return self._tokens[role]

    def _unheard(self, role: str) -> None:
        self._say(f"connected, but not heard as {role}: see the router's log; is {self._session.certificate} for this role and this robot?")

    def is_alive(self, role: str, timeout_s: float = 0.5) -> bool:
        """
        Whether anybody shows presence in a role, this process included.

        It may take a moment after the start to meet the others, and longer on a busy host: while links are still made, the wait
        goes on, for `SETTLING_S` at most, or until this process is to end.
        """
        begun_s = time.monotonic()
        deadline_s, links = begun_s + timeout_s, self._session.links
        while True:
            left_s = deadline_s - time.monotonic()
            if self._session.present(self.keys.alive(role), max(left_s, 0.01)):
                return True
            if (now := self._session.links) != links:
                links, settled_s = now, time.monotonic() + SETTLED_S
                deadline_s = max(deadline_s, min(settled_s, begun_s + SETTLING_S))
                left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                return False
            if self._stop.wait(min(RETRY_INTERVAL_S, left_s)):
                return False

    def watch_alive(self, callback: Callable[[str, bool], None]) -> None:
        """Call back in a thread of its own, with a role and whether it is present: for all roles present now, then at every change."""

        def tell(key: str, present: bool) -> None:
            if role := role_of(key):
                callback(role, present)

        self._declared.append(self._session.watch(self.keys.lives, tell))

    def watch_robots(self, callback: Callable[[str, str, bool], None]) -> None:
        """Call back in a thread of its own, with robot, role and whether it is present, for all robots below this prefix."""
        begin, end = f"{self.keys.prefix}/", f"/{ALIVE.name}/"

        def tell(key: str, present: bool) -> None:
            robot, _, role = key.removeprefix(begin).rpartition(end)
            if robot and role_of(key) == role:
                callback(robot, role, present)

        self._declared.append(self._session.watch(Key(f"{begin}**{end}*", ALIVE), tell))


def _object(received: Received, max_bytes: int) -> dict[str, Any]:
    """Return the JSON object in a payload, or a refusal."""
    try:
        return document.read(received.payload, received.size, max_bytes)
    except MessageError as error:
        return {"ok": False, "error": str(error)}
