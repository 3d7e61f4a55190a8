# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:  # before NumPy is loaded: workers share the cores, and threads of their algebra would fight for them
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

from rti_mpc_service.host.hold_up import Host

SHORT_FORM = 3


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--guard", metavar="COMMAND", help="the guard that tests/guard_conformance judges, run as COMMAND CONFIG.toml -e ENDPOINT; ours")
    parser.addoption("--soak-s", type=float, default=20.0, metavar="SECONDS", help="how long the soak test drives the robot (default: 20)")
    parser.addoption("--attack", type=int, default=20_000, metavar="MESSAGES", help="how many hostile messages processes bear (default: 20000)")
    parser.addoption("--ends", type=int, default=5, metavar="COUNT", help="how often each kind of process is ended (default: 5)")
    parser.addoption("--kills", type=int, default=3, metavar="COUNT", help="how often the recorder is killed (default: 3)")
    parser.addoption("--structures", type=int, default=6, metavar="COUNT", help="how many structures random problems have (default: 6)")
    parser.addoption("--sets", type=int, default=20, metavar="COUNT", help="how many random problems there are of each structure (default: 20)")


def pytest_configure(config: pytest.Config) -> None:
    state = tempfile.mkdtemp(prefix="rti-mpc-state-")  # a test neither forgets a user's stop nor makes one
    config.add_cleanup(lambda: shutil.rmtree(state, ignore_errors=True))
    os.environ["STATE_DIRECTORY"] = state


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """In CI, run each slow test with every `SHORT_FORM`th of its sets of parameters; `make test-slow` runs them all."""
    if "CI" not in os.environ:
        return
    seen: Counter[str] = Counter()
    left: set[pytest.Item] = set()
    for item in items:
        if item.get_closest_marker("slow") is not None:
            name = item.nodeid.partition("[")[0]
            if seen[name] % SHORT_FORM:
                left.add(item)
            seen[name] += 1
    config.hook.pytest_deselected(items=list(left))
    items[:] = [item for item in items if item not in left]


def pytest_xdist_auto_num_workers() -> int:
    return 2 * (os.cpu_count() or 1)  # tests of processes mostly wait; what they hold to times, they hold on a busy host


@pytest.fixture(scope="module")  # its timers take a tenth of a core
def host() -> Iterator[Host]:
    """The witness of the host: a promise in milliseconds is held with `tests.in_time`."""
    with Host() as host:
        yield host
