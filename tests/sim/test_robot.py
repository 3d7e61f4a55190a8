# SPDX-License-Identifier: Apache-2.0
"""The robot and the reference source as real processes over loopback."""

from __future__ import annotations

import csv
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Command, End, Event, Reference, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.reference.trajectory import eight, rows
from rti_mpc.wire.bus import Bus, BusSettings, Subscriber
from rti_mpc.wire.cdr import decode
from rti_mpc.wire.keys import Keys
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_sim import robot
from rti_mpc_sim.settings import RobotSettings
from tests.in_time import MS, ends_in_time, explained, in_time
from tests.robots import pushed

ROOT = Path(__file__).parents[2]
KEYS = Keys("test", "sim")
PATIENCE_S = 60.0  # to start a process and hear of it

# Both end as every process of ours, see `rti_mpc_service.entry`. To finalize the interpreter takes 0.1 s of computing, seconds on a busy host,
# and aborts the process if a thread is inside Zenoh.
ROBOT = """
import sys
from pathlib import Path
import numpy as np
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.wire.bus import BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.entry import enter
from rti_mpc_sim import robot
from rti_mpc_sim.settings import RobotSettings

_, endpoint, speed, period_s, log = sys.argv
settings = RobotSettings(pioneer_3dx(), np.array([0.5, 0.0, 0.0, 0.0, 0.0]), slew=np.array([1.0, 2.0]), state_period_s=float(period_s))
enter(lambda: robot.main(settings, BusSettings(listen=(endpoint,), connect=()), Keys("test", "sim"), speed=float(speed), log=Path(log)))
"""

SOURCE = """
import sys
from rti_mpc.wire.bus import BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service import reference as source
from rti_mpc_service.shipped import SHIPPED
from rti_mpc_service.config.config import load
from rti_mpc_service.entry import enter
from rti_mpc_service.scenario import find_scenario

enter(lambda: sys.exit(source.main(find_scenario(load(SHIPPED)), BusSettings(connect=(sys.argv[1],)), Keys("test", "sim"))))
"""


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@contextmanager
def running(script: str, *arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, "-c", script, *map(str, arguments)], env=environment)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def peer(endpoint: str) -> Iterator[Bus]:
    """Join the bus for a bounded time: every receive ends then."""
    with Bus.join(BusSettings(connect=(endpoint,)), KEYS) as bus:
        timer = threading.Timer(PATIENCE_S, bus.close)
        timer.start()
        yield bus
        timer.cancel()


def next_state(states: Subscriber) -> State:
    received = states.recv()
    assert received is not None, "no state came in time"
    return decode(State, received.payload)


def interrupted(process: subprocess.Popen[bytes]) -> None:
    """Press Ctrl-C, and hold the process to a second."""
    process.send_signal(signal.SIGINT)
    assert ends_in_time(process, "the end", 1000.0) == 0


def command(state: State, seq: int, u: list[float], epoch: int = 5) -> Command:
    stamp_ns = state.stamp_ns
    rows_ = np.tile(u, (5, 1))
    return Command(epoch, seq, stamp_ns, state.epoch, state.seq, stamp_ns, stamp_ns + 250 * MS, 0, Mode.TRACKING, QpStatus.SOLVED, 100 * MS, rows_)


@pytest.mark.parametrize(("speed", "period_s"), [(1.0, 0.02), (4.0, 0.1)])
def test_robot_publishes_at_the_rate_asked_for_and_stands_still_without_commands(
    endpoint: str, tmp_path: Path, host: Host, speed: float, period_s: float
) -> None:
    with running(ROBOT, endpoint, speed, period_s, tmp_path / "log.csv") as process, peer(endpoint) as bus:
        states = bus.subscriber(KEYS.state, capacity=256)
        first, since_ns = next_state(states), time.monotonic_ns()
        heard = [next_state(states) for _ in range(40)]
        wall_ms, due_ms = (time.monotonic_ns() - since_ns) / MS, 1e3 * 40 * period_s / speed
        assert [state.stamp_ns - first.stamp_ns for state in heard] == [k * round(1e9 * period_s) for k in range(1, 41)]
        assert [state.seq for state in heard] == list(range(first.seq + 1, first.seq + 41))
        assert wall_ms > 0.9 * due_ms or explained(host, "the first state came late", 0.9 * due_ms - wall_ms, since_ns, time.monotonic_ns())
        in_time(host, "forty periods", wall_ms, 1.1 * due_ms, since_ns)
        assert all(state.x.tolist() == [0.5, 0.0, 0.0, 0.0, 0.0] for state in heard)
        interrupted(process)


