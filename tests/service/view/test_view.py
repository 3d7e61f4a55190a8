# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from queue import Queue
from threading import Event as Flag
from threading import Thread
from typing import Any

import numpy as np
import pytest

from rti_mpc_service.rig.endpoint import free_port

pytest.importorskip("rerun")
from rerun.chunk import RrdReader

from rti_mpc.contract.message import Command, Event, Severity, State, Telemetry
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.errors import ConfigError, Stopped
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.cdr import decode
from rti_mpc.wire.keys import Keys
from rti_mpc_service.view.listener import Listener
from rti_mpc_service.view.outlet import file_outlet
from rti_mpc_service.view.screen import reached, spawn_viewer, viewer_url
from rti_mpc_service.view.view import Screens
from rti_mpc_service.view.view import main as view
from tests.in_time import PATIENT, ends_in_time
from tests.processes.system import until
from tests.service.view.test_view_outlet import Viewer as Screen
from tests.slow import slow_but

ROOT = Path(__file__).parents[3]
PATIENCE_S = 60.0
PERIOD_NS = 10**7  # of the publisher's stamps

# A robot and its controller in one: epoch in x, sequence number in y; a line for each tenth sample once a viewer is there.
PUBLISHER = """
import itertools, sys, time
import numpy as np
from rti_mpc.contract.message import Command, End, Event, Reference, Severity, State, Telemetry
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.keys import Keys

port, epoch = sys.argv[1], int(sys.argv[2])
keys = Keys(robot="r")
label = lambda name: {"name": name, "unit": "m", "angle": False, "role": name if name in "xy" else "", "state": name}
info = {"role": "controller", "states": [label("x"), label("y")], "inputs": [label("f")], "outputs": [label("x"), label("y")], "dt_s": 0.01}
with Bus.join(BusSettings(listen=(f"tcp/127.0.0.1:{port}",), connect=(f"tcp/127.0.0.1:{port}",)), keys) as bus:
    bus.publish_json(keys.info("controller"), info)
    reference = bus.publisher(keys.reference)
    reference.put(Reference(epoch, 1, 0, 10**7, End.HOLD, np.zeros((2, 2)), np.zeros((2, 0))))
    state, command = bus.publisher(keys.state), bus.publisher(keys.command)
    telemetry, event = bus.publisher(keys.telemetry), bus.publisher(keys.event("robot"))
    while not bus.is_alive("viewer"):
        pass
    event.put(Event(epoch, 1, 0, "robot", Severity.INFO, "started", f"epoch {epoch}"))
    for k in itertools.count(1):
        stamp, x = k * 10**7, np.array([float(epoch), float(k)])
        state.put(State(epoch, k, stamp, x))
        command.put(Command(epoch, k, stamp, epoch, k, stamp, stamp + 10**8, 1, Mode.TRACKING, QpStatus.SOLVED, 10**7, np.ones((2, 1))))
        numbers = (5, 0.0, 0.0, 1.0, 0.0, 10.0, 20.0, 30.0, 0.0, 0.0, 0, 0, 1)
        arrays = (x, np.zeros((3, 2)), np.ones((2, 1)), np.zeros((2, 2)))
        telemetry.put(Telemetry(epoch, k, stamp, k, stamp, Mode.TRACKING, QpStatus.SOLVED, *numbers, *arrays))
        if k % 10 == 0:
            print(k, flush=True)
        time.sleep(0.005)
"""
VIEWER = """
import logging, sys
from pathlib import Path
from rti_mpc.wire.bus import BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.entry import enter
from rti_mpc_service.view.view import Screens, main

logging.basicConfig(level=logging.INFO)
bus, live = BusSettings(connect=(f"tcp/127.0.0.1:{sys.argv[1]}",)), sys.argv[3] if len(sys.argv) > 3 else None
enter(lambda: sys.exit(main(bus, Keys(robot="r"), Screens(rerun_save=Path(sys.argv[2]), rerun_connect=live))))
"""


@pytest.fixture
def port() -> int:
    return free_port()


class Child:
    """A process whose lines are read with a timeout, killed at the end."""

    def __init__(self, source: str, *arguments: object) -> None:
        command = [sys.executable, "-c", source, *map(str, arguments)]
        self.process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.lines: Queue[str] = Queue()
        self._reader = Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(line)

    def wait_for(self, text: str) -> str:
        deadline = time.monotonic() + PATIENCE_S
        while True:
            line = self.lines.get(timeout=max(0.0, deadline - time.monotonic()))
            if text in line:
                return line

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def children() -> Iterator[list[Child]]:
    children: list[Child] = []
    yield children
    for child in children:
        child.kill()


