# SPDX-License-Identifier: Apache-2.0
"""Frames of a recording: rows are messages, columns are named by signals and carry units."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Command, State, Telemetry
from rti_mpc.errors import MessageError
from rti_mpc.recording import Recording, export, frame, table, units
from rti_mpc.recording.writer import RecordingWriter
from rti_mpc.wire.keys import Key, Keys
from tests.command import command
from tests.recording.samples import KEYS, REFERENCE, START_NS, write

COUNT = 60


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recording, list[tuple[Key, object]]]:
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    messages = write(path, COUNT)
    return Recording(path), messages


def of(messages: list[tuple[Key, object]], cls: type) -> list:
    return [message for _, message in messages if isinstance(message, cls)]


def test_rows_equal_messages_and_columns_are_signals(written: tuple[Recording, list[tuple[Key, object]]]) -> None:
    recording, messages = written
    states, frames = of(messages, State), frame(recording, "state")
    assert len(frames) == COUNT
    np.testing.assert_array_equal(frames[["x.x", "x.psi"]], [state.x for state in states])
    np.testing.assert_array_equal(frames["u.v"], [state.u[0] for state in states])
    np.testing.assert_array_equal(frames["stamp_ns"], [state.stamp_ns for state in states])
    samples, telemetry = of(messages, Telemetry), frame(recording, "telemetry", horizon=True)
    np.testing.assert_array_equal(telemetry[["x0.x", "x0.psi"]], [sample.x0 for sample in samples])
    np.testing.assert_array_equal(telemetry["u.v"], [sample.u[0, 0] for sample in samples])
    np.testing.assert_array_equal(np.stack(telemetry["x.psi[]"]), [sample.x[:, 1] for sample in samples])
    assert set(telemetry["mode"]) == {"TRACKING"}
    commands = frame(recording, "command")
    np.testing.assert_array_equal(commands["u.v"], [command.u[0, 0] for command in of(messages, Command)])
    assert not any(name.endswith("[]") for name in commands)


def test_times_are_seconds_of_the_robot_and_of_the_recorder(written: tuple[Recording, list[tuple[Key, object]]]) -> None:
    recording, messages = written
    frames = frame(recording, "state")
    np.testing.assert_allclose(frames["robot_s"], [1e-9 * state.stamp_ns for state in of(messages, State)], rtol=1e-15)
    arrivals = [recorded.local_ns for recorded in recording.messages(streams=("state",))]
    np.testing.assert_allclose(frames["local_s"], 1e-9 * (np.array(arrivals) - START_NS), atol=1e-9)  # ns


def test_units_are_those_of_the_description(written: tuple[Recording, list[tuple[Key, object]]]) -> None:
    recording, _ = written
    expected = {"robot_s": "s", "local_s": "s", "x.x": "m", "x.psi": "rad", "u.v": "m/s", "stamp_ns": "ns"}
    assert frame(recording, "state").attrs["units"].items() >= expected.items()
    assert units(table(recording, "state")).items() >= expected.items()
    assert units(table(recording, "telemetry"))["feedback_us"] == "us"


def test_each_row_of_a_reference_has_its_time(written: tuple[Recording, list[tuple[Key, object]]]) -> None:
    frames = frame(written[0], "reference")
    np.testing.assert_array_equal(frames["y.x"], REFERENCE.y[:, 0])
    np.testing.assert_allclose(frames["robot_s"], 0.1 * np.arange(len(REFERENCE.y)), atol=1e-9)  # ns


def test_events_and_descriptions_are_frames_too(written: tuple[Recording, list[tuple[Key, object]]]) -> None:
    events, infos = frame(written[0], "event"), frame(written[0], "info")
    assert events.loc[0, ["role", "severity", "code"]].to_list() == ["controller", "INFO", "mode"]
    assert '"model": "unicycle"' in infos.loc[0, "json"]


def test_polars_takes_a_table(written: tuple[Recording, list[tuple[Key, object]]]) -> None:
    import polars as pl

    taken = pl.from_arrow(table(written[0], "telemetry", horizon=True))
    assert isinstance(taken, pl.DataFrame)
    assert taken.height == COUNT
    assert taken["x.psi[]"].list.len().unique().to_list() == [21]


def test_streams_without_messages_are_empty_frames_with_their_columns(written: tuple[Recording, list[tuple[Key, object]]]) -> None:
    frames = frame(written[0], "actuation")
    assert frames.empty
    assert {"robot_s", "local_s", "seq", "mode"} <= set(frames)
    anchored = frame(written[0], "reference/anchored")
    assert anchored.empty
    assert {"robot_s", "local_s", "seq", "end"} <= set(anchored)


def test_what_is_not_there_is_refused_by_name(tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    folder.mkdir()
    write(folder / "1.mcap", 1)
    write(folder / "2.mcap", 1, keys=Keys(robot="other"))
    recording = Recording(folder)
    with pytest.raises(MessageError, match="robot must be one of other, wheels, got None"):
        frame(recording, "state")
    with pytest.raises(MessageError, match=r"stream must be one of state, .* got 'states'"):
        frame(recording, "states", KEYS.robot)
    assert len(frame(recording, "state", KEYS.robot)) == 1


def test_every_stream_is_exported_with_its_units(written: tuple[Recording, list[tuple[Key, object]]], tmp_path: Path) -> None:
    from pyarrow.parquet import read_table

    files = export(written[0], tmp_path)
    assert dict(files)[tmp_path / "wheels" / "state.parquet"] == COUNT
    assert {path.stem for path, _ in files} == {"state", "command", "telemetry", "reference", "event", "info"}
    read = read_table(tmp_path / "wheels" / "state.parquet")
    assert read.equals(table(written[0], "state"))
    assert units(read)["x.psi"] == "rad"


def test_export_prints_what_it_has_written_and_refuses_what_is_no_recording(
    written: tuple[Recording, list[tuple[Key, object]]], tmp_path: Path
) -> None:
    done = command("export", written[0].files[0], "--parquet", tmp_path / "out")
    assert done.returncode == 0
    assert f"{tmp_path}/out/wheels/telemetry.parquet: {COUNT} rows\n" in done.stdout
    done = command("export", tmp_path / "nothing.mcap", "--parquet", tmp_path / "out")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_description_that_is_not_utf_8_is_refused_by_its_key(tmp_path: Path) -> None:
    """No recorder writes one; any other program can."""
    writer = RecordingWriter(tmp_path / "run.mcap", START_NS, 0, "0.0")
    writer.add(KEYS.robot, KEYS.info("controller"), START_NS, '{"a": 1}'.encode("utf-16"))
    writer.finish({})
    with pytest.raises(MessageError, match=r"rti_mpc/wheels/info/controller must be JSON in UTF-8"):
        export(Recording(tmp_path / "run.mcap"), tmp_path)


@pytest.mark.slow
def test_ten_minutes_with_states_at_100_hz_are_loaded(tmp_path: Path) -> None:
    """Run with -s to see how long it takes."""
    write(tmp_path / "run.mcap", 6000, chunk=1500, states=10)
    began_s, cpu_s = time.perf_counter(), time.process_time()
    recording = Recording(tmp_path / "run.mcap")
    rows = {stream: len(frame(recording, stream)) for stream in ("state", "command", "telemetry")}
    print(f"\n{rows} loaded in {time.perf_counter() - began_s:.1f} s, {time.process_time() - cpu_s:.1f} s of CPU time")
    assert rows == {"state": 60_000, "command": 6000, "telemetry": 6000}
