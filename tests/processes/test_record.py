# SPDX-License-Identifier: Apache-2.0
"""
Recorder as a process: killed at any instant, beside a driven robot, and of several robots.

`make kills` kills it 50 times, `--kills` says how often.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest

from rti_mpc.contract.message import State
from rti_mpc.recording import Recording
from rti_mpc.recording.repair import repair
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.shipped import SHIPPED
from tests.command import command
from tests.in_time import MS, PATIENT, in_time
from tests.processes.system import KEYS, PATIENCE_S, ROOT, System, command_line, environment, until
from tests.recording.test_recording import read_by_others

pytestmark = pytest.mark.slow

RATE_HZ = 200
LAST_MS = 1000.0  # of a recording, which a killed recorder may not have written yet


class Chatter:
    """A robot that publishes its states, and says which it has published last."""

    def __init__(self, bus: Bus) -> None:
        self.seq = 0
        self._publisher = bus.publisher(bus.keys.state)
        self._over = Event()
        self._thread = Thread(target=self._run)

    def __enter__(self) -> Chatter:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(1 / RATE_HZ):
            self._publisher.put(State(1, self.seq + 1, (self.seq + 1) * 5_000_000, np.arange(5.0), np.zeros(2)))
            self.seq += 1


@contextmanager
def recorder(folder: Path, endpoint: str, out: Path, *options: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run a recorder until the end of the context at the latest."""
    with (folder / "recorder.log").open("ab") as log:
        arguments = command_line("record", SHIPPED, "-e", endpoint, "--out", out, *options)
        process = subprocess.Popen(arguments, cwd=ROOT, env=environment(folder), stdout=log, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_recorder_killed_at_any_instant_leaves_all_but_the_last_second(tmp_path: Path, host: Host, pytestconfig: pytest.Config) -> None:
    rng, endpoint = np.random.default_rng(16), free_endpoint()
    with Bus.join(BusSettings(listen=(endpoint,), connect=(), cfg=PATIENT), KEYS) as bus, Chatter(bus) as chatter:
        for number in range(pytestconfig.getoption("--kills")):
            path = tmp_path / f"{number}.mcap"
            with recorder(tmp_path, endpoint, path) as process:
                begun = until(lambda path=path: path.exists() and path.stat().st_size > 1500 and chatter.seq, "states are recorded")
                time.sleep(rng.uniform(0.0, 1.5))  # the instant is what the test is about
                last, killed_ns = chatter.seq, time.monotonic_ns()
                process.kill()
                process.wait()
            recording = Recording(path)
            seqs = [recorded.message.seq for recorded in recording.messages(streams=("state",))]
            assert not recording.whole
            assert seqs == list(range(seqs[0], seqs[-1] + 1))
            assert seqs[0] <= begun
            unwritten_ms = 1e3 * (last - seqs[-1]) / RATE_HZ
            in_time(host, "what a killed recorder had not written yet", unwritten_ms, LAST_MS, killed_ns - round(unwritten_ms * MS))
            assert repair(path, path) >= len(seqs)
            assert read_by_others(path)["/rti_mpc/pioneer/state"] == len(seqs)


def test_recording_of_a_driven_robot_holds_everything_that_a_stranger_needs(tmp_path: Path) -> None:
    with System(tmp_path) as system:
        with recorder(tmp_path, system.endpoint, tmp_path / "run.mcap") as process:
            system.start("robot", "controller", "reference")
            system.tracking()
            until(lambda: b"tracking" in (tmp_path / "run.mcap").read_bytes() or system.sample().seq > 20, "it drives")
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
    recording = Recording(tmp_path / "run.mcap")
    assert recording.whole
    assert recording.outcome["missing"] == recording.outcome["refused"] == "0"
    assert {name.rpartition("/")[2] for name in recording.attachments} == {"config.toml", "pioneer_3dx.py", "equations.txt", "versions.json"}
    assert {recorded.role for recorded in recording.infos()} == {"controller", "robot"}
    heard = {recorded.stream for recorded in recording.messages()}
    assert {"state", "command", "telemetry", "reference", "event", "info"} <= heard
    read_by_others(tmp_path / "run.mcap")


def test_robots_by_a_pattern_are_recorded_together(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with Bus.join(BusSettings(listen=(endpoint,), connect=()), KEYS) as bus:
        others = [bus.beside(Keys(robot=name)) for name in ("ant", "anthill", "bee")]
        for other in others:
            other.alive("robot")
        out = tmp_path / "run.mcap"
        with Chatter(others[0]), Chatter(others[1]), Chatter(others[2]), recorder(tmp_path, endpoint, out, "--robot", "ant*") as process:
            until(lambda: _robots(out) == ["ant", "anthill"], "both are recorded", pause_s=0.2)
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
    assert Recording(out).robots == ["ant", "anthill"]


def _robots(path: Path) -> list[str]:
    return Recording(path).robots if path.exists() and path.stat().st_size > 100 else []


def test_repair_of_something_else_is_refused_in_a_line(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no recording")
    done = command("record", "--repair", tmp_path / "notes.txt")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "--repair must be a recording" in done.stderr