def rows(path: Path, entity: str, column: str = "Scalars:scalars") -> list[tuple[int, Any]]:
    """What a finished recording holds of a scalar: robot time in ns, value."""
    pairs = []
    for chunk in RrdReader(path).stream().to_chunks():
        if chunk.entity_path == f"/{entity}" and not chunk.is_static:
            batch = chunk.to_record_batch()
            times = batch.column("robot_time").to_numpy(zero_copy_only=False).astype(np.int64)
            pairs += zip(times.tolist(), [v[0] for v in batch.column(column).to_pylist()], strict=True)
    return pairs


def missing(path: Path, *entities: str) -> int:
    """Count the samples between the first and the last of each entity that a finished recording does not hold."""
    times = [[time_ns for time_ns, _ in rows(path, entity)] for entity in entities]
    return sum((each[-1] - each[0]) // PERIOD_NS + 1 - len(each) for each in times)


def changes(path: Path, lane: str) -> list[tuple[int, str]]:
    """What a finished recording holds of a lane: robot time in ns, value from then on."""
    return rows(path, lane, "StateChange:state")


@pytest.mark.parametrize("number", slow_but([signal.SIGINT, signal.SIGTERM], signal.SIGINT))
def test_a_stopped_viewer_leaves_everything_received_in_the_recording(
    children: list[Child], port: int, tmp_path: Path, number: signal.Signals
) -> None:
    children += [Child(PUBLISHER, port, 1), Child(VIEWER, port, tmp_path / "run.rrd")]
    publisher, viewer = children
    publisher.wait_for("100\n")
    viewer.process.send_signal(number)
    assert ends_in_time(viewer.process, "the end", 2000.0) == 0
    received, lost, refused = map(int, re.findall(r"\d+", viewer.wait_for(" messages, ").rpartition("INFO")[2]))
    samples = {entity: len(rows(tmp_path / "run.rrd", entity)) for entity in ("state/y", "command/f", "telemetry/cost")}
    assert min(samples.values()) > 0  # how many of the hundred have come when it ends is up to the host
    assert received == sum(samples.values()) + len(["info", "reference", "event"])
    assert refused == 0
    numbers = [value for _, value in rows(tmp_path / "run.rrd", "state/y")]
    assert numbers == sorted(set(numbers))
    assert lost == missing(tmp_path / "run.rrd", "state/y", "command/f", "telemetry/cost")  # on its way, where the host holds up a link
    assert all(
        value == pytest.approx(1e3 * np.hypot(1.0, k)) for (_, value), k in zip(rows(tmp_path / "run.rrd", "error/position"), numbers, strict=True)
    )


def test_a_robot_killed_and_started_again_goes_on_in_the_recording(children: list[Child], port: int, tmp_path: Path) -> None:
    children += [Child(VIEWER, port, tmp_path / "run.rrd"), Child(PUBLISHER, port, 1)]
    viewer, publisher = children
    publisher.wait_for("30\n")
    publisher.kill()
    children[1] = Child(PUBLISHER, port, 2)
    children[1].wait_for("30\n")
    viewer.process.terminate()
    assert viewer.process.wait(PATIENCE_S) == 0
    lives = Counter(epoch for _, epoch in rows(tmp_path / "run.rrd", "state/x"))
    assert min(lives[1.0], lives[2.0]) >= 20
    times = [time_ns for time_ns, _ in rows(tmp_path / "run.rrd", "state/x")]
    assert times == sorted(times)  # the second life behind the first, though its clock began again


@pytest.mark.skipif(not hasattr(resource, "prlimit"), reason="filling the disk of one process needs prlimit")
def test_a_disk_that_fills_up_ends_the_recording_but_neither_the_viewer_nor_what_it_shows(children: list[Child], port: int, tmp_path: Path) -> None:
    screen = Screen(tmp_path)
    screen.start()
    children += [Child(PUBLISHER, port, 1), Child(VIEWER, port, tmp_path / "run.rrd", screen.url)]
    viewer = children[1]
    try:
        with Bus.join(BusSettings(connect=(f"tcp/127.0.0.1:{port}",)), Keys(robot="r")) as bus:
            events = bus.subscriber(bus.keys.event("viewer"), capacity=8)
            viewer.wait_for(f"{screen.url}: open")
            until(lambda: (tmp_path / "run.rrd").stat().st_size > 0, "it records")
            resource.prlimit(viewer.process.pid, resource.RLIMIT_FSIZE, (1, 1))  # to the writer of a file as good as a full disk
            event = decode(Event, until(lambda: next(iter(events.drain()), None), "an event").payload)
            assert (event.source, event.severity, event.code) == ("viewer", Severity.ERROR, "outlet_failed")
            assert re.match(rf"{tmp_path}/run.rrd: the recording ends here, with [0-9.]+ MB free on its disk: ", event.text)
            assert event.text in viewer.wait_for("the recording ends here")
            shown = screen.shown
            until(lambda: screen.shown > shown, "the screen goes on")
            viewer.process.send_signal(signal.SIGINT)
            assert ends_in_time(viewer.process, "the end", 3000.0) == 1
    finally:
        screen.kill()
    assert re.search(r" messages, \d+ lost, 0 refused", viewer.wait_for(" messages, "))  # a busy machine drops some


def test_a_listener_that_falls_behind_keeps_the_newest_and_counts_the_rest(port: int) -> None:
    keys = Keys(robot="r")
    endpoint = f"tcp/127.0.0.1:{port}"
    with Bus.join(BusSettings(listen=(endpoint,), cfg=PATIENT), keys) as robot, Bus.join(BusSettings(connect=(endpoint,)), keys) as bus:
        listener = Listener(bus, capacity=10)
        publisher = robot.publisher(keys.state)
        seen = 0
        deadline = time.monotonic() + PATIENCE_S
        while not (entries := listener.drain()):
            assert time.monotonic() < deadline
            seen += 1
            publisher.put(State(1, seen, seen, np.zeros(1)))
        last = seen + 50
        for k in range(seen + 1, last + 1):
            publisher.put(State(1, k, k, np.zeros(1)))
        marker = robot.publisher(keys.telemetry)  # a refused payload on the same link, behind the states
        marker.put(State(1, 1, 1, np.zeros(1)))
        bytes_behind = bus.subscriber(keys.telemetry, capacity=1)
        while bytes_behind.try_recv() is None:
            assert time.monotonic() < deadline
            marker.put(State(1, 1, 1, np.zeros(1)))
        entries = [entry for entry in listener.drain() if isinstance(entry.message, State)]
        assert [entry.message.seq for entry in entries if isinstance(entry.message, State)] == list(range(last - 9, last + 1))
        assert listener.lost >= 40 - 10
        assert listener.refused > 0


def test_a_takeover_behind_a_guard_is_seen_in_the_recording(port: int, tmp_path: Path) -> None:
    """Of a leader that dies after its third command, and a standby; the guard tells the robot a ramp between them."""
    keys, endpoint, path = Keys(robot="r"), f"tcp/127.0.0.1:{port}", tmp_path / "run.rrd"
    label = {"name": "x", "unit": "m", "angle": False}
    outlet = file_outlet(path, "r")
    with Bus.join(BusSettings(listen=(endpoint,), cfg=PATIENT), keys) as robot, Bus.join(BusSettings(connect=(endpoint,)), keys) as bus:
        listener = Listener(bus)
        robot.publish_json(keys.info("controller"), {"role": "controller", "states": [label], "inputs": [{**label, "name": "f"}]})
        state, telemetry = robot.publisher(keys.state), robot.publisher(keys.telemetry)
        command, actuation = robot.publisher(keys.command), robot.publisher(keys.actuation)

        def hear(messages: int) -> bool:
            outlet.offer(listener.drain())
            return listener.received >= messages

        until(lambda: hear(1), "the description")
        for k in range(1, 9):
            stamp, epoch = k * 10**8, 5 if k <= 3 else 6
            head = (stamp, 1, k, stamp, stamp + 10**8, 9)
            state.put(State(1, k, stamp, np.ones(1)))
            u, status = np.full((2, 1), float(k)), (Mode.TRACKING, QpStatus.SOLVED)
            if k in (4, 5):
                actuation.put(Command(8, k, *head, Mode.BRAKING, QpStatus.NONE, 10**8, 0.0 * u))
            else:
                command.put(Command(epoch, k, *head, *status, 10**8, u))
                actuation.put(Command(8, k, *head, *status, 10**8, u))
                telemetry.put(Telemetry(epoch, k, stamp, k, stamp, *status, 5, *(8 * [0.0]), 0.0, 0, 0, 1, *np.ones((2, 1, 1)), u, np.zeros((2, 0))))
            until(lambda k=k: hear(1 + 4 * k - 2 * sum(gap <= k for gap in (4, 5))), f"sample {k}")
    assert outlet.close()
    commanded, acted = dict(rows(path, "command/f")), dict(rows(path, "actuation/f"))
    assert list(commanded.values()) == [1.0, 2.0, 3.0, 6.0, 7.0, 8.0]
    assert list(acted.values()) == [1.0, 2.0, 3.0, 0.0, 0.0, 6.0, 7.0, 8.0]
    assert changes(path, "lane/leader") == [(1 * 10**8, "epoch 5"), (6 * 10**8, "epoch 6")]
    assert changes(path, "lane/guard") == [(1 * 10**8, "TRACKING"), (4 * 10**8, "BRAKING"), (6 * 10**8, "TRACKING")]
    assert changes(path, "lane/mode") == [(1 * 10**8, "TRACKING")]


@pytest.mark.parametrize("name", ["", "ant/", "ant*", "an ant"])
def test_a_name_that_no_robot_can_have_is_refused_before_anything_is_joined(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="robot must be a word of letters, digits"):
        view(BusSettings(), Keys(), Screens(rerun_save=tmp_path / "run.rrd"), robots=["ant", name], stop=Flag())
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("address", ["", "nowhere", "host:port", "http://127.0.0.1:9876", ":9876"])
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="HOST:PORT"):
        assert Screens(rerun_connect=address).url


