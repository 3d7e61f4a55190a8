# SPDX-License-Identifier: Apache-2.0
"""
Operator's stop in one process: obeyed, published, stored, and answered on a key of its own.

Controllers, standbys and guards each have one. It answers requests, learns missed
ones from the descriptions of the other processes, and obeys at once. A separate
thread stores each change, since a disk may be slow or full.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from threading import Condition, Lock, Thread
from typing import Any

from rti_mpc.contract.latch import Latch, merge, read_latch, shown
from rti_mpc.contract.message import Notice, Severity
from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.wire import info
from rti_mpc.wire.bus import RING_MESSAGES, Bus, Received
from rti_mpc_service.latch_file import LatchFile

STOP_REQUESTS = ("stop", "enable")
UNNAMED_OPERATOR = "an operator"
MAX_NAME_CHARACTERS = 100  # of the operator's name
STORE_TIMEOUT_S = 0.5  # how long an answer waits for the disk
STORE_RETRY_S = 10.0  # period of further attempts to store

log = logging.getLogger("stop")


class OperatorStop:
    """
    The latch of one process.

    Attributes:
        latch: The present latch.
    """

    def __init__(self, file: LatchFile, obey: Callable[[Latch], None], say: Callable[[Notice], None]) -> None:
        """
        Read the file, and obey a stored stop.

        Args:
            file: File in which the latch outlives the process.
            obey: Stops or releases the robot; must not block.
            say: Publishes a notice.
        """
        self._file = file
        self._obey = obey
        self._say = say
        self._role: Callable[[], str] = lambda: ""
        self._tell: Callable[[], None] = lambda: None
        self._changing = Lock()
        self._storing = Condition()
        self._attempted, self._fault = Latch(), ""  # latch of the last attempt to store, and the error of that attempt
        self.latch, complaint = file.read()
        if complaint:
            log.warning("%s: taken as a stop", complaint)
        if self.latch.stopped:
            log.warning("%s; `rti-mpc enable` releases it", self.latch)
            obey(self.latch)
        if obstacle := file.obstacle():
            say(Notice(Severity.WARNING, "stop_not_stored", f"a stop is lost when the last process of this robot ends: {obstacle}"))
        self._attempted = self.latch
        Thread(target=self._store, name="stop_stored", daemon=True).start()

    def latch_info(self) -> dict[str, Any]:
        """Return the latch as a part of the description of this process."""
        return info.latch(asdict(self.latch))

    def listen(self, bus: Bus) -> None:
        """Take over greater latches from the descriptions of other processes, from now on."""
        subscriber = bus.subscriber(bus.keys.infos, capacity=RING_MESSAGES)

        def follow() -> None:
            for received in iter(subscriber.recv, None):
                try:
                    self._overhear(received)
                except Exception:  # from anything that a change triggers, such as publishing on a failing bus
                    if bus.closed:
                        return
                    log.exception("%s: its stop or release was obeyed, then an unexpected error occurred", received.key)

        Thread(target=follow, name="stop_heard", daemon=True).start()

    def serve(self, bus: Bus, role: Callable[[], str], tell: Callable[[], None]) -> None:
        """
        Answer requests on the bus from now on.

        Args:
            bus: The bus.
            role: Returns the present role of this process.
            tell: Publishes the description of this process.
        """
        self._role, self._tell = role, tell
        bus.serve(bus.keys.stop, self.answer)

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """
        Stop or release the robot, or take over the latch in the request; then wait up to `STORE_TIMEOUT_S` until it is stored.

        Raises:
            ConfigError: The request is not valid.
            MessageError: The latch in the request is not valid.
        """
        what = request.get("request")
        if what not in STOP_REQUESTS:
            raise ConfigError(f"request must be stop or enable, got {shown(what)}")
        if "latch" in request:
            self.take_over(read_latch(request["latch"]))
        else:
            by = request.get("by", UNNAMED_OPERATOR)
            if not (isinstance(by, str) and 0 < len(by) <= MAX_NAME_CHARACTERS and by.isprintable()):
                raise ConfigError(f"by must be printable, of at most {MAX_NAME_CHARACTERS} characters, got {shown(by)}")
            self._take(lambda known: known.change(stopped=what == "stop", reason=f"asked for by {by}", when=utc_now()))
        fault = self._stored(STORE_TIMEOUT_S)
        latch = self.latch
        answer = {"ok": latch.stopped == (what == "stop"), "request": what, "role": self._role(), "latch": asdict(latch)}
        if not answer["ok"]:
            answer["error"] = f"not any more: {latch}"
        return answer | ({"not_stored": fault} if fault else {})

    def take_over(self, heard: Latch) -> None:
        """Take over the latch of another process, if it is greater."""
        self._take(lambda known: merge(known, heard))

    def close(self) -> None:
        """Wait until the latch is stored, up to `STORE_TIMEOUT_S`."""
        self._stored(STORE_TIMEOUT_S)

    def _take(self, change: Callable[[Latch], Latch]) -> None:
        """Obey a change, publish it, and wake the thread that stores it."""
        with self._changing:
            latch = change(self.latch)
            if latch == self.latch:
                return
            self._obey(latch)
            self.latch = latch
            try:
                self._tell()
            finally:  # it is stored even if publishing fails
                with self._storing:
                    self._storing.notify_all()

    def _overhear(self, received: Received) -> None:
        """Take over the latches in a received description; called in a thread that no message may end."""
        try:
            told = info.latches(received)
        except MessageError:
            return  # announced by those who read more of it
        try:
            for latch in told:
                self.take_over(read_latch(latch))
        except MessageError as error:
            self._say(Notice(Severity.WARNING, "latch_refused", f"{received.key}: {error}"))

    def _stored(self, patience_s: float) -> str:
        """Wait for the attempt to store the present latch, and return its error; empty if it is stored."""
        with self._storing:
            if not self._storing.wait_for(lambda: self._attempted >= self.latch, patience_s):
                return f"not stored within {patience_s:g} s"
            return self._fault

    def _store(self) -> None:
        """Store each change, and repeat failed attempts; a thread of its own."""
        while True:
            with self._storing:
                self._storing.wait_for(lambda: self._attempted < self.latch, STORE_RETRY_S if self._fault else None)
            latch, before, fault = self.latch, self._fault, ""
            try:
                self._file.write(latch)
            except OSError as error:
                fault = f"{self._file.path}: {error.strerror}" if self._file.path else str(error.strerror)
            with self._storing:
                self._attempted, self._fault = latch, fault
                self._storing.notify_all()
            if fault and fault != before:
                self._say(Notice(Severity.WARNING, "stop_not_stored", f"{latch} could not be stored: {fault}"))
            elif before and not fault:
                self._say(Notice(Severity.INFO, "stop_stored", f"{latch} is stored now, in {self._file.path}"))


def utc_now() -> str:
    """Return the UTC time in the format of a latch."""
    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"
