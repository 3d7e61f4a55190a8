# SPDX-License-Identifier: Apache-2.0
"""Recordings of a robot that nobody drives, written without a bus."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from rti_mpc.contract.message import Command, End, Event, Reference, Severity, State, Telemetry
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.recording.writer import RecordingWriter
from rti_mpc.wire.cdr import Message, encode
from rti_mpc.wire.keys import Key, Keys

KEYS = Keys(robot="wheels")
START_NS, UNIX_OFFSET_NS = 5_000_000_000, 1_700_000_000_000_000_000
MS = 1_000_000
RNG = np.random.default_rng(1)
INFO = {
    "role": "controller",
    "model": "unicycle",
    "states": [{"name": "x", "unit": "m", "angle": False, "role": "x"}, {"name": "psi", "unit": "rad", "angle": True, "role": "heading"}],
    "inputs": [{"name": "v", "unit": "m/s", "angle": False}],
    "outputs": [{"name": "x", "unit": "m", "angle": False, "state": "x"}],
    "disturbances": [],
    "dt_s": 0.1,
    "lbu": [-1.0],
    "ubu": [1.0],
    "epoch": 7,
}


def state(k: int) -> State:
    return State(3, k, 10 * MS * k, RNG.normal(size=2), RNG.normal(size=1))


def command(k: int) -> Command:
    stamps = (3, k, 10 * MS * k, 10 * MS * k + 250 * MS)
    return Command(7, k, 10 * MS * k, *stamps, 1, Mode.TRACKING, QpStatus.SOLVED, 100 * MS, RNG.normal(size=(20, 1)))


def telemetry(k: int) -> Telemetry:
    x, u, y = RNG.normal(size=(21, 2)), RNG.normal(size=(20, 1)), RNG.normal(size=(20, 1))
    scalars = (2, 1e-9, 1e-8, 1.5, 0.0, 100.0, 50.0, 200.0, 0.0, 0.09)
    return Telemetry(7, k, 10 * MS * k, k, 10 * MS * k, Mode.TRACKING, QpStatus.SOLVED, *scalars, 0, 0, 0, x[0], x, u, y, y=y[0])


REFERENCE = Reference(2, 1, 0, 100 * MS, End.HOLD, RNG.normal(size=(30, 1)), np.zeros((30, 0)))
EVENT = Event(7, 1, 0, "controller", Severity.INFO, "mode", "waiting to tracking: driving")


def write(path: Path, count: int, *, chunk: int = 50, keys: Keys = KEYS, finish: bool = True, states: int = 1) -> list[tuple[Key, Message]]:
    """Write a recording of so many commands, each after so many states, a chunk every so many messages; return its messages."""
    writer = RecordingWriter(path, START_NS, UNIX_OFFSET_NS, "0.0")
    writer.attach(f"{keys.robot}/9/config.toml", "application/toml", b"robot = 'wheels'\n", START_NS)
    writer.add(keys.robot, keys.info("controller"), START_NS, json.dumps(INFO).encode())
    written: list[tuple[Key, Message]] = [(keys.reference, REFERENCE), (keys.event("controller"), EVENT)]
    for k in range(1, count + 1):
        written += [(keys.state, state(states * k + i)) for i in range(states)]
        written += [(keys.command, command(k)), (keys.telemetry, telemetry(k))]
    for i, (key, message) in enumerate(written):
        writer.add(keys.robot, key, START_NS + i * MS, encode(message), message.seq)
        if i % chunk == chunk - 1:
            writer.flush()
    if finish:
        writer.finish({"recorded": str(len(written))})
    else:
        writer.abandon()
    return written
