# SPDX-License-Identifier: Apache-2.0
"""File of a latch: read as it was written, in full, or else as a stop."""

from __future__ import annotations

import fcntl
import os
import re
import resource
import subprocess
import sys
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path

import pytest

from rti_mpc.contract.latch import Latch
from rti_mpc.wire.keys import Keys
from rti_mpc_service import latch_file
from rti_mpc_service.latch_file import MAX_FILE_BYTES, LatchFile, state_folder

WHEN = "2026-11-28T09:30:00Z"
STOPPED = Latch(5, True, WHEN, "asked for by ada@lab")
RELEASED = Latch(6, False, WHEN, "asked for by ada@lab")


@pytest.fixture
def file(tmp_path: Path) -> LatchFile:
    return LatchFile(Keys(), tmp_path / "state")


def path(file: LatchFile) -> Path:
    assert file.path is not None
    return file.path


def test_latch_is_read_as_it_was_written_in_a_folder_that_is_made_for_it(file: LatchFile) -> None:
    assert file.read() == (Latch(), "")
    file.write(STOPPED)
    assert file.read() == (STOPPED, "")
    assert [entry.name for entry in path(file).parent.iterdir()] == ["rti_mpc%2Fpioneer.json"]


def test_each_prefix_and_robot_has_a_file_of_its_own(tmp_path: Path) -> None:
    keys = [Keys(), Keys("rti_mpc", "other"), Keys("a/b", "c"), Keys("a", "b-c"), Keys("a/b/c", "d"), Keys("a", "b.c"), Keys("a_b", "c")]
    paths = {path(LatchFile(key, tmp_path)) for key in keys}
    assert len(paths) == len(keys)
    assert {path.parent for path in paths} == {tmp_path}


def test_latch_of_another_process_that_is_greater_is_not_overwritten(file: LatchFile) -> None:
    file.write(RELEASED)
    file.write(STOPPED)
    assert file.read() == (RELEASED, "")


def count(folder: Path, first: int) -> None:
    latch_file.LOCK_TIMEOUT_S = 60.0  # two that never pause may starve each other for as long as a busy disk holds them up
    file = LatchFile(Keys(), folder)
    for counter in range(first, first + 10, 2):
        file.write(Latch(counter, counter % 4 == 0, WHEN, "many"))


