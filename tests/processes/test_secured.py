# SPDX-License-Identifier: Apache-2.0
"""Real routers with TLS on the loopback: who may join, and what each role may do."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import Command, Reference, State, Telemetry
from rti_mpc.errors import ConfigError
from rti_mpc.wire.bus import Bus
from rti_mpc.wire.cdr import decode, encode
from rti_mpc.wire.keys import Key, Keys
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.processes.system import ANSWERED, PATIENCE_S, heard, rti_mpc, until

pytest.importorskip("cryptography", reason="the extra certs is not installed: certificates were NOT tried")

from tests.processes.secured import PROGRAMS, Secured, join_unchecked

pytestmark = pytest.mark.slow

REFERENCE = Reference(epoch=1, seq=1, stamp_ns=1, period_ns=100_000_000, end=0, y=np.zeros((5, 3)), p=np.empty((5, 0)))


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[Secured]:
    """A router that is up."""
    with Secured(tmp_path) as bus:
        yield bus


def state(seq: int) -> State:
    return State(1, seq, seq, np.zeros(5))


def arrives(sender: Bus, key: Key[Any], payload: bytes, reader: Bus, at: Key[Any], robot: Bus) -> bool:
    """
    Whether a payload that one process puts reaches another.

    Each attempt is followed by a state of the robot, of which a hundred reach the same
    reader before it is said that nothing came.
    """
    wanted, states = reader.subscriber(at, capacity=64), reader.subscriber(reader.keys.state, capacity=64)
    publisher, witness, seq, seen = sender.publisher(key), robot.publisher(robot.keys.state), 0, 0

    def look() -> str | None:
        nonlocal seq, seen
        publisher.put_bytes(payload)
        witness.put_bytes(encode(state(seq := seq + 1)))
        seen += sum(received.payload != payload for received in states.drain())
        if any(received.payload == payload for received in wanted.drain()):
            return "it came"
        return "nothing came" if seen >= 100 else None

    try:
        return until(look, "states of the robot") == "it came"
    finally:
        wanted.undeclare()
        states.undeclare()


def test_every_process_works_with_its_own_certificate_a_stop_stops_and_a_viewer_reads(bus: Secured) -> None:
    bus.start("reference", "sim", "guard", "run")  # the planner first: the controller and its reference meet late
    viewer = bus.join("viewer")
    commands = viewer.subscriber(bus.keys.actuation)
    command = heard(commands, Command, lambda command: command.mode.name == "TRACKING")
    assert command.state_epoch > 0
    assert heard(viewer.subscriber(bus.keys.telemetry), Telemetry, lambda _: True).x0.shape == (5,)
    late = bus.join("recorder").subscriber(bus.keys.reference)  # after the only reference was sent: from the planner's cache
    assert len(heard(late, Reference, lambda _: True).y) > 1
    done = rti_mpc("stop", bus.config, "--tls", bus.tls, *ANSWERED)
    assert (done.returncode, json.loads(done.stdout)["role"]) == (0, "guard"), done.stderr
    heard(viewer.subscriber(bus.keys.state), State, lambda s: bool(np.all(np.abs(s.u) < 1e-3)))
    done = rti_mpc("enable", bus.config, "--tls", bus.tls, *ANSWERED)
    assert done.returncode == 0, done.stderr
    heard(commands, Command, lambda command: command.mode.name == "TRACKING")
    lives: set[str] = set()
    viewer.watch_alive(lambda role, present: (lives.add if present else lives.discard)(role))
    until(lambda: lives >= {"robot", "controller", "guard", "reference", "router"}, "all are present")
    for name in reversed(PROGRAMS):
        bus.running[name].terminate()
        assert bus.running[name].wait(PATIENCE_S) == 0, bus.said(name)
        assert "Traceback" not in bus.said(name)


def test_late_joiner_gets_a_reference_and_nobody_but_the_planner_gives_one(bus: Secured) -> None:
    bus.join("planner").publisher(bus.keys.reference).put(REFERENCE)
    forger = bus.join("viewer").publisher(bus.keys.reference)
    forger.put(replace(REFERENCE, epoch=9))
    late = bus.join("controller").subscriber(bus.keys.reference, capacity=8)
    assert heard(late, Reference, lambda _: True).epoch == 1
    assert [decode(Reference, received.payload).epoch for received in late.drain()] in ([], [1])


def test_certificate_of_no_or_of_another_authority_expired_or_plain_tcp_is_refused(bus: Secured) -> None:
    for settings in bus.outsiders().values():
        with pytest.raises(ConfigError, match="none has answered"):
            join_unchecked(settings, bus.keys, 3.0)
    assert bus.join("robot")  # the router lives, and takes a good one


def test_client_does_not_take_another_process_of_the_same_authority_for_the_router(tmp_path: Path) -> None:
    system = Secured(tmp_path)
    for name in ("pem", "key"):
        (system.tls / f"router.{name}").write_bytes((system.tls / f"controller.{name}").read_bytes())
    with system, pytest.raises(ConfigError, match="none has answered"):
        system.join("robot")


@pytest.fixture
def crowd(bus: Secured) -> dict[str, Bus]:
    """All roles, and a controller of another robot."""
    joined = {role: bus.join(role) for role in ("robot", "controller", "guard", "planner", "operator", "viewer")}
    return joined | {"other": bus.join("controller", bus.bundle("other", Keys(robot="other")))}


WRITERS = {"state": "robot", "command": "controller", "actuation": "guard", "reference": "planner", "info": "robot", "event": "guard"}


@pytest.mark.parametrize("stream", WRITERS)
def test_stream_is_written_by_its_role_and_by_nobody_else(stream: str, bus: Secured, crowd: dict[str, Bus]) -> None:
    keys = {"info": bus.keys.info("robot"), "event": bus.keys.event("guard")}
    key = keys.get(stream) or getattr(bus.keys, stream)
    for role, sender in crowd.items():
        reader = crowd["viewer" if role != "viewer" else "operator"]
        came = arrives(sender, key, f"{stream} by {role}".encode(), reader, key, crowd["robot"])
        assert came is (role == WRITERS[stream]), f"{role} on {stream}"


def test_wildcards_requests_and_presence_of_others_are_denied(bus: Secured, crowd: dict[str, Bus]) -> None:
    for text in ("rti_mpc/pioneer/**", "rti_mpc/*/command", "**"):
        key = Key(text, bus.keys.command.stream)
        assert not arrives(crowd["viewer"], key, b"forged", crowd["operator"], bus.keys.command, crowd["robot"]), text
    asked: list[dict[str, Any]] = []
    crowd["controller"].serve(bus.keys.request, lambda request: asked.append(request) or {"ok": True})
    assert crowd["operator"].request(bus.keys.request, {"from": "operator"}, PATIENCE_S) == {"ok": True}
    for role in ("viewer", "planner", "robot", "other"):
        with pytest.raises(TimeoutError):
            crowd[role].request(bus.keys.request, {"from": role}, 1.0)
    assert {request["from"] for request in asked} == {"operator"}
    crowd["viewer"].serve(bus.keys.stop, lambda _: {"ok": True})
    with pytest.raises(TimeoutError):
        crowd["operator"].request(bus.keys.stop, {"request": "stop"}, 1.0)
    crowd["viewer"].alive("controller")
    crowd["robot"].alive("robot")
    assert crowd["operator"].is_alive("robot", PATIENCE_S)
    assert not crowd["operator"].is_alive("controller", 1.0)


def test_peers_that_present_good_certificates_do_not_link_past_the_list(bus: Secured) -> None:
    listen = free_endpoint().replace("tcp/", "tls/")
    forger = bus.join("viewer", mode="peer", listen=(listen,))
    victim = bus.join("guard", mode="peer")
    assert not arrives(forger, bus.keys.command, b"forged", victim, bus.keys.command, bus.join("robot"))
