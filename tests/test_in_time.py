# SPDX-License-Identifier: Apache-2.0
"""Excuses for what is late: what waits for a core excuses itself, and nobody else."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from rti_mpc_service.host.realtime import available
from tests.in_time import ends_in_time

pytestmark = pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="this kernel does not tell how long threads wait for a core")

SLEEPER = "import sys, time; print(flush=True); sys.stdin.read(); time.sleep(float(sys.argv[1]))"
WORKER = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
print(flush=True)
sys.stdin.read()
until_s = time.process_time() + float(sys.argv[2])
while time.process_time() < until_s:
    pass
"""
HALT = """
import os, signal, sys, time
for number in (signal.SIGSTOP, signal.SIGCONT):
    for pid in map(int, sys.argv[1:]):
        os.kill(pid, number)
    time.sleep(1.0)
"""
OTHERS = 6  # on one core, which wait for each other in vain


@contextmanager
def asked_to_end(code: str, *arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    """A process that has started, and has just been asked to end."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == b"\n"
        process.stdin.close()
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture
def others() -> Iterator[None]:
    """Processes that this one has started and that all compute on the first core."""
    with ExitStack() as stack:
        for _ in range(OTHERS):
            stack.enter_context(asked_to_end(WORKER, available()[0], 60.0))
        yield


@pytest.mark.usefixtures("others")
def test_end_that_is_late_by_itself_is_late_however_many_others_wait_for_a_core() -> None:
    said = r"the end took \d+ ms of 200, of which its threads had no core for \d+ ms"
    with asked_to_end(SLEEPER, 1.0) as process, pytest.raises(AssertionError, match=said):
        ends_in_time(process, "the end", 200.0)


@pytest.mark.usefixtures("others")
def test_end_that_asks_another_is_late_by_what_that_one_waits_for_its_core() -> None:
    with asked_to_end(WORKER, available()[0], 60.0) as other, asked_to_end(SLEEPER, 0.5) as process:
        before = len(os.listdir("/proc/self/fd"))
        assert ends_in_time(process, "the end", 200.0, asked=[other]) == 0
        assert len(os.listdir("/proc/self/fd")) == before, "nothing is left open of a process that lives on"


@pytest.mark.usefixtures("others")
def test_end_that_computes_beside_others_is_late_by_what_it_waits_for_its_core() -> None:
    with asked_to_end(WORKER, available()[0], 0.2) as process:
        assert ends_in_time(process, "the end", 600.0) == 0


def test_end_is_late_by_what_the_host_halts_everybody_for() -> None:
    with asked_to_end(SLEEPER, 0.3) as process, subprocess.Popen([sys.executable, "-c", HALT, str(os.getpid()), str(process.pid)]) as halt:
        try:
            assert ends_in_time(process, "the end", 400.0) == 0
        finally:
            halt.wait()
