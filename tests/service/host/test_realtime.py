# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc_service.rig.children import Children
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.shipped import SHIPPED
from tests.processes.system import KEYS, until

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="schedulers are Linux's")

ATTEMPT = """
import json, os, threading
from pathlib import Path
from rti_mpc_service.host import realtime
core = realtime.available()[-1]
outcomes = realtime.attempt(10, (core,), lock_memory=True)
def look():
    locked = [line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmLck")]
    threads = {"priority": os.sched_getscheduler(0) == os.SCHED_FIFO, "cores": os.sched_getaffinity(0) == {core}}
    print(json.dumps([{o.what: o.granted for o in outcomes}, {**threads, "lock_memory": locked != ["0"]}]))
threading.Thread(target=look).start()
"""
REFUSED = """
import os, resource
from rti_mpc_service.host import realtime
for number in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
    resource.setrlimit(number, (0, 0))
if os.getuid() == 0:
    os.setuid(65534)
print(*realtime.attempt(10, (4096,), lock_memory=True), sep="\\n")
"""
RUNAWAY = """
from rti_mpc_service.host import realtime
realtime.MAX_UNBROKEN_COMPUTING_US = 50_000
outcome, = realtime.attempt(1)
print(outcome.granted, flush=True)
while outcome.granted:
    pass
"""


def run(script: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=30, check=False)


def test_what_is_said_to_be_granted_holds_for_threads_started_later() -> None:
    said, is_so = json.loads(run(ATTEMPT).stdout)
    assert said == is_so
    assert said["cores"], "anybody may choose among the cores he has"


def test_what_is_refused_is_told_with_the_reason_and_no_error() -> None:
    lines = run(REFUSED).stdout.splitlines()
    assert lines[0] == "priority refused: Operation not permitted, RLIMIT_RTPRIO is 0"
    assert lines[1].startswith("cores refused: Invalid argument, those to run on are ")
    assert lines[2].startswith("lock_memory refused: ")
    assert lines[2].endswith("RLIMIT_MEMLOCK is 0 bytes")


def test_a_loop_that_never_pauses_is_killed_before_it_hangs_the_machine() -> None:
    done = run(RUNAWAY)
    if done.stdout == "False\n":
        pytest.skip("SCHED_FIFO is not granted here: that a runaway is killed was NOT tested")
    assert done.returncode == -signal.SIGKILL


def test_controller_tells_what_it_was_granted_and_controls_all_the_same(tmp_path: Path) -> None:
    toml, endpoint = tmp_path / "robot.toml", free_endpoint()
    toml.write_text(SHIPPED.read_text() + "[realtime]\npriority = 10\ncores = [4096]\n")
    with Bus.join(BusSettings(listen=(endpoint,), connect=()), KEYS) as bus, Children(tmp_path) as children:
        infos = bus.subscriber(KEYS.info("controller"))
        pid = children.start("controller", "rti_mpc_service.cli", "run", toml, "-e", endpoint)
        info: dict[str, Any] = json.loads(until(infos.try_recv, "its description").payload)
        until(lambda: "real time: " in children.log("controller").read_text(), "one line about it")
        granted = not info["realtime"]["priority"].startswith("refused")
        assert info["realtime"]["cores"].startswith("refused: Invalid argument")
        threads = [path for path in Path(f"/proc/{pid}/task").iterdir() if (path / "comm").read_text().startswith(("rx-", "tx-"))]
        assert threads, "Zenoh has threads that receive and send"
        assert {os.sched_getscheduler(int(path.name)) for path in (*threads, Path(str(pid)))} == {os.SCHED_FIFO if granted else os.SCHED_OTHER}
        assert children.end("controller") == 0
