# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from queue import Queue
from threading import Event

import numpy as np
import pytest

pytest.importorskip("rerun")
import rerun as rr
import rerun_cli
from rerun.chunk import RrdReader
from rerun_bindings import check_for_rrd_footer

from rti_mpc.contract.message import State
from rti_mpc.errors import ConfigError
from rti_mpc.wire import reach
from rti_mpc.wire.info import Info
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.rig.endpoint import free_port
from rti_mpc_service.view.outlet import Outlet, file_outlet, viewer_outlet
from rti_mpc_service.view.recording import Entry
from tests.in_time import MS, in_time

BINARY = Path(rerun_cli.__file__).with_name("rerun")  # the script of that name is a wrapper whose child a signal would orphan
INFO = Info.from_json({"role": "controller", "states": [{"name": "q", "unit": "m", "angle": False}]})
PATIENCE_S = 60.0


def state(k: int, width: int = 1) -> Entry:
    return Entry(k, State(1, k, k, np.full(width, float(k))))


def values(path: Path) -> list[float]:
    """What a recording holds of q."""
    chunks = [chunk for chunk in RrdReader(path).stream().to_chunks() if chunk.entity_path == "/state/q" and not chunk.is_static]
    return sorted(value[0] for chunk in chunks for value in chunk.to_record_batch().column("Scalars:scalars").to_pylist())


def await_(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


class Viewer:
    """Stands in for a viewer, without a screen: Rerun's own server, which saves what it is shown."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = free_port()
        self.lives = 0

    @property
    def url(self) -> str:
        return f"rerun+http://127.0.0.1:{self.port}/proxy"

    @property
    def path(self) -> Path:
        return self.folder / f"viewer-{self.lives}.rrd"

    def start(self) -> None:
        self.lives += 1
        options = ["--save", self.path, "--bind", "127.0.0.1", "--port", str(self.port)]
        self.process = subprocess.Popen([BINARY, *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    @property
    def shown(self) -> int:
        """Bytes saved so far."""
        return self.path.stat().st_size if self.path.exists() else 0

    def shows(self) -> list[float]:
        """What it holds of q so far; nothing while a chunk is half written."""
        try:
            return values(self.path) if self.shown else []
        except RuntimeError:
            return []


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[Viewer]:
    viewer = Viewer(tmp_path)
    viewer.start()
    yield viewer
    viewer.kill()


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy host may need seconds for what takes milliseconds."""
    monkeypatch.setattr("rti_mpc_service.view.outlet.FILE_CLOSE_TIMEOUT_S", 60.0)


@pytest.mark.usefixtures("patient")
def test_a_closed_file_holds_everything_offered(tmp_path: Path) -> None:
    outlet = file_outlet(tmp_path / "folder" / "run.rrd", "robot")
    outlet.offer([Entry(0, INFO)])
    for k in range(1000):
        outlet.offer([state(k)])
    assert outlet.close()
    assert values(tmp_path / "folder" / "run.rrd") == list(range(1000))


@pytest.mark.usefixtures("patient")
def test_a_recording_has_no_footer_for_which_to_remember_every_chunk(tmp_path: Path) -> None:
    """Rerun would keep the particulars of each in memory until the end: hundreds of MiB an hour."""
    outlet = file_outlet(tmp_path / "run.rrd", "robot")
    outlet.offer([Entry(0, INFO), state(0)])
    assert outlet.close()
    assert not check_for_rrd_footer(str(tmp_path / "run.rrd"))


@pytest.mark.usefixtures("patient")
def test_a_recording_replaces_an_older_one(tmp_path: Path) -> None:
    for k in range(2):
        outlet = file_outlet(tmp_path / "run.rrd", "robot")
        outlet.offer([Entry(0, INFO), state(k)])
        assert outlet.close()
    assert values(tmp_path / "run.rrd") == [1.0]


def test_a_full_queue_drops_the_oldest_counts_them_and_keeps_the_description(tmp_path: Path) -> None:
    ready = Event()

    def open_slowly() -> rr.RecordingStream:
        assert ready.wait(PATIENCE_S)
        stream = rr.RecordingStream("test")
        stream.save(tmp_path / "run.rrd")
        return stream

    outlet = Outlet("slow", open_slowly, capacity=100, close_s=PATIENCE_S)
    outlet.offer([Entry(0, INFO)])
    outlet.offer(state(k) for k in range(250))
    assert outlet.dropped == 151
    ready.set()
    assert not outlet.close()
    assert values(tmp_path / "run.rrd") == list(range(150, 250))
    assert [(notice.code, notice.text) for notice in outlet.notices] == [("outlet_slow", "slow: too slow, 151 entries dropped")]


def test_a_file_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="rerun-save must be a file"):
        file_outlet(tmp_path, "robot")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_refused() -> None:
    with pytest.raises(ConfigError, match="No space left"):
        file_outlet(Path("/dev/full"), "robot")


