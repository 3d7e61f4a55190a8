# SPDX-License-Identifier: Apache-2.0
"""Recordings in the viewer: drawn like the live robot, into a file or on a page for browsers that this machine serves."""

from __future__ import annotations

import json
import subprocess
import urllib.request
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rerun")
from rerun.chunk import RrdReader

from rti_mpc.recording import Recording
from rti_mpc.recording.writer import RecordingWriter
from rti_mpc.wire.cdr import Message, encode
from rti_mpc.wire.keys import Key, Keys
from rti_mpc_service.rig.endpoint import free_port
from rti_mpc_service.view.played import played
from rti_mpc_service.view.screen import page
from rti_mpc_service.view.show import draw_into_file
from tests.command import command
from tests.processes.system import PATIENCE_S, ROOT, command_line, environment, rti_mpc, until
from tests.recording.samples import INFO, MS, REFERENCE, START_NS, UNIX_OFFSET_NS, state, telemetry, write
from tests.recording.samples import command as sent
from tests.service.view.test_view import rows

COUNT = 300
PLANE = [{"name": name, "unit": "m", "angle": False, "role": name} for name in "xy"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    write(path, COUNT)
    return path


def test_recording_is_played_whole_in_the_robot_s_time(run: Path) -> None:
    steps = list(played(Recording(run), "wheels"))
    kinds = Counter(type(entry.message).__name__ for entries in steps for entry in entries)
    assert kinds == {"State": COUNT, "Command": COUNT, "Telemetry": COUNT, "Reference": 1, "Event": 1, "Info": 1}
    times = [entry.time_ns for entries in steps for entry in entries if type(entry.message).__name__ == "State"]
    assert times == [10_000_000 * k for k in range(1, COUNT + 1)]
    assert len(steps) > 10, "not all at once: states advance the axis for what follows them"


def test_recording_is_drawn_into_a_file(run: Path, tmp_path: Path) -> None:
    done = rti_mpc("view", run, "--rerun-save", tmp_path / "run.rrd")
    assert done.returncode == 0, done.stderr
    said = [json.loads(line)["text"] for line in done.stdout.splitlines()]
    assert said == [f"drawing {run}", f"drawn into {tmp_path / 'run.rrd'}, which `rerun {tmp_path / 'run.rrd'}` shows"]
    rows: Counter[str] = Counter()
    for chunk in RrdReader(tmp_path / "run.rrd").stream().to_chunks():
        rows[chunk.entity_path] += chunk.num_rows
    assert rows["/state/x"] == rows["/command/v"] == COUNT + 1, "and its look"
    assert rows["/event/controller"] == 1


def test_several_robots_are_drawn_in_one_view_by_the_time_of_arrival(tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    folder.mkdir()
    write(folder / "1.mcap", COUNT)
    write(folder / "2.mcap", COUNT, keys=Keys(robot="other"))
    done = rti_mpc("view", folder, "--rerun-save", tmp_path / "run.rrd")
    assert done.returncode == 0, done.stderr
    chunks = RrdReader(tmp_path / "run.rrd").stream().to_chunks()
    drawn = {chunk.entity_path for chunk in chunks}
    for robot in ("wheels", "other"):
        assert {f"/{robot}/state/x", f"/{robot}/command/v", f"/{robot}/event/controller", f"/{robot}/lane/mode"} <= drawn
    assert not any(path.startswith(("/state", "/world", "/lane")) for path in drawn)
    (states, *_) = [chunk for chunk in chunks if chunk.entity_path == "/wheels/state/x" and not chunk.is_static]
    first = states.to_record_batch().column("robot_time").to_numpy(zero_copy_only=False).astype("timedelta64[ms]").astype(int)[0]
    assert 0 <= first <= 60, "since the beginning of the recording, to a step; its own clock is at 10 ms"


def write_late(path: Path, robots: dict[str, float], count: int, late_ns: int) -> None:
    """
    Write the messages of robots.

    Args:
        path: The recording.
        robots: Speeds of their clocks by name.
        count: States of each, whose numbers are the values of all that belongs to them.
        late_ns: Time of a robot's clock from a state to what belongs to it.
    """
    info = {**INFO, "states": PLANE, "outputs": [{**label, "state": label["name"]} for label in PLANE]}
    arrivals: list[tuple[int, Keys, Key, Message]] = []
    for name, speed in robots.items():
        keys = Keys(robot=name)
        for k in range(1, count + 1):
            head = state(k)
            arrivals.append((int(head.stamp_ns / speed), keys, keys.state, replace(head, x=np.array([k, 0.0]))))
            plan = replace(sent(k), u=np.full((20, 1), float(k)))
            sample = replace(telemetry(k), cost=float(k), y_ref=np.zeros((20, 2)), y=np.zeros(2))
            anew = replace(REFERENCE, seq=k, stamp_ns=head.stamp_ns, y=np.full((2, 2), float(k)), p=np.zeros((2, 0)))
            belongs = [(keys.command, plan), (keys.actuation, plan), (keys.telemetry, sample), (keys.reference, anew)]
            arrivals += [(int((head.stamp_ns + late_ns) / speed), keys, key, message) for key, message in belongs]
    writer = RecordingWriter(path, START_NS, UNIX_OFFSET_NS, "0.0")
    for name in robots:
        writer.add(name, Keys(robot=name).info("controller"), START_NS, json.dumps(info).encode())
    for local_ns, keys, key, message in sorted(arrivals, key=lambda arrival: arrival[0]):
        writer.add(keys.robot, key, START_NS + local_ns, encode(message), message.seq)
    writer.finish({"recorded": str(len(arrivals))})


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_of_several_robots_what_comes_late_is_drawn_beside_its_state(speed: float, tmp_path: Path) -> None:
    write_late(tmp_path / "run.mcap", {"ant": speed, "bee": 1.0}, COUNT, 300 * MS)
    draw_into_file(Recording(tmp_path / "run.mcap"), tmp_path / "run.rrd")
    for robot in ("ant", "bee"):
        states = {k: time_ns for time_ns, k in rows(tmp_path / "run.rrd", f"{robot}/state/x")}
        assert len(states) == COUNT
        assert len(set(states.values())) == COUNT, "each at a time of its own"
        references = {strip[0][0]: time_ns for time_ns, strip in rows(tmp_path / "run.rrd", f"{robot}/world/reference", "LineStrips3D:strips")}
        assert references == states
        for drawn in ("command/v", "actuation/v", "telemetry/cost"):
            beside = {k: time_ns - states[k] for time_ns, k in reversed(rows(tmp_path / "run.rrd", f"{robot}/{drawn}"))}
            assert len(beside) >= COUNT, drawn
            assert set(beside.values()) == {0}, drawn


def test_what_is_no_recording_is_refused_in_a_line(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_text("nothing")
    for words in ((tmp_path / "run.mcap",), (tmp_path / "none.mcap",), ("a.mcap", "b.mcap")):
        done = command("view", *words, "--rerun-save", tmp_path / "run.rrd")
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr


@pytest.mark.slow
def test_page_for_browsers_comes_from_this_machine_on_loopback_alone(run: Path, tmp_path: Path) -> None:
    web, port = free_port(), free_port()
    line = command_line("view", run, "--web", "--rerun-web-port", web, "--rerun-connect", f"127.0.0.1:{port}")
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(line, cwd=ROOT, env=environment(tmp_path), stdout=log, stderr=subprocess.STDOUT)
    try:
        address = page(f"rerun+http://127.0.0.1:{port}/proxy", web)
        until(lambda: address in (tmp_path / "log").read_text(), "the page is served", pause_s=0.05)
        assert b"rerun" in urllib.request.urlopen(address, timeout=10).read().lower()
        assert len(urllib.request.urlopen(f"http://127.0.0.1:{web}/re_viewer_bg.wasm", timeout=30).read()) > 1_000_000
        listening = [line.split()[1] for line in Path("/proc/net/tcp").read_text().splitlines()[1:] if line.split()[3] == "0A"]
        ours = [local for local in listening if int(local.partition(":")[2], 16) in (web, port)]
        assert sorted(local.partition(":")[0] for local in ours) == ["0100007F", "0100007F"]
    finally:
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
    until(lambda: not _listens(web), "the server has ended with it")


def _listens(port: int) -> bool:
    return any(int(line.split()[1].partition(":")[2], 16) == port for line in Path("/proc/net/tcp").read_text().splitlines()[1:] if " 0A " in line)
