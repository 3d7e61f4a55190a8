# SPDX-License-Identifier: Apache-2.0
"""What is said of the checkout that runs."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from rti_mpc_service.host.machine import commit

AUTHOR = ("-c", "user.name=a", "-c", "user.email=a@example.org")


def git(folder: Path, *words: str) -> None:
    settings = {"PATH": os.environ["PATH"], "GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_NOSYSTEM": "1"}  # not those of whoever runs the tests
    subprocess.run(["git", "-C", str(folder), *AUTHOR, *words], env=settings, check=True, capture_output=True)


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_a_checkout_is_named_by_its_commit_and_by_whether_it_was_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    git(tmp_path, "init")
    (tmp_path / "code.py").write_text("1")
    git(tmp_path, "add", "code.py")
    git(tmp_path, "commit", "-m", "first")
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "another"))
    named = commit(tmp_path)
    assert named is not None
    assert len(named) == 12
    (tmp_path / "code.py").write_text("22")
    assert commit(tmp_path) == f"{named}-dirty"
    (tmp_path / "installed").mkdir()
    assert commit(tmp_path / "installed") is None, "somebody's project in which it is installed"


def test_without_git_or_a_checkout_there_is_no_commit_and_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert commit(tmp_path) is None
    (tmp_path / ".git").write_text("nothing")
    assert commit(tmp_path) is None
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit(tmp_path) is None
