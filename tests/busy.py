# SPDX-License-Identifier: Apache-2.0
"""
Repeated runs, beside busy processes, of the tests that start processes or read clocks: `make test-busy`.

Every run is made, so that a failure that is rare shows how rare; the exit status is 1 if any failed. Further arguments
are pytest's: ``make test-busy ARGS="--runs 1 tests/wire"``.
"""

from __future__ import annotations

import argparse
import ast
import os
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

ROOT = Path(__file__).parents[1]
ENDLESS_LOOP = """
import os, sys
while os.getppid() == int(sys.argv[1]):  # at ordinary priority, for as long as we live
    sum(range(100_000))
"""
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


def main() -> int:
    """Run them; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--loops", type=int, default=4, help="processes that never rest")
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
        for run in range(1, options.runs + 1):
            start_s = time.monotonic()
            status = subprocess.run(command, cwd=ROOT, check=False).returncode
            took_s = time.monotonic() - start_s
            print(f"run {run} of {options.runs} beside {options.loops} busy loops: status {status} after {took_s:.0f} s", flush=True)
            failed += status != 0
    print(f"{options.runs - failed} of {options.runs} runs passed")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
