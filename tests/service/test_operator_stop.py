# SPDX-License-Identifier: Apache-2.0
"""Operator's stop in one process, on a bus made of a queue."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import pytest

from rti_mpc.contract.latch import MAX_COUNTER_LEAP, Latch
from rti_mpc.contract.message import Notice
from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.wire.bus import Received
from rti_mpc.wire.document import MAX_DOCUMENT_BYTES
from rti_mpc.wire.keys import Keys
from rti_mpc_service import operator_stop
from rti_mpc_service.latch_file import LatchFile
from rti_mpc_service.operator_stop import OperatorStop

WHEN = "2026-11-28T09:30:00Z"
STOPPED = Latch(5, True, WHEN, "asked for by ada@lab")
PATIENCE_S = 10.0


class Disk(LatchFile):
    """A file whose writes wait until the test allows them, and may fail."""

    def __init__(self, folder: Path) -> None:
        super().__init__(Keys(), folder)
        self.works = threading.Event()
        self.fault: OSError | None = None

    def write(self, latch: Latch) -> None:
        assert self.works.wait(PATIENCE_S)
        if self.fault is not None:
            raise self.fault
        super().write(latch)


class Process:
    """A process that obeys stops, and a record of its actions."""

    def __init__(self, file: LatchFile) -> None:
        self.obeyed: list[Latch] = []
        self.said: queue.Queue[Notice] = queue.Queue()
        self.told: list[Any] = []
        self.keys = Keys()
        self.heard: queue.Queue[Received | None] = queue.Queue()
        self.ended = threading.Event()
        self.closed = False
        self.served: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {}
        self.stop = OperatorStop(file, self.obeyed.append, self.said.put)
        self.stop.listen(cast(Any, self))
        self.stop.serve(cast(Any, self), lambda: "controller", lambda: self.told.append(self.stop.latch_info()["latch"]))

    def subscriber(self, key: str, **_: object) -> Any:
        assert key == self.keys.infos
        inbox, ended = self.heard, self.ended

        class Subscriber:
            def recv(self) -> Received | None:
                if (received := inbox.get()) is None:
                    ended.set()
                return received

        return Subscriber()

    def serve(self, key: str, handler: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
        self.served[key] = handler

    def ask(self, what: str, **more: Any) -> dict[str, Any]:
        return self.served[self.keys.stop]({"request": what, "by": "ada@lab", **more})

    def describe(self, *payloads: Any) -> None:
        """Let it hear descriptions, and then that its bus is closed, which it hears when it has looked at all of them."""
        for payload in payloads:
            self.heard.put(Received(payload if isinstance(payload, bytes) else json.dumps(payload).encode(), "application/json", "info/guard"))
        self.heard.put(None)
        assert self.ended.wait(PATIENCE_S)


@pytest.fixture
def disk(tmp_path: Path) -> Disk:
    disk = Disk(tmp_path)
    disk.works.set()
    return disk


def test_stop_acts_and_is_told_before_it_is_stored(disk: Disk) -> None:
    process = Process(disk)
    disk.works.clear()
    answers: list[dict[str, Any]] = []
    asker = threading.Thread(target=lambda: answers.append(process.ask("stop")))
    asker.start()
    while not process.told:
        pass
    assert [latch.stopped for latch in process.obeyed] == [True]
    assert disk.read()[0] == Latch()
    disk.works.set()
    asker.join(PATIENCE_S)
    (answer,) = answers
    assert (answer["ok"], answer["role"], answer.get("not_stored")) == (True, "controller", None)
    assert disk.read()[0] == process.obeyed[0] == Latch(**answer["latch"])
    assert process.told == [answer["latch"]]


def test_slow_disk_holds_no_answer_up_and_is_told_of(disk: Disk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operator_stop, "STORE_TIMEOUT_S", 0.02)
    process = Process(disk)
    disk.works.clear()
    answer = process.ask("stop")
    assert (answer["ok"], answer["not_stored"]) == (True, "not stored within 0.02 s")
    disk.works.set()


def test_what_cannot_be_stored_is_said_at_once_and_stored_as_soon_as_it_can_be(disk: Disk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(operator_stop, "STORE_RETRY_S", 0.02)
    process = Process(disk)
    disk.fault = OSError(28, "No space left on device")
    answer = process.ask("stop")
    assert (answer["ok"], answer["not_stored"]) == (True, f"{disk.path}: No space left on device")
    notice = process.said.get(timeout=PATIENCE_S)
    assert (notice.code, "No space left on device" in notice.text) == ("stop_not_stored", True)
    disk.fault = None
    assert process.said.get(timeout=PATIENCE_S).code == "stop_stored", "not one event for each attempt"
    assert disk.read()[0] == process.obeyed[0]
    assert "not_stored" not in process.ask("stop")


def test_process_that_starts_is_stopped_by_its_file_until_it_is_released(disk: Disk) -> None:
    disk.write(STOPPED)
    process = Process(disk)
    assert process.obeyed == [STOPPED]
    assert process.ask("stop")["latch"] == asdict(STOPPED), "it stands since the first stop"
    assert process.ask("enable")["ok"] is True
    assert [latch.counter for latch in process.obeyed] == [5, 6]
    assert process.stop._stored(PATIENCE_S) == ""
    assert Process(disk).obeyed == []


def test_process_that_starts_says_since_when_and_by_whom_it_is_stopped(disk: Disk, caplog: pytest.LogCaptureFixture) -> None:
    disk.write(STOPPED)
    Process(disk)
    assert caplog.messages == [f"stopped since {WHEN}: asked for by ada@lab; `rti-mpc enable` releases it"]


def test_file_that_cannot_be_understood_is_a_stop_that_enable_releases_for_good(disk: Disk, caplog: pytest.LogCaptureFixture) -> None:
    assert disk.path is not None
    disk.path.write_text("{")
    process = Process(disk)
    assert process.stop.latch.stopped
    assert caplog.messages[0] == f"{disk.path}: message must be a JSON object: taken as a stop"
    assert "`rti-mpc enable` releases it" in caplog.messages[1]
    assert process.ask("enable")["ok"] is True
    assert process.stop._stored(PATIENCE_S) == ""
    assert Process(disk).obeyed == []


def test_process_takes_over_what_others_describe_and_tells_it_on(disk: Disk) -> None:
    process = Process(disk)
    released = Latch(6, False, WHEN, "asked for by bob@lab")
    process.describe({"role": "guard", "latch": asdict(STOPPED)}, {"latch": asdict(Latch(4, False, WHEN, ""))}, {"latch": asdict(released)})
    assert process.obeyed == [STOPPED, released]
    assert process.told == [asdict(STOPPED), asdict(released)]
    assert process.stop._stored(PATIENCE_S) == ""
    assert disk.read()[0] == released


def test_nothing_that_is_heard_ends_the_thread_that_hears(disk: Disk) -> None:
    process = Process(disk)
    leap = asdict(Latch(MAX_COUNTER_LEAP + 1, True, WHEN, "forged"))
    huge = {"latch": asdict(STOPPED), "more": " " * MAX_DOCUMENT_BYTES}
    nonsense: list[Any] = [
        b"",
        b"\xff",
        b"{",
        b"[" * 100_000,
        [],
        5,
        {"latch": 5},
        {"latch": {}},
        {"latch": {"counter": 10**400}},
        {"latch": {"counter": -1}},
    ]
    process.describe(*nonsense, {"latch": leap}, huge, {"latch": asdict(STOPPED)})
    assert process.obeyed == [STOPPED]
    assert {process.said.get_nowait().code for _ in range(3)} == {"latch_refused"}


def test_request_that_was_asked_again_is_not_done_twice(disk: Disk) -> None:
    """A process that was stopped again stays stopped if an earlier release is repeated."""
    process = Process(disk)
    process.ask("stop")
    released = process.ask("enable")["latch"]
    process.ask("stop")
    again = process.ask("enable", latch=released)
    assert (again["ok"], process.stop.latch.stopped) == (False, True)
    assert again["error"].startswith("not any more: stopped since")


NO_REQUESTS: list[dict[str, Any]] = [
    {},
    {"request": "go"},
    {"request": []},
    {"request": "stop", "by": 5},
    {"request": "stop", "by": "a" * 101},
    {"request": "stop", "by": "\n"},
]


@pytest.mark.parametrize("request_", NO_REQUESTS)
def test_what_is_no_request_changes_nothing(disk: Disk, request_: dict[str, Any]) -> None:
    process = Process(disk)
    with pytest.raises(ConfigError, match="must be"):
        process.stop.answer(request_)
    with pytest.raises(MessageError):
        process.ask("stop", latch={"counter": -1})
    assert process.obeyed == []


def test_bus_that_refuses_to_tell_a_change_ends_no_thread_and_the_change_is_stored(disk: Disk, caplog: pytest.LogCaptureFixture) -> None:
    """As one does that is being closed, of which the process does not know yet."""
    process = Process(disk)

    def refuse() -> None:
        raise RuntimeError("session closed")

    process.stop._tell = refuse
    released = Latch(6, False, WHEN, "asked for by bob@lab")
    process.describe({"latch": asdict(STOPPED)}, {"latch": asdict(released)})
    assert process.obeyed == [STOPPED, released]
    assert process.stop._stored(PATIENCE_S) == ""
    assert disk.read()[0] == released
    assert "session closed" in caplog.text


def test_change_that_is_heard_while_the_bus_closes_ends_its_thread_in_silence(disk: Disk, caplog: pytest.LogCaptureFixture) -> None:
    before = set(threading.enumerate())
    process = Process(disk)
    (thread,) = (thread for thread in threading.enumerate() if thread not in before and thread.name == "stop_heard")

    def refuse() -> None:
        process.closed = True
        raise RuntimeError("session closed")

    process.stop._tell = refuse
    process.heard.put(Received(json.dumps({"latch": asdict(STOPPED)}).encode(), "application/json", "info/guard"))
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert (process.obeyed, caplog.messages) == ([STOPPED], [])
