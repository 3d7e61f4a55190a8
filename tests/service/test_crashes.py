# SPDX-License-Identifier: Apache-2.0
"""Unforeseen errors in any loop of controller and guard: the robot is told to rest, the error is said, and the process ends with status 1."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from rti_mpc.contract.guard import Guard
from rti_mpc.contract.message import Command
from rti_mpc.control.controller import Controller
from rti_mpc.wire.bus import BusSettings
from rti_mpc.wire.cdr import decode
from rti_mpc_service import guard
from rti_mpc_service.config.config import load
from rti_mpc_service.controller import daemon
from rti_mpc_service.controller.leadership import Candidate
from tests.guarded import write_robot
from tests.recording.samples import command
from tests.wire.fake_session import FakeSession

pytestmark = pytest.mark.usefixtures("shared_problems")

REST = command(9)


class All(dict[str, bytes]):
    """What was put on each key, one after another."""

    def __setitem__(self, key: str, payload: bytes) -> None:
        super().__setitem__(key, self.get(key, b"") + payload if "/event/" in key else payload)


@pytest.fixture
def session(session: FakeSession) -> FakeSession:
    session.put = All()
    return session


def fail_from(count: int) -> Callable[..., None]:
    """Return a method that raises from its call of this number on."""
    calls = iter(range(1, 10**6))

    def method(*_: object) -> None:
        if next(calls) >= count:
            raise ZeroDivisionError("unforeseen")

    return method


@pytest.mark.parametrize(
    ("owner", "method", "count"),
    [(Candidate, "listen", 3), (Controller, "tick", 2), (Controller, "stop", 1), (daemon.Daemon, "_control", 1)],
    ids=["leadership", "tick", "end", "states"],
)
def test_controller_sends_rest_and_says_why_whichever_loop_fails(
    session: FakeSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: type, method: str, count: int
) -> None:
    config, stop = load(Path(__file__).parents[2] / "deploy" / "pioneer_3dx.toml"), Event()
    monkeypatch.setattr(owner, method, fail_from(count))
    monkeypatch.setattr(Controller, "standstill", lambda *_: REST)
    monkeypatch.setattr(Controller, "commit", lambda *_: None)
    if method == "stop":
        stop.set()
    assert daemon.main(config, BusSettings(), state=tmp_path, stop=stop) == 1
    keys = config.keys()
    sent = decode(Command, session.put[keys.command])
    assert (sent.seq, sent.u.tolist()) == (REST.seq, REST.u.tolist())
    assert b"stopping after an unexpected error: ZeroDivisionError: unforeseen" in session.put[keys.event("controller")]


@pytest.mark.parametrize("where", ["tick", "announce"])
def test_guard_goes_on_to_rest_and_says_why_when_its_own_loop_fails(
    session: FakeSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    path = write_robot(tmp_path / "robot.toml")
    config = load(path, with_model=False)
    failing, stopped = fail_from(1), Event()

    def tick(self: Guard, local_ns: int) -> Command | None:
        if stopped.is_set():
            return REST
        if where == "tick":
            failing()
        return None

    monkeypatch.setattr(Guard, "tick", tick)
    monkeypatch.setattr(Guard, "stop", lambda *_: stopped.set())
    if where == "announce":
        monkeypatch.setattr(Guard, "robot_now_ns", lambda *_: 0 if stopped.is_set() else failing())
    assert guard.main(config, BusSettings(), path, state=tmp_path, stop=Event()) == 1
    assert np.array_equal(decode(Command, session.put[config.keys().actuation]).u, REST.u)
    assert b"stopping after an unexpected error: ZeroDivisionError: unforeseen" in session.put[config.keys().event("guard")]
