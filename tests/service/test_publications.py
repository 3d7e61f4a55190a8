# SPDX-License-Identifier: Apache-2.0
"""Column `publishers` of the table of streams, compared with what each process publishes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from rti_mpc.adapter import PlannerAdapter
from rti_mpc.contract.message import State
from rti_mpc.model.path_following import path_following
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.path import smooth_path
from rti_mpc.reference.speed_profile import SpeedLimits
from rti_mpc.wire.bus import Bus, BusSettings, Received
from rti_mpc.wire.info import Info, Leader, latches
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.streams import RELAY, STREAMS
from rti_mpc_service import guard, path_reference, request, router
from rti_mpc_service import reference as source
from rti_mpc_service.config.build import robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.controller import daemon
from rti_mpc_service.faults import relay
from rti_mpc_service.host import echo
from rti_mpc_service.scenario import find_scenario
from rti_mpc_sim import robot
from rti_mpc_sim.settings import RobotSettings
from tests.guarded import write_robot
from tests.wire.fake_session import FakeSession, Said

pytestmark = pytest.mark.usefixtures("shared_problems")

CONFIG = load(Path(__file__).parents[2] / "deploy" / "pioneer_3dx.toml")
KEYS, SETTINGS = CONFIG.keys(), BusSettings()

STOPPED = Event()  # each runs once through, from its start to its end
STOPPED.set()


@pytest.fixture
def session(session: FakeSession, monkeypatch: pytest.MonkeyPatch) -> FakeSession:
    monkeypatch.setattr(relay, "ZenohSession", lambda *_, **__: session)
    for module in (echo, relay):
        monkeypatch.setattr(module, "stop_on_signals", lambda: STOPPED)
    return session


def may(*roles: str) -> set[Said]:
    """What the table lets roles publish, answer and show."""
    return {(stream.kind, stream.name, role if stream.by_role else "") for stream in STREAMS for role in roles if role in stream.publishers}


def controllers(folder: Path) -> None:
    for standby in (False, True):
        daemon.main(CONFIG, SETTINGS, standby=standby, state=folder, stop=STOPPED)


def guards(folder: Path) -> None:
    path = write_robot(folder / "robot.toml")
    guard.main(load(path, with_model=False), SETTINGS, path, state=folder, stop=STOPPED)


PROCESSES: dict[tuple[str, ...], Callable[[Path], object]] = {
    ("robot",): lambda _: robot.main(RobotSettings(**robot_settings(CONFIG)), SETTINGS, KEYS, stop=STOPPED),
    ("reference",): lambda _: source.main(find_scenario(CONFIG), SETTINGS, KEYS, stop=STOPPED),
    ("controller", "standby"): controllers,
    ("guard",): guards,
    ("router",): lambda _: router.main(SETTINGS, KEYS, stop=STOPPED),
    ("relay",): lambda _: relay.main(SETTINGS, Keys("behind", KEYS.robot), KEYS),
    ("echo",): lambda _: echo.main(SETTINGS, KEYS, 100),
    ("operator",): lambda _: echo.Pinger(Bus.join(SETTINGS, KEYS), State(1, 1, 0, np.zeros(5))),
}


@pytest.mark.parametrize("roles", PROCESSES, ids="_".join)
def test_process_publishes_what_the_table_lets_its_roles_and_nothing_else(roles: tuple[str, ...], session: FakeSession, tmp_path: Path) -> None:
    PROCESSES[roles](tmp_path)
    assert session.said == may(*roles)


def test_viewer_publishes_what_the_table_lets_it(session: FakeSession, tmp_path: Path) -> None:
    viewer(tmp_path)
    assert session.said == may("viewer")


def test_recorder_publishes_what_the_table_lets_it(session: FakeSession, tmp_path: Path) -> None:
    recorder(tmp_path)
    assert session.said == may("recorder")


def viewer(folder: Path) -> None:
    pytest.importorskip("rerun")
    from rti_mpc_service.view import view

    view.main(SETTINGS, KEYS, view.Screens(rerun_save=folder / "run.rrd"), stop=STOPPED)


def recorder(folder: Path) -> None:
    pytest.importorskip("mcap")
    from rti_mpc_service.record import record

    record.main(SETTINGS, KEYS, out=folder / "run.mcap", stop=STOPPED)


def path_source(_: Path) -> None:
    path = smooth_path(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 1.0]])).limited(SpeedLimits(0.4, 0.3, 0.3, 0.3))
    path_reference.main("bend", path_following(pioneer_3dx()), [path], SETTINGS, KEYS, stop=STOPPED)


CONNECTED = [
    *(PROCESSES[roles] for roles in (("robot",), ("reference",), ("controller", "standby"), ("guard",), ("router",))),
    *(viewer, recorder, path_source, lambda _: PlannerAdapter("wheels").close()),
]
CONNECTED_NAMES = ["robot", "reference", "controller", "guard", "router", "viewer", "recorder", "path source", "planner adapter"]


@pytest.mark.parametrize("process", CONNECTED, ids=CONNECTED_NAMES)
def test_process_watches_for_the_loss_of_all_its_links(
    process: Callable[[Path], object], session: FakeSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watching: list[Bus] = []
    monkeypatch.setattr(Bus, "watch_connection", lambda bus, tell: watching.append(bus))
    process(tmp_path)
    assert watching


@pytest.mark.parametrize("roles", [("robot",), ("guard",), ("controller", "standby")], ids="_".join)
def test_description_of_a_process_can_be_read(roles: tuple[str, ...], session: FakeSession, tmp_path: Path) -> None:
    PROCESSES[roles](tmp_path)
    infos = {key: payload for key, payload in session.put.items() if key in [KEYS.info(role) for role in roles]}
    assert len(infos) == len(roles)
    for key, payload in infos.items():
        received = Received(payload, "application/json", key)
        info = Info.from_received(received)
        assert [(label.name, label.unit) for label in info.inputs] == [("u_c", "m/s"), ("omega_c", "rad/s")]
        assert len(latches(received)) == (info.role != "robot")
        leader = Leader.from_received(received, 2**63)
        assert (leader is not None and leader.parameters == {"version": 0, "changes": {}}) == (info.role in ("controller", "standby"))


def test_every_role_that_may_publish_has_a_process_here() -> None:
    assert {role for stream in STREAMS for role in stream.publishers} == {"viewer", "recorder", *(role for roles in PROCESSES for role in roles)}


def test_operator_asks_whom_the_table_lets_him(session: FakeSession, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In fault injection, also the relay."""
    assert request.main(SETTINGS, KEYS, "params", 0.05) == 1
    assert request.stop_or_enable(SETTINGS, KEYS, "stop", 0.05, guarded=False, state=tmp_path) == 1
    assert session.asked == {stream.name for stream in STREAMS if "operator" in stream.askers} - {RELAY.name}
    assert session.said == set()
    assert "no controller that answers" in capsys.readouterr().err


def test_bus_declares_no_more_however_often_a_role_is_taken() -> None:
    session = FakeSession()
    bus = Bus(session, KEYS)
    counts = []
    for _ in range(3):
        for role in ("standby", "controller"):
            token = bus.alive(role)
            bus.publisher(bus.keys.event(role))
            bus.publish_json(bus.keys.info(role), {})
            bus.withdraw(bus.keys.info(role))
            token.undeclare()
        counts.append(session.living)
    assert counts == [2, 2, 2]