def test_commanded_robot_moves_stops_on_silence_and_ends_on_ctrl_c_standing(endpoint: str, tmp_path: Path, host: Host) -> None:
    log = tmp_path / "log.csv"
    with running(ROBOT, endpoint, 1.0, 0.05, log) as process, peer(endpoint) as bus:
        states = bus.subscriber(KEYS.state)
        events = bus.subscriber(KEYS.events, capacity=16)
        commands = bus.publisher(KEYS.command)
        seqs, begun_ns, state = itertools.count(1), time.monotonic_ns(), next_state(states)
        while state.x[3] < 0.3:
            commands.put(command(state, next(seqs), [0.4, 0.2]))
            state = next_state(states)
        while np.abs(state.x[3:]).max() > 1e-3:  # nobody commands any more
            state = next_state(states)
        for _ in range(10):
            state = next_state(states)
            commands.put(command(state, next(seqs), [0.4, 0.2]))
        commands.put(replace(command(state, next(seqs), [0.5, 0.0]), state_epoch=1))
        next_state(states)
        codes = set()
        while not {"command_ran_out", "command_foreign_epoch"} <= codes:
            received = events.recv()
            assert received is not None, f"only {codes}"
            codes.add(decode(Event, received.payload).code)
        interrupted(process)
    with log.open(newline="") as file:
        lines = list(csv.DictReader(file))
    latencies = [float(line["latency_us"]) for line in lines if line["latency_us"]]
    assert len(latencies) >= 10
    assert 50.0 < np.median(latencies)
    late_ms = 1e-3 * float(np.median(latencies)) - 20.0
    by_ms = 0.5 * len(latencies) * late_ms  # half of them are as late, at least
    assert late_ms <= 0.0 or explained(host, f"most commands took {late_ms:.0f} ms more than 20", by_ms, begun_ns, time.monotonic_ns())
    u = np.array([float(line["u_c"]) for line in lines])
    assert u.max() == 0.4
    assert -np.diff(u).min() <= 1.0 * 0.05 + 0.01 + 1e-9  # the ramp: 1 per s over 0.05 s, in steps of 10 ms
    assert (u[-1], lines[-1]["refused"], lines[-1]["starved"]) == (0.0, "1", lines[-1]["starved"])
    assert abs(float(lines[-1]["u"])) < 1e-5


def test_robot_that_is_stopped_sends_each_state_of_its_way_to_rest(endpoint: str, tmp_path: Path) -> None:
    """Its numbers have no gap, so that a recorder misses nothing."""
    with running(ROBOT, endpoint, 1.0, 0.05, tmp_path / "log.csv") as process, peer(endpoint) as bus:
        states, events, commands = bus.subscriber(KEYS.state, capacity=1024), bus.subscriber(KEYS.events, capacity=16), bus.publisher(KEYS.command)
        seqs, heard = itertools.count(1), [next_state(states)]
        while heard[-1].x[3] < 0.3:
            commands.put(command(heard[-1], next(seqs), [0.4, 0.2]))
            heard.append(next_state(states))
        interrupted(process)
        for received in iter(events.recv, None):
            if decode(Event, received.payload).code == "robot_stopped":
                break
        heard += [decode(State, received.payload) for received in states.drain()]
        assert [state.seq - heard[0].seq for state in heard] == list(range(len(heard)))
        assert np.abs(heard[-1].x[3:]).max() < 1e-5


