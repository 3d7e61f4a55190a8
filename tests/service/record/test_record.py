# SPDX-License-Identifier: Apache-2.0
"""Recorder without a bus: what it writes, counts, keeps and says."""

from __future__ import annotations

import base64
import json
import logging
import resource
import zlib
from collections.abc import Iterator
from pathlib import Path
from threading import Event as Flag
from threading import enumerate as enumerate_threads
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.message import Event, Notice, Severity
from rti_mpc.errors import ConfigError
from rti_mpc.recording import Recording
from rti_mpc.wire.bus import Bus, BusSettings, Declared
from rti_mpc.wire.cdr import Message, decode, encode
from rti_mpc.wire.keys import Key
from rti_mpc.wire.received import Received
from rti_mpc.wire.streams import MAX_UNKNOWN_ROLES, role_of
from rti_mpc_service.config.build import build_model
from rti_mpc_service.config.config import load
from rti_mpc_service.host.pressure import waited_us
from rti_mpc_service.origin import Origin, origin_files
from rti_mpc_service.record import record
from rti_mpc_service.record.hearing import MAX_BUNDLE_BYTES, MAX_PIECES, fetch_origin
from rti_mpc_service.record.inbox import ENTRY_BYTES, Arrived, Inbox
from rti_mpc_service.record.record import EVERYTHING, Recorder, parse_retention
from rti_mpc_service.record.segments import SEGMENTS, Retention, Segments
from tests.recording.samples import EVENT, INFO, KEYS, MS, REFERENCE, START_NS, UNIX_OFFSET_NS, state
from tests.wire.fake_session import FakeSession

STOPPED = Flag()
STOPPED.set()


class Bench:
    """A recorder whose messages are handed to it."""

    def __init__(self, path: Path, retention: Retention = EVERYTHING) -> None:
        self.session = FakeSession()
        self.segments = Segments(path, retention, START_NS, UNIX_OFFSET_NS)
        self.recorder = Recorder(Bus(self.session, KEYS), self.segments)
        self.recorder.follow(KEYS.robot)

    def put(self, key: Key, message: Message | bytes, local_ns: int = START_NS, encoded: str = "") -> None:
        payload = message if isinstance(message, bytes) else encode(message)
        kind = encoded or key.stream.encoding
        self.recorder._inbox.put(Arrived(KEYS.robot, key.stream, local_ns, Received(payload, kind, key)))

    def run(self) -> int:
        return self.recorder.run(STOPPED)


def test_recorder_writes_what_can_be_decoded_and_counts_the_rest(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "run.mcap")
    bench.put(KEYS.info("controller"), json.dumps(INFO).encode())
    for k in (1, 2, 5, 6):
        bench.put(KEYS.state, state(k), START_NS + k * MS)
    bench.put(KEYS.state, encode(state(7))[:-1])
    bench.put(KEYS.state, state(8), encoded="application/cdr;rti_mpc_msgs/msg/State@1")
    bench.put(KEYS.info("guard"), b"[]")
    assert bench.run() == 0
    assert bench.recorder.counts == {"recorded": 5, "missing": 2, "refused": 3}
    recording = Recording(tmp_path / "run.mcap")
    assert [recorded.local_ns for recorded in recording.messages(streams=("state",))] == [START_NS + k * MS for k in (1, 2, 5, 6)]
    assert recording.outcome == {"recorded": "5", "missing": "2", "refused": "3", "dropped": "0"}
    told = decode(Event, bench.session.put[KEYS.event("recorder")])
    assert (told.stamp_ns, told.text[:22]) == (state(6).stamp_ns, "2 messages are missing")


def test_waiting_for_cores_is_recorded_for_each_chunk_and_read_by_tools_of_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    totals_us = iter([1_000_000, 1_200_000, None, 1_500_000])
    monkeypatch.setattr(record, "waited_us", lambda: next(totals_us))
    bench = Bench(tmp_path / "run.mcap")
    for k in range(4):
        bench.recorder._write(START_NS + 500 * k * MS)
    bench.segments.writer.finish({})
    (told,) = Recording(tmp_path / "run.mcap").messages("wheels", ("host",))
    assert told.local_ns == START_NS + 500 * MS
    assert told.message == {"from_ns": START_NS, "waited_s": pytest.approx(0.2, rel=1e-9)}, "rounding"
    with (tmp_path / "run.mcap").open("rb") as file:
        ((_, channel, _, text),) = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
    assert channel.topic == "/rti_mpc/wheels/host"
    assert json.loads(text.data) == told.message
    assert not [key for key in bench.session.put if key.endswith("host")], "nothing is on the bus"


