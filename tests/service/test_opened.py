# SPDX-License-Identifier: Apache-2.0
"""Files that somebody names and that are not there: each command says which, and what would be right."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc_service.case import QpCase
from rti_mpc_service.certs.authority import Authority, read_certificate
from rti_mpc_service.opened import opened
from rti_mpc_service.record.export import main as export
from rti_mpc_service.record.record import repaired
from rti_mpc_service.replay.rebuild import journals
from rti_mpc_service.tune.recorded_robot import read

READERS: dict[str, Callable[[Path], object]] = {
    "view": opened,
    "export": lambda path: export(path, path / "tables", horizon=False),
    "replay, why, solve-case": journals,
    "tune": lambda path: read(str(path), "pioneer", pioneer_3dx(), 0.1),
    "record --repair": lambda path: repaired(path, path),
    "solve-case of a case": QpCase.load,
    "certs with an authority": Authority.read,
    "certs with a certificate": read_certificate,
}


@pytest.mark.parametrize("command", READERS)
def test_file_that_is_not_there_is_named_once_with_what_it_must_be(command: str, tmp_path: Path) -> None:
    path = tmp_path / "nowhere"
    with pytest.raises(ConfigError) as refused:
        READERS[command](path)
    text = str(refused.value)
    assert text.count(str(path)) == 1
    assert " must be a " in text
    assert text.endswith(": No such file or directory"), "in words, without the number that the system has for it"


def test_what_is_no_recording_is_told_by_what_it_begins_with(tmp_path: Path) -> None:
    (path := tmp_path / "README.md").write_text("# no recording")
    with pytest.raises(ConfigError, match=r"README\.md must be an MCAP file, got one that begins with b'# no rec'"):
        opened(path)
