# SPDX-License-Identifier: Apache-2.0
"""
Latency from a state sent to its command received, compared with a bare echo over the same bus.

Robot and controller are the real processes, 100 samples per second in real time.
The echo is Zenoh alone, in a process of its own on a link of its own: messages of
a state's size out, of a command's size back, one in the middle between any two
samples. Times are ratios within this one run: both sides meet the same machine.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh

from rti_mpc.contract.message import Command, State, Telemetry
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.cdr import decode, encode
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.host import machine
from rti_mpc_service.rig import robot_log
from rti_mpc_service.rig.children import Children
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.bench.driven import INFO, quantiles, sampled
from tests.processes.system import PATIENCE_S, until

pytestmark = pytest.mark.benchmark

DT_S = 0.01
SHORT = "CI" in os.environ
SAMPLES = 600 if SHORT else 2000
COLD_SAMPLES = 200  # first samples, left out: the robot drives to its path
QOS = {"priority": zenoh.Priority.REAL_TIME, "congestion_control": zenoh.CongestionControl.DROP, "express": True}
ECHO = """
import sys, zenoh
config = zenoh.Config()
for name, value in {"listen/endpoints": '["%s"]' % sys.argv[1], "scouting/multicast/enabled": "false"}.items():
    config.insert_json5(name, value)
session = zenoh.open(config)
qos = {"priority": zenoh.Priority.REAL_TIME, "congestion_control": zenoh.CongestionControl.DROP, "express": True}
pongs = session.declare_publisher("pong", **qos)
pings = session.declare_subscriber("ping", zenoh.handlers.RingChannel(1))
payload = bytes(int(sys.argv[2]))
while True:
    pings.recv()
    pongs.put(payload)
"""


@pytest.fixture
def config(tmp_path: Path) -> Config:
    """The shipped robot, ten times as often."""
    return load(sampled(tmp_path, DT_S))


@contextmanager
def bare_session(size: int) -> Iterator[zenoh.Session]:
    """Link to a process that answers with messages of this size, in bytes."""
    endpoint = free_endpoint()
    config = zenoh.Config()
    for name, value in {"listen/endpoints": "[]", "connect/endpoints": f'["{endpoint}"]', "scouting/multicast/enabled": "false"}.items():
        config.insert_json5(name, value)
    config.insert_json5("connect/timeout_ms", "10000")
    with subprocess.Popen([sys.executable, "-c", ECHO, endpoint, str(size)]) as process:
        try:
            with zenoh.open(config) as session:
                yield session
        finally:
            process.kill()


class Pings(threading.Thread):
    """Pings in the middle between samples, in a thread that does nothing else."""

    def __init__(self, bus: Bus, session: zenoh.Session, payload: bytes) -> None:
        super().__init__(daemon=True)
        self.samples = bus.subscriber(bus.keys.telemetry)
        self.pings = session.declare_publisher("ping", **QOS)
        self.pongs = session.declare_subscriber("pong", zenoh.handlers.RingChannel(1))
        self.payload = payload
        self.round_trip_us: list[float] = []

    def run(self) -> None:
        for _ in iter(self.samples.recv, None):
            time.sleep(DT_S / 2)
            start_ns = time.monotonic_ns()
            self.pings.put(self.payload)
            self.pongs.recv()
            self.round_trip_us.append(1e-3 * (time.monotonic_ns() - start_ns))


def test_command_takes_at_most_one_and_a_half_echoes_and_the_feedback(config: Config, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    endpoint, toml, keys = free_endpoint(), tmp_path / "robot.toml", config.keys()
    nu = 2
    command = encode(Command(0, 0, 0, 0, 0, 0, 0, 0, Mode.TRACKING, QpStatus.SOLVED, 0, np.zeros((config.ocp.N, nu))))
    telemetry: list[Telemetry] = []
    with Bus.join(BusSettings(listen=(endpoint,), connect=()), keys) as bus, bare_session(len(command)) as session, Children(tmp_path) as children:
        lives: set[str] = set()
        bus.watch_alive(lambda role, present: (lives.add if present else lives.discard)(role))
        children.start("controller", "rti_mpc_service.cli", "run", toml, "-e", endpoint)
        children.start("reference", "rti_mpc_service.cli", "reference", toml, "-e", endpoint, "--duration", 120)
        until(lambda: {"controller", "reference"} <= lives, "controller and reference")
        samples = bus.subscriber(keys.telemetry, capacity=4096)
        pings = Pings(bus, session, encode(State(0, 0, 0, np.zeros(5))))
        pings.start()
        children.start("robot", "rti_mpc_service.cli", "sim", toml, "-l", "tcp/127.0.0.1:0", "-e", endpoint, "--log", tmp_path / "robot.csv")

        def enough() -> bool:
            telemetry.extend(decode(Telemetry, received.payload) for received in samples.drain())
            return len(telemetry) >= SAMPLES

        until(enough, f"{SAMPLES} samples", pause_s=0.2, patience_s=2 * SAMPLES * DT_S + PATIENCE_S)
        for name in ("controller", "robot", "reference"):
            children.end(name)
    log = robot_log.read(tmp_path / "robot.csv", INFO)
    latency_us = dict(zip(log.seq.tolist(), log.latency_us.tolist(), strict=True))
    rows = [(latency_us[sample.state_seq], sample.feedback_us, sample.prepare_us) for sample in telemetry[COLD_SAMPLES:SAMPLES]]
    latency, feedback, prepare = np.array(rows).T
    latency, echo = latency[np.isfinite(latency)], np.array(pings.round_trip_us[COLD_SAMPLES:])
    allowed_us = 1.5 * np.median(echo) + np.median(feedback)
    with capsys.disabled():
        print(f"\n{machine.machine_info()}")
        for name, values in {"state to command": latency, "bare echo": echo, "feedback": feedback, "preparation": prepare}.items():
            print(f"{name:16} {quantiles(values)}, {len(values)} samples")
        print(f"p50 of state to command is {np.median(latency) / allowed_us:.2f} of 1.5 echoes and the feedback, {allowed_us:.0f} us")
    if not SHORT:  # the figure is one of a quiet machine
        assert len(latency) > 0.98 * (SAMPLES - COLD_SAMPLES)
        assert np.median(latency) <= allowed_us