def test_kernel_that_does_not_count_waiting_is_no_failure(tmp_path: Path) -> None:
    assert waited_us(tmp_path / "cpu") is None
    (tmp_path / "cpu").write_text("some avg10=13.38 avg60=5.64 avg300=10.19 total=7288\nfull avg10=0.00 avg60=0.00 avg300=0.00 total=3\n")
    assert waited_us(tmp_path / "cpu") == 7288


def test_file_that_is_there_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_text("precious")
    with pytest.raises(ConfigError, match=r"--out must be a file .* not there yet, got .*run\.mcap: File exists"):
        Bench(tmp_path / "run.mcap")
    assert (tmp_path / "run.mcap").read_text() == "precious"


def test_waiting_messages_are_limited_and_the_oldest_dropped() -> None:
    inbox = Inbox(10 * (ENTRY_BYTES + 100))
    for k in range(25):
        inbox.put(Arrived("wheels", KEYS.state.stream, k, Received(bytes(100), "", KEYS.state)))
    assert [entry.local_ns for entry in inbox.take()] == list(range(15, 25))
    assert inbox.dropped == 15
    assert not inbox.take()


def test_full_disk_ends_the_recorder_with_a_line_and_what_was_written_is_whole(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench(tmp_path / "run.mcap")
    for k in range(1, 100):
        bench.put(KEYS.state, state(k), START_NS + k * MS)
    bench.recorder._write(START_NS + 100 * MS)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (bench.segments.size + 100, before[1]))
    try:
        for k in range(100, 1000):
            bench.put(KEYS.state, state(k), START_NS + k * MS)
        assert bench.run() == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    (line,) = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert "the recording ends here: File too large" in line
    assert [recorded.message.seq for recorded in Recording(tmp_path / "run.mcap").messages()] == list(range(1, 100))


def test_oldest_segments_are_deleted_and_each_stands_for_itself(tmp_path: Path) -> None:
    kept_s = 8.0
    bench = Bench(tmp_path / "runs", Retention(last_s=kept_s))
    bench.recorder._give("wheels/9", {"config.toml": "robot = 'wheels'\n"})
    bench.put(KEYS.info("controller"), json.dumps(INFO).encode())
    bench.put(KEYS.reference, REFERENCE)
    for k in range(1, 61):
        bench.put(KEYS.state, state(k), START_NS + k * 500 * MS)
        bench.recorder._write(START_NS + k * 500 * MS)
    bench.segments.writer.finish({})
    files = sorted((tmp_path / "runs").iterdir())
    assert SEGMENTS <= len(files) <= SEGMENTS + 2
    whole = Recording(tmp_path / "runs")
    seqs = [recorded.message.seq for recorded in whole.messages(streams=("state",))]
    assert seqs == list(range(seqs[0], 61))
    assert kept_s <= 0.5 * (60 - seqs[0]) <= kept_s * (1 + 2 / SEGMENTS)
    for file in files[:-1]:
        recording = Recording(file)
        assert recording.attachments == {"wheels/9/config.toml": b"robot = 'wheels'\n"}
        assert len(recording.infos()) == 1
        assert sum(1 for _ in recording.messages(streams=("reference",))) == 1


def test_size_of_all_segments_is_limited(tmp_path: Path) -> None:
    limit = 60_000
    bench = Bench(tmp_path / "runs", Retention(max_bytes=limit))
    for k in range(1, 100):
        for i in range(20):
            bench.put(KEYS.state, state(20 * k + i), START_NS + k * MS)
        bench.recorder._write(START_NS + k * MS)
        assert sum(file.stat().st_size for file in (tmp_path / "runs").iterdir()) <= limit
    bench.segments.writer.finish({})
    assert sum(file.stat().st_size for file in (tmp_path / "runs").iterdir()) > limit // 2


