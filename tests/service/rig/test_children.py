# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rti_mpc_service.rig.children import Children
from tests.processes.system import until

ROOT = Path(__file__).parents[3]
PARENT = """
import sys, threading
from pathlib import Path
from rti_mpc_service.rig.children import Children
with Children(Path(sys.argv[1])) as children:
    for name in ("one", "two"):
        children.start(name, sys.argv[2])
    threading.Event().wait(60)
"""
SLEEPER = """
import os, signal, sys, threading
print(os.getpid(), os.getpgid(0), os.getpriority(os.PRIO_PROCESS, 0), flush=True)
done = threading.Event()
signal.signal(signal.SIGINT, signal.SIG_IGN if "deaf" in sys.argv else lambda *_: sys.exit(7))
print("ready", flush=True)
while not done.wait(0.1):  # a signal that comes just before a wait begins is handled at its end
    pass
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "sleeper"


def ready(children: Children, name: str) -> list[int]:
    """Wait for a process; return its id, its group and its niceness."""
    until(lambda: "ready" in children.log(name).read_text(), name)
    return [int(word) for word in children.log(name).read_text().split()[:3]]


def gone(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


def test_child_has_a_group_of_its_own_is_polite_and_ends_as_ctrl_c_asks(tmp_path: Path, module: str) -> None:
    with Children(tmp_path) as children:
        children.start("polite", module, nice=5)
        pid, group, nice = ready(children, "polite")
        assert (group, nice) == (pid, os.getpriority(os.PRIO_PROCESS, 0) + 5)
        assert children.ended() is None
        assert children.end("polite") == 7
        assert gone(pid)


def test_child_is_suspended_and_killed_by_its_name_and_what_the_next_one_says_comes_after(tmp_path: Path, module: str) -> None:
    with Children(tmp_path) as children:
        children.start("victim", module)
        pid, *_ = ready(children, "victim")
        children.signal("victim", signal.SIGSTOP)
        until(lambda: Path(f"/proc/{pid}/stat").read_text().split()[2] == "T", "the child stands still")
        assert children.pid("victim") == pid
        children.kill("victim")
        assert gone(pid)
        assert (children.pid("victim"), children.ended()) == (None, None)
        children.start("victim", module)
        until(lambda: children.log("victim").read_text().count("ready") == 2, "another one")


def test_child_that_is_deaf_is_killed(tmp_path: Path, module: str) -> None:
    with Children(tmp_path) as children:
        children.start("deaf", module, "deaf")
        pid, *_ = ready(children, "deaf")
        assert children.end("deaf", patience_s=0.1) == -9
    assert gone(pid)


def test_child_that_ended_by_itself_is_named(tmp_path: Path) -> None:
    with Children(tmp_path) as children:
        children.start("missing", "no_such_module")
        until(lambda: children.ended() == "missing", "it ends")
        assert "no_such_module" in children.log("missing").read_text()


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's signal on a parent's death is Linux's")
def test_children_end_as_ctrl_c_asks_when_their_parent_is_killed(tmp_path: Path, module: str) -> None:
    with subprocess.Popen([sys.executable, "-c", PARENT, tmp_path, module], cwd=ROOT) as parent:
        until(lambda: (tmp_path / "two.log").exists(), "both are started")
        pids = [ready(Children(tmp_path), name)[0] for name in ("one", "two")]
        parent.kill()
    until(lambda: all(gone(pid) for pid in pids), "both are gone")


@pytest.mark.parametrize("fail", [lambda: None, lambda: 1 / 0])
def test_no_child_is_left_behind(tmp_path: Path, module: str, fail: Callable[[], object]) -> None:
    pids = []
    try:
        with Children(tmp_path) as children:
            for name in ("one", "two"):
                children.start(name, module)
                pids.append(ready(children, name)[0])
            fail()
    except ZeroDivisionError:
        pass
    assert all(gone(pid) for pid in pids)