def test_without_a_viewer_closing_does_not_wait(viewer: Viewer, host: Host) -> None:
    viewer.kill()
    outlet = viewer_outlet(viewer.url, "robot")
    outlet.offer([Entry(0, INFO)])
    since_ns = time.monotonic_ns()
    assert not outlet.close()
    in_time(host, "closing", (time.monotonic_ns() - since_ns) / MS, 1000.0, since_ns)


def test_viewer_that_does_not_listen_is_told_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    said = Queue[str]()
    monkeypatch.setattr(reach, "FIRST_REMINDER_S", 0.01)
    monkeypatch.setattr("rti_mpc_service.view.outlet.log.warning", said.put)
    url = f"rerun+http://127.0.0.1:{free_port()}/proxy"
    outlet = viewer_outlet(url, "robot")
    assert said.get(timeout=PATIENCE_S) == f"no viewer answers yet at {url}"
    outlet.close()


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # it is still being written
def test_a_viewer_killed_and_started_again_is_shown_the_robot_again(viewer: Viewer) -> None:
    outlet = viewer_outlet(viewer.url, "robot")
    outlet.offer([Entry(0, INFO), state(0)])
    await_(lambda: outlet.connected and viewer.shown > 0)
    viewer.kill()
    await_(lambda: outlet.failures == 1)
    assert outlet.answered  # so nothing more is said of a viewer that does not answer
    outlet.offer([state(1)])
    viewer.start()
    await_(lambda: outlet.connected)
    outlet.offer([state(2)])
    outlet.close()
    await_(lambda: viewer.shows() == [1.0, 2.0])


def test_a_hung_viewer_delays_neither_offers_nor_closing(viewer: Viewer, host: Host) -> None:
    outlet = viewer_outlet(viewer.url, "robot")
    outlet.offer([Entry(0, INFO)])
    await_(lambda: outlet.connected)
    os.kill(viewer.process.pid, signal.SIGSTOP)
    worst = (0, 0)
    deadline = time.monotonic() + 3.0
    while time.monotonic() < deadline:
        since_ns = time.monotonic_ns()
        outlet.offer([state(k) for k in range(200)])
        worst = max(worst, (time.monotonic_ns() - since_ns, since_ns))
        Event().wait(0.005)
    since_ns = time.monotonic_ns()
    outlet.close()
    in_time(host, "closing", (time.monotonic_ns() - since_ns) / MS, 1000.0, since_ns)
    in_time(host, "an offer", worst[0] / MS, 500.0, worst[1])
    os.kill(viewer.process.pid, signal.SIGCONT)


class Drawing:
    """Stands in for a scene and its stream: holds what it was sent, and cannot draw numbers that are NaN."""

    def __init__(self, *_: object) -> None:
        self.stream = self
        self.drawn: list[float] = []
        DRAWINGS.append(self)

    def send(self, entries: Iterable[Entry]) -> None:
        for entry in entries:
            if isinstance(entry.message, State):
                self.drawn.append(int(entry.message.x[0]))  # raises ValueError for NaN

    def finish(self) -> None: ...

    def flush(self, timeout_sec: float) -> None: ...

    def disconnect(self) -> None: ...


DRAWINGS: list[Drawing] = []


def test_an_entry_that_cannot_be_drawn_fails_its_stream_is_said_once_and_ends_no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rti_mpc_service.view.outlet.Scene", Drawing)
    outlet = Outlet("viewer", lambda: None)
    for failures in (1, 2):
        outlet.offer([Entry(1, State(1, 1, 1, np.array([np.nan])))])
        await_(lambda failures=failures: outlet.failures == failures)
    outlet.offer([state(7)])
    await_(lambda: DRAWINGS[-1].drawn == [7])
    assert [(notice.code, notice.text) for notice in outlet.notices] == [
        ("outlet_failed", "viewer: closed after a failure, entries not yet written are lost: ValueError: cannot convert float NaN to integer")
    ]
    outlet.close()


LOADING = """
import sys
import numpy as np
from rti_mpc.contract.message import State
from rti_mpc_service.view.outlet import load_arrow, new_stream
from rti_mpc_service.view.recording import Entry
from rti_mpc_service.view.scene import Scene
from rti_mpc_service.view.scene import Scene

load_arrow()
before = set(sys.modules)
stream = new_stream("robot")
stream.save(sys.argv[1])
scene = Scene(stream, ())
scene.send([Entry(k, State(1, k + 1, k, np.ones(2))) for k in range(3)])
scene.finish()
stream.flush(timeout_sec=30.0)
stream.disconnect()
print({name.partition(".")[0] for name in set(sys.modules) - before} & {"pandas"})
"""


def test_what_takes_seconds_to_import_is_imported_before_a_recording_begins(tmp_path: Path) -> None:
    """Otherwise a viewer that is stopped on a busy host spends the time for its end on it, and what it has received is lost."""
    done = subprocess.run([sys.executable, "-c", LOADING, tmp_path / "run.rrd"], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