def test_made_up_roles_are_limited_for_each_robot_and_what_is_refused_is_counted_not_remembered(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "run.mcap")
    bench.put(KEYS.event("controller"), EVENT)
    for k in (*range(1000), 0):
        bench.put(KEYS.event(f"role_{k}"), EVENT)
        bench.put(KEYS.info(f"role_{k}"), json.dumps(INFO).encode())
    bench.put(KEYS.event("guard"), EVENT)
    assert bench.run() == 0
    assert bench.recorder.counts == {"recorded": 2 + 2 * (MAX_UNKNOWN_ROLES + 1), "missing": 0, "refused": 2 * (1000 - MAX_UNKNOWN_ROLES)}
    assert len(bench.recorder._keys) == 2 + 2 * MAX_UNKNOWN_ROLES
    roles = {recorded.role for recorded in Recording(tmp_path / "run.mcap").messages(streams=("event",))}
    assert roles == {"controller", "guard", *(f"role_{k}" for k in range(MAX_UNKNOWN_ROLES))}


class DescribedSession(FakeSession):
    """A session on which one controller describes itself, once."""

    def subscriber(self, key: Key[Any], capacity: int, *, history: bool, wakes: bool = False) -> Any:
        subscriber = super().subscriber(key, capacity, history=history, wakes=wakes)
        if key.stream is KEYS.info("controller").stream:
            described = Received(json.dumps(INFO | {"epoch": (5 << NUMBER_BITS) + 9}).encode(), "application/json", KEYS.info("controller"))
            waiting = iter([described])
            subscriber.recv = lambda: next(waiting, None)
        return subscriber


def test_controller_is_asked_for_its_files_as_soon_as_it_describes_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not only when what has arrived is next written: it may be dead by then, and nobody else has its configuration."""
    asked, done = list[int](), Flag()

    def fetch(_: Bus, owner: int, __: object) -> None:
        asked.append(owner)
        done.set()

    monkeypatch.setattr(record, "fetch_origin", fetch)
    recorder = Recorder(Bus(DescribedSession(), KEYS), Segments(tmp_path / "run.mcap", EVERYTHING, START_NS, UNIX_OFFSET_NS))
    recorder.follow(KEYS.robot)
    assert done.wait(10.0), "it is asked by the thread that hears it; nothing is written in this test"
    assert asked == [9]


def test_recorder_that_has_met_no_robot_says_what_is_wrong_in_its_log(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recorder = Recorder(Bus(FakeSession(), KEYS), Segments(tmp_path / "run.mcap", EVERYTHING, START_NS, UNIX_OFFSET_NS))
    recorder.say(Notice(Severity.ERROR, "unlinked", "all links to other processes are lost"))
    assert [(record.levelname, record.message) for record in caplog.records] == [("ERROR", "all links to other processes are lost")]
    assert recorder.run(STOPPED) == 0


def test_recorder_of_many_robots_tells_each_of_them_and_its_log_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Good news as such: that it is linked again was a warning, once for each robot."""
    session, robots = FakeSession(), ("a", "b", "c")
    recorder = Recorder(Bus(session, KEYS), Segments(tmp_path / "run.mcap", EVERYTHING, START_NS, UNIX_OFFSET_NS))
    for robot in robots:
        recorder.follow(robot)
    with caplog.at_level(logging.INFO):
        recorder.say(Notice(Severity.INFO, "linked", "linked to others again after 3.0 s"))
    assert [(record.levelname, record.message) for record in caplog.records] == [("INFO", "linked to others again after 3.0 s")]
    told = [decode(Event, payload).code for key, payload in session.put.items() if "/event/" in key]
    assert told == ["linked"] * len(robots)


class TokenSession(FakeSession):
    """A session that keeps the keys of its tokens."""

    def __init__(self) -> None:
        super().__init__()
        self.tokens: list[str] = []

    def token(self, key: Key[Any]) -> Declared:
        self.tokens.append(key)
        return super().token(key)


def test_each_recorder_shows_a_presence_of_its_own(tmp_path: Path) -> None:
    """A token of a key that another recorder shows already is told to nobody: the controller would take no snapshot for this one."""
    session = TokenSession()
    for name in ("a.mcap", "b.mcap"):
        Recorder(Bus(session, KEYS), Segments(tmp_path / name, EVERYTHING, START_NS, UNIX_OFFSET_NS)).follow(KEYS.robot)
    roles = [role_of(token) for token in session.tokens]
    assert roles.count("recorder") == 2
    assert len({role for role in roles if role.startswith("recorder.")}) == 2