def test_of_several_processes_that_write_at_once_the_greatest_latch_is_left(tmp_path: Path) -> None:
    context = get_context("spawn")
    writers = [context.Process(target=count, args=(tmp_path, first)) for first in (1, 2)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert LatchFile(Keys(), tmp_path).read()[0].counter == 10


def test_what_a_killed_process_has_left_beside_the_file_changes_nothing(file: LatchFile) -> None:
    file.write(STOPPED)
    path(file).with_name(f"{path(file).name}.tmp").write_text('{"version": 1, "counter": 9')
    assert file.read() == (STOPPED, "")
    file.write(RELEASED)
    assert file.read() == (RELEASED, "")
    assert len(list(path(file).parent.iterdir())) == 1


@pytest.mark.parametrize("moment", ["open", "fsync", "replace"])
def test_process_that_is_killed_while_it_writes_leaves_the_latch_before_or_after(file: LatchFile, moment: str) -> None:
    file.write(STOPPED)
    script = f"""
import os, pathlib, signal
from pathlib import Path
from rti_mpc.contract.latch import Latch
from rti_mpc.wire.keys import Keys
from rti_mpc_service.latch_file import LatchFile

def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)

if {moment!r} == "fsync":
    os.fsync = die
else:
    setattr(Path, {moment!r}, die)
LatchFile(Keys(), Path({str(path(file).parent)!r})).write(Latch(6, False, {WHEN!r}, "asked for by ada@lab"))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=Path(__file__).parents[2], timeout=30)
    assert done.returncode == -9
    assert file.read() == (STOPPED, "")
    file.write(RELEASED)
    assert file.read() == (RELEASED, "")


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "empty": (lambda path: path.write_bytes(b""), "message must be a JSON object"),
    "cut off": (lambda path: path.write_text('{"version": 1, "counter": 5, "sto'), "message must be a JSON object"),
    "binary": (lambda path: path.write_bytes(b"\xff\x00\xfe"), "message must be a JSON object"),
    "a list": (lambda path: path.write_text("[]"), "message must be a JSON object"),
    "nested": (lambda path: path.write_text("[" * 4000), "message must be a JSON object"),
    "long": (
        lambda path: path.write_text("{" + " " * MAX_FILE_BYTES + "}"),
        f"message must have at most {MAX_FILE_BYTES} bytes, got {MAX_FILE_BYTES + 1}",
    ),
    "of the future": (lambda path: path.write_text('{"version": 2, "stops": []}'), "must be of version 1, got 2"),
    "without a counter": (lambda path: path.write_text('{"version": 1}'), "latch.counter must be a whole number from 0 to 2^62, got None"),
    "a folder": (lambda path: path.mkdir(), "Is a directory"),
    "a pipe": (lambda path: os.mkfifo(path), "message must be a JSON object"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_file_that_cannot_be_understood_is_named_in_one_line_and_stops(tmp_path: Path, kind: str) -> None:
    file = LatchFile(Keys(), tmp_path)
    make, words = BROKEN[kind]
    make(path(file))
    latch, complaint = file.read()
    assert complaint == f"{file.path}: {words}"
    assert latch.stopped
    assert latch < STOPPED, "whoever knows better tells"
    if kind != "a folder":
        file.write(RELEASED)
        assert file.read() == (RELEASED, "")


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_file_that_must_not_be_read_stops(file: LatchFile) -> None:
    file.write(RELEASED)
    path(file).chmod(0)
    assert file.read() == (Latch(stopped=True, reason="its file cannot be understood"), f"{file.path}: Permission denied")


def test_full_disk_is_an_error_and_leaves_the_latch_before(file: LatchFile) -> None:
    file.write(STOPPED)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            file.write(RELEASED)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert file.read() == (STOPPED, "")


def test_folder_that_cannot_be_made_is_an_error_that_is_known_beforehand(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    file = LatchFile(Keys(), tmp_path / "file" / "state")
    assert file.read() == (Latch(), "")
    assert file.obstacle() == f"{tmp_path / 'file'} must be a folder"
    with pytest.raises(OSError, match="Not a directory"):
        file.write(STOPPED)
    assert LatchFile(Keys(), tmp_path / "state").obstacle() == ""


def test_writer_that_hangs_with_the_lock_is_waited_for_so_long_only(file: LatchFile, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write(STOPPED)
    monkeypatch.setattr(latch_file, "LOCK_TIMEOUT_S", 0.05)
    other = os.open(path(file).parent, os.O_RDONLY)
    try:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(TimeoutError, match="another process has held the lock"):
            file.write(RELEASED)
    finally:
        os.close(other)
    file.write(RELEASED)


@pytest.mark.parametrize(
    ("environment", "folder"),
    [
        ({"STATE_DIRECTORY": "/var/lib/robot:/var/lib/second", "XDG_STATE_HOME": "/x", "HOME": "/h"}, Path("/var/lib/robot")),
        ({"XDG_STATE_HOME": "/x", "HOME": "/h"}, Path("/x/rti_mpc")),
        ({"HOME": "/h"}, Path("/h/.local/state/rti_mpc")),
    ],
)
def test_folder_is_the_service_s_or_the_user_s(monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], folder: Path) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert state_folder() == folder


def test_without_a_home_nothing_is_stored_and_the_error_says_what_would_help(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", lambda uid: {}[uid])  # no entry for this user
    file = LatchFile(Keys())
    assert (file.path, file.read()) == (None, (Latch(), ""))
    assert re.search("neither --state, .* says where", file.obstacle())
    with pytest.raises(OSError, match="neither --state"):
        file.write(STOPPED)
