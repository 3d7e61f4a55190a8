# SPDX-License-Identifier: Apache-2.0
"""Witness of the host: its record of delays, to which the load of the machine can only add."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rti_mpc_service.host import hold_up
from rti_mpc_service.host.hold_up import Host, Unwitnessed, Waits
from rti_mpc_service.host.realtime import available
from tests.processes.system import until

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="this kernel does not tell how long threads wait for a core")

ENDLESS_LOOP = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
until_s = time.process_time() + float(sys.argv[2])
print("ready", flush=True)
while time.process_time() < until_s:
    pass
"""
OWNER = """
import threading
from rti_mpc_service.host.hold_up import Host
with Host() as host:
    print(*[timer.process.pid for timer in host._timers], flush=True)
    threading.Event().wait(60)
"""
COMPUTED_S = 0.3  # by each of two on one core: each waits for the other for as long, but for the last slice of time


@pytest.fixture
def host() -> Iterator[Host]:
    with Host() as host:
        yield host


def greedy(core: int, computed_s: float = COMPUTED_S) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", ENDLESS_LOOP, str(core), str(computed_s)], stdout=subprocess.DEVNULL)


def test_processes_that_share_a_core_hold_each_other_up(host: Host) -> None:
    begin_ns = time.monotonic_ns()
    for process in [greedy(available()[0]) for _ in range(2)]:
        assert process.wait() == 0
    assert host.held_up_ms(begin_ns, time.monotonic_ns()) > 0.5 * 1e3 * COMPUTED_S


def test_processes_that_wait_at_once_hold_a_chain_up_for_no_longer_than_time_passes(host: Host) -> None:
    """Their waits together are five times as long: as an excuse, they would cover anything that happens meanwhile."""
    begin_ns = time.monotonic_ns()
    for process in [greedy(available()[0], 0.1) for _ in range(6)]:
        assert process.wait() == 0
    end_ns = time.monotonic_ns()
    assert 0.5 * 1e-6 * (end_ns - begin_ns) < host.held_up_ms(begin_ns, end_ns) <= 1e-6 * (end_ns - begin_ns)


def test_grandchildren_are_seen_too(host: Host) -> None:
    shell = f"'{sys.executable}' -c \"$1\" {available()[0]} {COMPUTED_S} & '{sys.executable}' -c \"$1\" {available()[0]} {COMPUTED_S} & wait"
    begin_ns = time.monotonic_ns()
    subprocess.run(["sh", "-c", shell, "sh", ENDLESS_LOOP], stdout=subprocess.DEVNULL, check=True)
    assert host.held_up_ms(begin_ns, time.monotonic_ns()) > 0.5 * 1e3 * COMPUTED_S


def test_wait_that_lasts_is_told_before_the_kernel_adds_it_up_and_only_once(tmp_path: Path) -> None:
    """A thread that ends right after a wait would else take it along."""

    def tell(ran: int, waited: int, state: str) -> None:
        (tmp_path / "schedstat").write_text(f"{ran} {waited} 7\n")
        (tmp_path / "stat").write_text(f"12 (a) b) {state} 1 12\n")

    tell(0, 0, "R")
    waits = Waits(str(tmp_path))
    assert [waits.since(10), waits.since(10)] == [10, 10]
    tell(1, 25, "S")
    assert waits.since(10) == 5
    assert waits.since(10) == 0, "it sleeps"
    tell(2, 26, "R")
    assert waits.since(10) == 1, "it ran"
    (tmp_path / "stat").unlink()
    with pytest.raises(OSError, match="stat"):
        waits.since(10)
    waits.close()


def test_witness_that_is_silent_or_has_ended_says_so(host: Host, monkeypatch: pytest.MonkeyPatch) -> None:
    timer = host._timers[0]
    timer.process.send_signal(signal.SIGSTOP)
    monkeypatch.setattr(hold_up, "ROW_TIMEOUT_S", 0.1)
    with pytest.raises(Unwitnessed, match=r"must tell every 10 ms, and was silent for 0\.1 s"):
        host.held_up_ms(0, time.monotonic_ns())
    timer.process.kill()
    timer.process.wait()
    with pytest.raises(Unwitnessed, match=r"the host's witness has ended with status -9"):
        host.held_up_ms(0, time.monotonic_ns())


def test_its_timers_end_with_it_and_with_whoever_started_it(host: Host) -> None:
    pids = [timer.process.pid for timer in host._timers]
    host.__exit__(None, None, None)
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)
    with subprocess.Popen([sys.executable, "-c", OWNER], cwd=ROOT, stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout is not None
        pids = [int(word) for word in owner.stdout.readline().split()]
        owner.send_signal(signal.SIGKILL)
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids), "its timers have ended")
