# SPDX-License-Identifier: Apache-2.0
"""Client that sends requests to a controller again and again."""

from __future__ import annotations

import itertools
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from rti_mpc.contract.message import Reference
from rti_mpc.wire.cdr import decode
from tests.bench.driven import Driven
from tests.processes.system import until

PAUSE_S = 0.05  # between two requests, after the answer
ANSWER_TIMEOUT_S = 10.0
FLOOD_REQUESTS = 100  # sent at once
REQUESTS: dict[str, Callable[[int], dict[str, Any]]] = {
    "set": lambda k: {"request": "params", "set": {"ocp.weights.Q.psi": 0.05 + 0.001 * (k % 2)}},
    "refused set": lambda k: {"request": "params", "set": {"ocp.weights.Q.psi": -1.0 - k}},
    "get": lambda k: {"request": "params", "get": True},
    "refused inject": lambda k: {"request": "inject", "failure": "solver", "samples": 0},
    "a megabyte": lambda k: {"request": "params", "set": {"ocp.weights.delta": [1.0] * 200_000}},
}
KINDS = (*REQUESTS, "nonsense", "reference")


class Asker:
    """
    Asks in a thread of its own.

    Attributes:
        answers: How often each kind was answered or sent, by whether it was granted.
    """

    def __init__(self, robot: Driven, rows: int) -> None:
        self.answers: Counter[tuple[str, bool]] = Counter()
        self._robot = robot
        self._rows = rows
        self._over = threading.Event()
        self._planner = robot.bus.publisher(robot.bus.keys.reference)
        planned = robot.bus.subscriber(robot.bus.keys.reference)
        self._known = decode(Reference, until(planned.try_recv, "the reference that is followed").payload)
        self._seq = itertools.count(1)

    @contextmanager
    def asking(self, kinds: Sequence[str]) -> Iterator[None]:
        """Send these requests in turn while the block runs."""
        now_ns = self._robot.telemetry[-1].state_stamp_ns
        self._over.clear()
        thread = threading.Thread(target=self._ask, args=(kinds, now_ns))
        thread.start()
        try:
            yield
        finally:
            self._over.set()
            thread.join()

    def _ask(self, kinds: Sequence[str], now_ns: int) -> None:
        for k, kind in enumerate(itertools.cycle(kinds)):
            if self._over.wait(PAUSE_S):
                return
            if kind == "nonsense":
                self._flood()
            elif kind == "reference":
                self._plan(now_ns)
            else:
                answer = self._robot.bus.request(self._robot.bus.keys.request, REQUESTS[kind](k), ANSWER_TIMEOUT_S)
                self.answers[kind, "error" not in answer] += 1

    def _flood(self) -> None:
        """Send malformed requests, without waiting for answers."""
        session: Any = self._robot.bus._session
        for _ in range(FLOOD_REQUESTS):
            session._session.get(self._robot.bus.keys.request, lambda _: None, payload=b"{" * 1000, timeout=1.0)
        self.answers["nonsense", False] += FLOOD_REQUESTS

    def _plan(self, now_ns: int) -> None:
        """Send the reference again, starting now, as a planner does after new measurements."""
        known = self._known
        at = (now_ns - known.stamp_ns) // known.period_ns
        y = known.y[at : at + self._rows]
        stamp_ns = known.stamp_ns + at * known.period_ns
        self._planner.put(replace(known, epoch=known.epoch + 1, seq=next(self._seq), stamp_ns=stamp_ns, y=y, p=np.empty((len(y), 0))))
        self.answers["reference", len(y) == self._rows] += 1
