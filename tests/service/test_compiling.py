# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
from pathlib import Path
from queue import Queue

import casadi as ca
import pytest

from rti_mpc import codegen
from rti_mpc_service import compiling
from rti_mpc_service.compiling import compilation_shown, work_shown


def test_first_compilation_is_told_with_its_duration_and_the_next_start_is_silent(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    said: list[str] = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(codegen, "COMPILER_RATE", 100)  # characters per s: a function of a line is then a long one
    monkeypatch.setattr(codegen, "while_compiling", lambda duration_s: compilation_shown(duration_s, said.append))
    x = ca.SX.sym("x")
    for _ in range(2):
        codegen.compiled(ca.Function("twice", [x], [2 * x]))
        assert len(said) == 1
    assert said[0].startswith("compiling the model, once, about ")


def test_short_compilation_is_not_worth_a_line() -> None:
    said: list[str] = []
    with compilation_shown(0.5, said.append):
        pass
    assert not said


def test_terminal_shows_the_time_elapsed_and_no_line_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    said: list[str] = []
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    with compilation_shown(20.0, said.append):
        pass
    assert not said
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "compiling the model, once, about 20 s" in captured.err
    assert "0:00:0" in captured.err


def test_work_that_takes_its_time_is_said_while_it_is_done_and_other_work_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    said = Queue[str]()
    with work_shown("stopping it", said.put):
        assert said.get(timeout=60.0) == "stopping it"
    monkeypatch.setattr(compiling, "MIN_DURATION_S", 3600.0)
    with work_shown("quick", said.put):
        pass
    assert said.empty()
