# SPDX-License-Identifier: Apache-2.0
"""Replacement of a file: whole before it is in place, whoever else writes it, and nothing else is left or changed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rti_mpc.cache import is_intact, write_sealed
from rti_mpc.whole_file import replaced


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "file"
    path.write_bytes(b"before")
    return path


def test_file_is_on_the_disk_before_it_takes_its_place(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Or else a power cut could leave an empty one."""
    synced: list[tuple[int, int]] = []
    sync, replace = os.fsync, Path.replace

    def note(descriptor: int) -> None:
        about = os.fstat(descriptor)
        synced.append((about.st_ino, about.st_size))
        sync(descriptor)

    def check(self: Path, to: Path) -> Path:
        about = self.stat()
        assert synced == [(about.st_ino, len(b"after"))]
        assert path.read_bytes() == b"before"
        return replace(self, to)

    monkeypatch.setattr(os, "fsync", note)
    monkeypatch.setattr(Path, "replace", check)
    with replaced(path) as file:
        file.write(b"after")
    assert path.read_bytes() == b"after"
    assert synced[1:] == [(path.parent.stat().st_ino, path.parent.stat().st_size)], "and then its name"


def test_error_leaves_what_was_there_and_nothing_else(path: Path) -> None:
    with pytest.raises(ValueError, match="none"), replaced(path) as file:
        file.write(b"half")
        raise ValueError("none")
    assert [(each.name, each.read_bytes()) for each in path.parent.iterdir()] == [("file", b"before")]


def test_two_threads_that_compile_one_function_do_not_write_into_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second begins while the first one syncs its file, as two robots of one process do that start at the same time."""
    path, sync = tmp_path / "shared.so", os.fsync

    def meanwhile(descriptor: int) -> None:
        monkeypatch.setattr(os, "fsync", sync)
        write_sealed(path, "key", b"code")
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", meanwhile)
    write_sealed(path, "key", b"code")
    assert is_intact(path, "key")
    assert [each.name for each in tmp_path.iterdir()] == ["shared.so"]