@pytest.mark.parametrize("size", [None, "x", "9" * 30, 1.5, [], True, 0, -1, 10**9])
@pytest.mark.parametrize("piece", [None, "", 7, "AAAA", "Ä"])
def test_controller_whose_files_make_no_sense_is_told_in_one_line(piece: Any, size: Any, caplog: pytest.LogCaptureFixture) -> None:
    bus = Bus(FakeSession(), KEYS)
    bus.answers = lambda *_: iter([{"ok": True, "owner": 9, "size": size, "piece": piece}])  # type: ignore[method-assign]
    given: list[Any] = []
    before = set(enumerate_threads())
    fetch_origin(bus, 9, given.append)
    for thread in set(enumerate_threads()) - before:
        thread.join(10.0)
    assert not given
    (line,) = [record.getMessage() for record in caplog.records]
    assert "has not sent its configuration and model" in line


def test_controller_that_sends_its_files_in_pieces_without_end_is_asked_no_further(caplog: pytest.LogCaptureFixture) -> None:
    bus, asked = Bus(FakeSession(), KEYS), 0

    def answers(*_: object) -> Iterator[dict[str, Any]]:
        nonlocal asked
        asked += 1
        assert asked <= MAX_PIECES
        yield {"ok": True, "owner": 9, "size": MAX_BUNDLE_BYTES, "piece": "A"}

    bus.answers = answers  # type: ignore[method-assign]
    before = set(enumerate_threads())
    fetch_origin(bus, 9, pytest.fail)
    for thread in set(enumerate_threads()) - before:
        thread.join(10.0)
    assert asked == MAX_PIECES
    (line,) = [record.getMessage() for record in caplog.records]
    assert "has not sent its configuration and model" in line


@pytest.mark.parametrize("name", ["", "ant/", "../*", "*//bee", "@*", "ant#", "an ant", "ant!", "my *"])
def test_name_that_no_robot_can_have_is_refused_before_anything_is_joined(name: str, tmp_path: Path) -> None:
    """It was accepted, and nothing was recorded."""
    with pytest.raises(ConfigError, match="robot must be a word of letters, digits"):
        record.main(BusSettings(), KEYS, out=tmp_path / "run.mcap", robots=["ant*", name], stop=Flag())
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "expected"),
    [(("10min", None), (600.0, None)), ((None, "2GB"), (None, 2 * 10**9)), (("1.5h", "300 MB"), (5400.0, 3 * 10**8)), ((None, None), (None, None))],
)
def test_limits_are_read(words: tuple[str | None, str | None], expected: tuple[float | None, int | None]) -> None:
    retention = parse_retention(*words)
    assert (retention.last_s, retention.max_bytes) == expected


@pytest.mark.parametrize(
    ("last", "size", "said"),
    [
        ("10", None, "--last"),
        ("0s", None, "--last"),
        ("10s", None, "--last must be at least 30s, for a replay to begin at a snapshot"),
        (None, "2", "--max-size"),
        (None, "-1GB", "2GB"),
    ],
)
def test_limits_that_are_none_are_refused(last: str | None, size: str | None, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        parse_retention(last, size)


def test_origin_of_commands_is_handed_out_in_pieces_without_what_is_private(tmp_path: Path) -> None:
    (tmp_path / "wheels.py").write_text((Path(__file__).parents[3] / "rti_mpc/model/robots/pioneer_3dx.py").read_text() + f"\n# {'long ' * 20_000}\n")
    shipped = (Path(__file__).parents[3] / "deploy/pioneer_3dx.toml").read_text().replace('"pioneer_3dx"', '"wheels:pioneer_3dx"')
    (tmp_path / "secret.json5").write_text("{}")
    (tmp_path / "robot.toml").write_text(shipped + '\n[bus]\nconfig = "secret.json5"\n')
    config = load(tmp_path / "robot.toml")
    origin = Origin(origin_files(config, build_model(config)), lambda: (5 << 20) + 42)
    bundle, size = "", 1
    while len(bundle) < size:
        answer = origin.answer({"from": len(bundle)})
        assert (answer["ok"], answer["owner"]) == (True, 42)
        size = answer["size"]
        bundle += answer["piece"]
    files = json.loads(zlib.decompress(base64.b64decode(bundle)))
    assert set(files) == {"config.toml", "wheels.py", "equations.txt", "versions.json"}
    assert files["wheels.py"] == (tmp_path / "wheels.py").read_text()
    assert not any("secret" in text or str(tmp_path) in text for text in files.values())
    (tmp_path / "config.toml").write_text(files["config.toml"])
    assert load(tmp_path / "config.toml").config_hash == config.config_hash == json.loads(files["versions.json"])["config_hash"]
    for wrong in ({}, {"from": -1}, {"from": size}, {"from": True}):
        with pytest.raises(ValueError, match="from must be a number"):
            origin.answer(wrong)