def test_an_address_becomes_a_url_of_reruns() -> None:
    assert viewer_url("127.0.0.1:9000") == "rerun+http://127.0.0.1:9000/proxy"
    assert viewer_url("rerun+https://host:9000/proxy") == "rerun+https://host:9000/proxy"


def test_a_spawned_viewer_that_has_ended_is_told_of(port: int, children: list[Child], tmp_path: Path) -> None:
    """Its own words are lost among others; Rerun ends at once where there is no screen."""
    no_screen = "import os\nos.environ.pop('DISPLAY', None)\nos.environ.pop('WAYLAND_DISPLAY', None)\n"
    source = no_screen + VIEWER.replace("rerun_connect=live", "rerun_connect=live, rerun_spawn=True")
    children.append(Child(source, port, tmp_path / "run.rrd", f"127.0.0.1:{free_port()}"))
    children[0].wait_for("the Rerun viewer has ended")


def test_a_recording_waits_for_no_viewer_that_has_ended(port: int) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    with pytest.raises(ConfigError, match="the Rerun viewer has ended; where there is no screen, --rerun-save records to a file"):
        reached(viewer_url(f"127.0.0.1:{port}"), Flag(), ended)


def test_a_recording_is_not_drawn_where_its_user_stopped_before_a_viewer_listened(port: int) -> None:
    """Rerun would wait for a viewer for more than a minute."""
    stop = Flag()
    stop.set()
    with pytest.raises(Stopped):
        reached(viewer_url(f"127.0.0.1:{port}"), stop)


@pytest.mark.parametrize("limit", ["25%", "12.5%", "2GB", "1.5 GiB", "800MB"])
def test_memory_of_a_viewer_is_a_share_or_a_size(limit: str) -> None:
    assert Screens(rerun_memory_limit=limit).rerun_memory_limit == limit


@pytest.mark.parametrize("limit", ["much", "", "2", "GB", "-1GB", "25 percent"])
def test_any_other_memory_of_a_viewer_is_refused_since_rerun_would_have_no_limit(limit: str) -> None:
    with pytest.raises(ConfigError, match="rerun-memory-limit must be a share such as 25% or a size such as 2GB, got"):
        Screens(rerun_memory_limit=limit)


def test_a_viewer_is_spawned_on_loopback_only() -> None:
    with pytest.raises(ConfigError, match="rerun-spawn must be on 127"):
        spawn_viewer("rerun+http://192.0.2.1:9876/proxy", "25%")
