# SPDX-License-Identifier: Apache-2.0
"""
Repeated runs, beside busy processes, of the tests that start processes or read clocks: `make test-busy`.

Every run is made, so that a failure that is rare shows how rare; the exit status is 1 if any failed. Further arguments
are pytest's: ``make test-busy ARGS="--runs 1 tests/wire"``. With ``--halts 3`` all processes of the tests stop for 30 to
800 ms about every three seconds, as where a host stops everything.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from pathlib import Path

ROOT = Path(__file__).parents[1]
ENDLESS_LOOP = """
import os, sys
while os.getppid() == int(sys.argv[1]):  # at ordinary priority, for as long as we live
    sum(range(100_000))
"""
SHORTEST_HALT_S, LONGEST_HALT_S = 0.03, 0.8
# Imports of a test that starts processes, talks over a bus or reads a clock.
TIMED_IMPORTS = (
    *("subprocess", "threading", "time", "socket", "zenoh"),
    *("rti_mpc_service.rig.children", "rti_mpc_service.host.hold_up", "rti_mpc.wire.bus", "tests.processes", "tests.guard_conformance"),
)


def timed(path: Path) -> bool:
    """Whether the tests of a file start processes or read clocks."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module))
    return any(name == timed or name.startswith(f"{timed}.") for name in names for timed in TIMED_IMPORTS)


def descendants(pid: int) -> list[int]:
    """Return a process and all that it has started, and so on."""
    pids = [pid]
    for each in pids:
        with suppress(OSError):  # it ends meanwhile
            for thread in Path(f"/proc/{each}/task").iterdir():
                pids += map(int, (thread / "children").read_text().split())
    return pids


def running(pid: int) -> bool:
    """Whether a process has neither ended nor been stopped, as some tests do."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0] not in "TtZX"
    return False


def halt(pid: int, seconds: float) -> None:
    """Stop a process and all its descendants for a while, and let those go on that went."""
    stopped = [each for each in descendants(pid) if running(each)]
    for number in (signal.SIGSTOP, signal.SIGCONT):
        for each in stopped:
            with suppress(ProcessLookupError):
                os.kill(each, number)
        time.sleep(seconds * (number == signal.SIGSTOP))


def run(command: list[str], halts_s: float, rng: random.Random) -> int:
    """Run a command to its end, halted now and then; return its exit status."""
    with subprocess.Popen(command, cwd=ROOT) as process:
        while process.poll() is None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(rng.expovariate(1 / halts_s) if halts_s else None)
            if process.poll() is None:
                halt(process.pid, SHORTEST_HALT_S * (LONGEST_HALT_S / SHORTEST_HALT_S) ** rng.random())
    return process.returncode


def main() -> int:
    """Run them; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--loops", type=int, default=4, help="processes that never rest")
    parser.add_argument("--halts", type=float, default=0.0, metavar="SECONDS", help="mean time between two halts of all processes; none")
    options, rest = parser.parse_known_args()
    named = any(Path(word.partition("::")[0]).exists() for word in rest)
    files = [] if named else sorted(str(path) for path in ROOT.glob("tests/**/test_*.py") if timed(path))
    command = [sys.executable, "-m", "pytest", "-n", "auto", "--dist", "loadfile", "--durations", "5", *rest, *files]
    with ExitStack() as stack:
        for _ in range(options.loops):
            greedy = subprocess.Popen([sys.executable, "-c", ENDLESS_LOOP, str(os.getpid())], stdin=subprocess.DEVNULL)
            stack.callback(greedy.wait)
            stack.callback(greedy.kill)
        failed = 0
        for number in range(1, options.runs + 1):
            start_s = time.monotonic()
            status = run(command, options.halts, random.Random(number))
            took_s = time.monotonic() - start_s
            print(f"run {number} of {options.runs} beside {options.loops} busy loops: status {status} after {took_s:.0f} s", flush=True)
            failed += status != 0
    print(f"{options.runs - failed} of {options.runs} runs passed")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
