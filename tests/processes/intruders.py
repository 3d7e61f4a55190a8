# SPDX-License-Identifier: Apache-2.0
"""Intruders at a router with TLS: again and again all those try to join that must not, and those that may join send what is not theirs to send."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.message import Command, Event, Reference, Severity, State
from rti_mpc.errors import ConfigError
from rti_mpc.wire.bus import unix_s
from rti_mpc.wire.cdr import decode, encode
from rti_mpc.wire.keys import Key, Keys
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.processes.secured import Secured, join_unchecked
from tests.processes.system import until

MARK = b"forged!!"  # in every message that is sent here: as a number, 1e-147
MARK_INTEGER = int.from_bytes(MARK, "little")
MARK_NUMBER = float(np.frombuffer(MARK, np.float64)[0])
NOBODY = "standby.4242424"
BACKWARDS = np.array([-0.5, -0.745])  # as fast as the shipped robot may
ABOVE = 1 << 20  # of the epoch that leads
VALID_NS = 300_000_000
PAUSE_S = 0.05  # between two attempts of one thread
ANSWER_TIMEOUT_S = 0.1
RING = 4096


class Intruders:
    """
    Two threads, of which one tries to join and the other sends, while the block runs.

    Attributes:
        tried: How often each was tried.
        joined: Who has joined, and must not.
        arrived: Keys on which anything of theirs has reached another process.
    """

    def __init__(self, bus: Secured) -> None:
        self.tried: Counter[str] = Counter()
        self.joined: set[str] = set()
        self.arrived: set[str] = set()
        self.keys = bus.keys
        self._outsiders = bus.outsiders()
        listen = free_endpoint().replace("tcp/", "tls/")
        self._senders = {
            "viewer": bus.join("viewer"),
            "planner": bus.join("planner"),
            "controller of another robot": bus.join("controller", bus.bundle("other", Keys(robot="other"))),
            "peer": bus.join("viewer", mode="peer", listen=(listen,)),
        }
        # One reads at the router, the other is an accomplice of the peer and knows where that listens.
        readers = (bus.join("recorder"), bus.join("guard", mode="peer", connect=(bus.endpoint, listen)))
        everything = Key(self.keys.below("**"), self.keys.command.stream)
        self._heard = [reader.subscriber(everything, capacity=RING) for reader in readers]
        readers[0].watch_alive(lambda role, _: self.arrived.add(role) if role == NOBODY else None)
        self._latest: dict[str, bytes] = {}
        until(lambda: self._listen() or {self.keys.state, self.keys.command} <= self._latest.keys(), "states and commands")
        self._names = (*self._outsiders, *self._attempts())
        self._over, self._failed = threading.Event(), list[BaseException]()
        self._threads = [threading.Thread(target=self._repeat, args=(attempt,)) for attempt in (self._knock, self._send)]

    def __enter__(self) -> Intruders:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        assert not self._failed, self._failed

    def again(self, rounds: int) -> None:
        """Wait until each attempt was made this number of times from now on."""
        before = Counter(self.tried)
        until(lambda: self._failed or all(self.tried[name] >= before[name] + rounds for name in self._names), "all have tried", pause_s=0.1)

    def command(self) -> bytes:
        """Return a command that would act if it reached the robot or its guard: an answer to the latest state, of a higher epoch than any other."""
        state, leads = decode(State, self._latest[self.keys.state]), decode(Command, self._latest[self.keys.command])
        forged = replace(leads, epoch=leads.epoch + ABOVE, config_hash=MARK_INTEGER, u=np.tile(BACKWARDS, (20, 1)))
        forged = replace(forged, state_epoch=state.epoch, state_seq=state.seq, state_stamp_ns=state.stamp_ns)
        return encode(replace(forged, stamp_ns=state.stamp_ns, valid_until_ns=state.stamp_ns + VALID_NS))

    def listen(self) -> set[str]:
        """Return the keys on which anything of the intruders has reached another process."""
        self._listen()
        return self.arrived

    def _listen(self) -> None:
        for subscriber in self._heard:
            for received in subscriber.drain():
                self._latest[received.key] = received.payload
                if MARK in received.payload:
                    self.arrived.add(received.key)

    def _attempts(self) -> dict[str, Callable[[], object]]:
        """Return what is sent in turn, by who sends it where."""
        keys, viewer, command = self.keys, self._senders["viewer"], self.command()
        state = decode(State, self._latest[keys.state])
        y = np.tile([-10.0, -10.0, MARK_NUMBER], (50, 1))
        messages = {
            keys.state: encode(replace(state, epoch=state.epoch + 1, u=np.full(2, MARK_NUMBER))),
            keys.command: command,
            keys.actuation: command,
            keys.reference: encode(Reference(unix_s() << NUMBER_BITS, 1, state.stamp_ns, 100_000_000, 0, y, np.empty((50, 0)))),
            keys.info("controller"): MARK,
            keys.event("guard"): encode(Event(1, 1, 1, "guard", Severity.ERROR, "latched", MARK.decode())),
            Key(keys.below("**"), keys.command.stream): command,
            Key(f"{keys.prefix}/*/actuation", keys.command.stream): command,
        }

        def put(sender: str, key: Key[Command]) -> Callable[[], object]:
            return lambda: self._senders[sender].publisher(key).put_bytes(messages[key])

        attempts = {f"viewer on {key}": put("viewer", key) for key in messages}
        for sender in ("planner", "controller of another robot", "peer"):
            attempts |= {f"{sender} on {key}": put(sender, key) for key in (keys.command, keys.actuation)}
        for name, key, request in (("stop", keys.stop, {"request": "stop"}), ("request", keys.request, {"request": "params", "get": True})):
            attempts[f"viewer asks {name}"] = lambda key=key, request=request, name=name: self.arrived.update(
                f"{name}, answered" for _ in viewer.answers(key, request, ANSWER_TIMEOUT_S)
            )
        attempts["viewer is present"] = lambda: viewer.alive(NOBODY).undeclare()
        return attempts

    def _repeat(self, attempt: Callable[[], object]) -> None:
        try:
            while not self._over.is_set():
                attempt()
        except BaseException as error:
            self._failed.append(error)

    def _knock(self) -> None:
        for name, settings in self._outsiders.items():
            try:
                with join_unchecked(settings, self.keys, 0.0):
                    self.joined.add(name)
            except ConfigError:
                self.tried[name] += 1
            if self._over.wait(PAUSE_S):
                return

    def _send(self) -> None:
        for name, attempt in self._attempts().items():
            self._listen()
            attempt()
            self.tried[name] += 1
            if self._over.wait(PAUSE_S):
                return
