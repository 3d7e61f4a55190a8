# SPDX-License-Identifier: Apache-2.0
"""System of real processes over real Zenoh: behaviour when they start, stop and die."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest

from rti_mpc.contract.message import Command, End, Event, Reference, State, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.wire import cdr
from rti_mpc.wire.bus import Bus, Publisher
from rti_mpc.wire.cdr import decode, encode
from rti_mpc.wire.session import BusSettings
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.shipped import SHIPPED
from tests.in_time import MS, in_time, on_time
from tests.processes.record import STANDSTILL_SPEED, moves, rests
from tests.processes.system import ANSWERED, CONFIG, KEYS, SPEED, System, heard, rti_mpc, until

END_MS = 1000.0  # from Ctrl-C to the end of a process
PERIOD_MS = 1e3 * CONFIG.ocp.dt_s / SPEED
OTHER_VERSION = f"@{cdr.MESSAGE_VERSION + 1}"  # in a refusal


def with_viewer(folder: Path) -> System:
    return System(folder, viewer=("view", "--rerun-save", folder / "run.rrd"))


@pytest.fixture
def system(tmp_path: Path) -> Iterator[System]:
    with with_viewer(tmp_path) as system:
        yield system


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """A robot that is being driven, and that every test but the last leaves so."""
    with with_viewer(tmp_path_factory.mktemp("driven")) as system:
        system.start("robot", "controller", "reference")
        system.tracking()
        yield system


@pytest.mark.slow
@pytest.mark.parametrize("order", [("robot", "reference", "viewer", "controller"), ("controller", "robot", "reference", "viewer")], ids="-".join)
def test_processes_start_in_any_order(system: System, order: tuple[str, ...]) -> None:
    pytest.importorskip("rerun")
    for role in order:
        system.start(role)
        system.opened(role)
    system.tracking()
    system.state(moves)
    until(lambda: set(order) <= system.lives, "all have met")


@pytest.mark.slow
def test_controller_recovers_when_the_robot_is_killed_and_restarted(system: System) -> None:
    system.start("controller", "reference", "robot")
    first = system.tracking()
    system.state(moves)
    system.kill("robot")
    system.start("robot")
    again = system.tracking(first.state_epoch + 1)
    assert again.epoch == first.epoch
    assert again.seq > first.seq
    state = system.state(moves)
    assert state.epoch == again.state_epoch


def test_robot_brakes_and_stands_when_the_controller_is_killed_and_another_one_takes_over(driven: System, host: Host) -> None:
    """Its last command ends 250 ms after its state; then the robot brakes inside its slew limits, and coasts."""
    first = driven.tracking()
    driving = driven.state(lambda state: state.x[3] > 0.1)
    killed_at_ns = time.monotonic_ns()
    driven.kill("controller")
    standing = driven.state(rests)
    slew_s = driving.x[3] / (0.25 / CONFIG.ocp.dt_s)
    coast_s = 0.25 * np.log(0.5 / STANDSTILL_SPEED)  # the plant's time constant is below 0.25 s
    limit_s = 0.25 + slew_s + coast_s + 2 * CONFIG.ocp.dt_s + 0.05 * SPEED
    in_time(host, "standing", (standing.stamp_ns - driving.stamp_ns) / MS / SPEED, 1e3 * limit_s / SPEED, killed_at_ns)
    driven.start("controller")
    again = driven.tracking(first.state_epoch)
    until(lambda: driven.tracking().epoch > first.epoch, "another epoch")
    assert again.state_epoch == first.state_epoch
    driven.state(moves)


@pytest.mark.slow
def test_of_several_planners_a_controller_that_starts_after_them_follows_the_latest(system: System) -> None:
    """All their references come at once, in any order."""
    keys, latest = system.bus.keys, 5
    with ExitStack() as stack:
        for epoch in (latest, *range(1, latest)):
            planner = stack.enter_context(Bus.join(BusSettings(connect=(system.endpoint,)), keys))
            there = Reference(epoch, 1, 0, 10**9, End.HOLD, np.full((600, 3), 0.1 * epoch), np.zeros((600, 0)))
            planner.publisher(keys.reference).put(there)
        system.start("robot", "controller")
        samples = heard(system.bus.subscriber(keys.telemetry), Telemetry, lambda sample: sample.seq >= 5)
    assert samples.y_ref[:, :2] == pytest.approx(0.1 * latest)


def test_stop_is_latched_until_enable_and_outlives_a_controller_that_is_killed(driven: System) -> None:
    def says(word: str) -> CompletedProcess[str]:
        return rti_mpc(word, SHIPPED, "-e", driven.endpoint, "--state", driven.folder / "state", *ANSWERED)  # an operator on the same host

    driven.state(moves)
    done = says("stop")
    assert (done.returncode, json.loads(done.stdout)["role"]) == (0, "controller"), done.stderr
    stopped = heard(driven.bus.subscriber(KEYS.command), Command, lambda command: command.mode is Mode.STOPPED and not command.u.any())
    stood = driven.state(rests)
    driven.interrupt("reference")
    driven.start("reference")  # a new reference releases nothing
    heard(driven.bus.subscriber(KEYS.reference), Reference, lambda reference: True)
    later = heard(driven.bus.subscriber(KEYS.command), Command, lambda command: command.seq > stopped.seq + 40)
    assert later.mode is Mode.STOPPED
    driven.kill("controller")
    driven.start("controller")
    again = heard(driven.bus.subscriber(KEYS.command), Command, lambda command: command.epoch > later.epoch)
    assert (again.mode, again.u.any()) == (Mode.STOPPED, False)
    assert "stopped since" in driven.said("controller")
    here = driven.state(lambda _: True)
    assert driven.state(lambda state: state.seq > here.seq + 40).x[:2] == pytest.approx(stood.x[:2], abs=1e-3)
    assert says("enable").returncode == 0
    assert driven.tracking().epoch == again.epoch
    driven.state(moves)


def test_second_controller_refuses_to_start_beside_a_live_one(driven: System) -> None:
    before = driven.tracking()
    done = rti_mpc("run", SHIPPED, "-e", driven.endpoint)
    assert done.returncode == 1
    assert "pioneer already has a controller" in done.stderr
    assert driven.tracking().epoch == before.epoch


def malformed(message: State | Command, rows: str) -> dict[str, bytes]:
    """Malformed messages, by words of their refusal."""
    whole, values = encode(message), getattr(message, rows)
    return {
        "got no bytes": b"",
        "must hold at least": whole[:20],
        "must end after": whole + bytes(4),
        "big-endian": b"\x00\x00" + whole[2:],
        "must be finite": encode(replace(message, **{rows: np.full_like(values, np.nan)})),
        "numbers per row": encode(replace(message, **{rows: np.concatenate([values, values[..., :1]], axis=-1)})),
        OTHER_VERSION: whole,
    }


@pytest.mark.slow
def test_payload_of_every_malformed_kind_is_counted_and_published_while_control_goes_on(
    driven: System, host: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    """States to the controller and commands to the robot; from a flood of them each process publishes one event per second."""
    ours = driven.bus.publisher(KEYS.state), driven.bus.publisher(KEYS.command)
    before, since_ns = driven.sample(), time.monotonic_ns()
    with Bus.join(BusSettings(connect=(driven.endpoint,)), KEYS) as another:
        with monkeypatch.context() as later:
            later.setattr(cdr, "MESSAGE_VERSION", cdr.MESSAGE_VERSION + 1)
            foreign = another.publisher(KEYS.state), another.publisher(KEYS.command)
        refuse_malformed(driven, ours, foreign)
    after = driven.sample()
    assert after.seq > before.seq + 20
    if on_time(host, "the controller", PERIOD_MS, since_ns):  # after a hold-up the robot is where no guess is near
        assert after.softened == before.softened
    assert driven.tracking().epoch == after.epoch == before.epoch


def refuse_malformed(driven: System, ours: tuple[Publisher[State], Publisher[Command]], foreign: tuple[Publisher[State], Publisher[Command]]) -> None:
    """Send every malformed kind, by publishers of our version of the messages and of another, and look at what is published of it."""
    kinds = malformed(driven.state(lambda _: True), "x"), malformed(driven.tracking(), "u")
    events, start_s = driven.bus.subscriber(KEYS.events, capacity=1024, history=False), time.monotonic()

    def send(words: str) -> None:
        for publisher, payloads in zip(foreign if words == OTHER_VERSION else ours, kinds, strict=True):
            for _ in range(3):  # however long this process is held up between two calls, there are some of which nothing is published
                publisher.put_bytes(payloads[words])

    for words in kinds[0]:
        for role in ("controller", "robot"):
            until(lambda: words in driven.event("message_refused", role, partial(send, words)).text, f"{role} says {words}")  # noqa: B023
    took_s = time.monotonic() - start_s
    refused = [event for event in (decode(Event, received.payload) for received in events.drain()) if event.code == "message_refused"]
    for role in ("controller", "robot"):
        texts = [event.text for event in refused if event.source == role]
        assert len(kinds[0]) <= len(texts) <= took_s + 2.0
        counts = [int(text.rpartition("; ")[2].split()[0]) for text in texts]
        assert all(np.diff(counts) > 1), "each counts those of which nothing was published"


def test_second_publisher_takes_nothing_over(driven: System, host: Host) -> None:
    """Neither a command of an older controller, nor a state of another life of the robot: while that is heard the robot stands, and then goes on."""
    states, commands = driven.bus.publisher(KEYS.state), driven.bus.publisher(KEYS.command)
    true, command = driven.state(lambda _: True), driven.tracking()
    seqs = iter(range(10**6, 10**9))

    def order() -> None:
        commands.put(replace(command, epoch=command.epoch - 1, seq=next(seqs), valid_until_ns=2**62 - 1, u=np.full((20, 2), 0.5)))

    def live() -> None:
        states.put(State(true.epoch + 1, next(seqs), true.stamp_ns + 10**12, np.full(5, 9.0)))

    assert str(command.epoch) in driven.event("source_refused", "robot", order).text
    before, telemetry = driven.sample(), driven.bus.subscriber(KEYS.telemetry, capacity=1024)
    since_ns = time.monotonic_ns()
    text = driven.event("two_robots", "controller", live).text
    assert str(true.epoch) in text
    assert str(true.epoch + 1) in text
    heard(driven.bus.subscriber(KEYS.telemetry), Telemetry, lambda sample: sample.seq > before.seq + 20 and sample.mode is Mode.TRACKING)
    samples = [decode(Telemetry, received.payload) for received in telemetry.drain()]
    assert any(sample.mode is Mode.BRAKING for sample in samples)
    if on_time(host, "the true robot", PERIOD_MS, since_ns):  # one that is not heard in time may have been restarted
        assert max(np.abs(sample.x0).max() for sample in samples) < 8.0
    assert driven.tracking().epoch == command.epoch


def test_inputs_stayed_inside_their_bounds_through_all_of_it(driven: System) -> None:
    driven.tracking()
    with (driven.folder / "robot.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    u = np.array([[float(row["u_c"]), float(row["omega_c"])] for row in rows])
    assert np.all(np.abs(u) <= [0.5, 0.745])


def test_ctrl_c_ends_each_process_within_a_second_and_the_last_command_is_a_standstill(driven: System) -> None:
    """The last test of this system; whoever is needed comes last, `make test-slow` has other orders."""
    pytest.importorskip("rerun")
    commands = driven.bus.subscriber(KEYS.command, capacity=4096)
    driven.start("viewer")
    driven.tracking()
    driven.state(moves)
    until(lambda: {"viewer", "reference", "controller", "robot"} <= driven.lives, "all have met")
    assert driven.interrupt("viewer", 2000.0) == 0  # it has a recording to finish
    assert driven.interrupt("reference", END_MS) == 0
    driven.tracking()  # the reference was published whole, and outlives its source
    assert driven.interrupt("controller", END_MS) == 0
    until(lambda: "controller" not in driven.lives, "the controller is gone")
    last = decode(Command, commands.drain()[-1].payload)
    assert (last.mode, np.abs(last.u).max()) == (Mode.STOPPED, 0.0)
    driven.state(rests)
    assert driven.interrupt("robot", END_MS) == 0
    assert "Traceback" not in "".join(map(driven.said, ("controller", "robot", "reference", "viewer")))