def test_what_is_no_command_is_counted_and_published_and_stops_nothing(endpoint: str, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    with running(ROBOT, endpoint, 1.0, 0.02, log) as process, peer(endpoint) as bus:
        states = bus.subscriber(KEYS.state)
        events = bus.subscriber(KEYS.events, capacity=16)
        commands = bus.publisher(KEYS.command)
        state = next_state(states)
        for payload in (b"", b"\x00\x00\x00\x00", b"\x00\x01\x00\x00" + b"\xff" * 200):
            commands.put_bytes(payload)
        commands.put(replace(command(state, 1, [0.1, 0.1]), u=np.full((5, 2), np.nan)))
        commands.put(replace(command(state, 2, [0.1, 0.1]), u=np.zeros((5, 3))))
        received = events.recv()
        assert received is not None, "no event came in time"
        assert decode(Event, received.payload).code == "message_refused"
        seq = next_state(states).seq
        assert next_state(states).seq > seq
        interrupted(process)
    with log.open(newline="") as file:
        last = list(csv.DictReader(file))[-1]
    assert (last["refused"], last["u_c"], last["x"]) == ("5", "0.0", "0.5")


def test_clock_of_a_robot_whose_process_is_held_up_waits_with_it(endpoint: str, tmp_path: Path) -> None:
    with running(ROBOT, endpoint, 1.0, 0.02, tmp_path / "log.csv") as process, peer(endpoint) as bus:
        states = bus.subscriber(KEYS.state, capacity=256)
        events = bus.subscriber(KEYS.events, capacity=16)
        first = next_state(states)
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        time.sleep(0.2)  # the fault itself
        process.send_signal(signal.SIGCONT)
        received = events.recv()
        assert received is not None, "no event came in time"
        assert decode(Event, received.payload).code == "simulation_held_up"
        assert [next_state(states).stamp_ns - first.stamp_ns for _ in range(20)] == [20 * MS * k for k in range(1, 21)]


def test_source_anchors_its_reference_to_every_new_robot_and_keeps_it_for_late_joiners(endpoint: str, tmp_path: Path) -> None:
    with running(SOURCE, endpoint) as source, peer(endpoint) as bus:
        references = bus.subscriber(KEYS.reference, capacity=4)
        heard = []
        for life in range(2):
            with running(ROBOT, endpoint, 1.0, 0.02, tmp_path / f"{life}.csv"):
                received = references.recv()
                assert received is not None, "no reference came in time"
                heard.append(decode(Reference, received.payload))
        assert heard[1].seq > heard[0].seq
        assert [reference.stamp_ns % (20 * MS) for reference in heard] == [0, 0]
        assert (heard[0].period_ns, heard[0].end, heard[0].p.shape[1]) == (50 * MS, End.STOP, 0)
        np.testing.assert_array_equal(heard[1].y, rows(eight(), 0.05, "consistent"))
        interrupted(source)


@pytest.mark.parametrize(
    ("speed", "said"), [(0.0, "stopped, and stands"), (0.5, "stopped, and coasts with its inputs at rest: p changes by 0.5 m per s")]
)
def test_robot_says_that_it_stands_only_if_it_does(endpoint: str, caplog: pytest.LogCaptureFixture, speed: float, said: str) -> None:
    """A mass whose input is an acceleration, and which was never commanded, does not brake."""
    settings = RobotSettings(pushed(), np.array([0.0, speed]))
    with caplog.at_level("INFO", logger="robot"):
        robot.main(settings, BusSettings(listen=(endpoint,), connect=()), KEYS, duration_s=0.1, stop=threading.Event())
    assert caplog.messages[-1] == said


@pytest.mark.parametrize(("share", "stands"), [(0.0, True), (5e-4, True), (2e-3, False), (1.0, False)])
def test_robot_stands_by_its_rates_in_operation_in_m_as_in_km(share: float, stands: bool) -> None:
    rates = np.array([0.5, 2.0])
    for unit in (1.0, 1e-3, 1e6):
        for j in range(2):
            rate = np.where(np.arange(2) == j, share * unit * rates, 0.0)
            said = robot.standing(pushed(), rate, unit * rates)
            assert (said == "stands") == stands
            assert stands or pushed().states[j].name in said
