# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gc
import importlib
import os
import shutil
import signal
import tempfile
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:  # before NumPy is loaded: workers share the cores, and threads of their algebra would fight for them
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

from rti_mpc_service.host.hold_up import Host

SHORT_FORM = 3
TESTS = Path(__file__).parent
WAITING = {"guard_conformance", "processes", "service", "sim", "test_docs.py", "wire"}  # files and folders of tests that wait for processes
UNOPTIMIZED = f"{TESTS / 'compiler'}{os.pathsep}"  # first in the path, for processes that tests start, too


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--guard", metavar="COMMAND", help="the guard that tests/guard_conformance judges, run as COMMAND CONFIG.toml -e ENDPOINT; ours")
    parser.addoption("--soak-s", type=float, default=20.0, metavar="SECONDS", help="how long the soak test drives the robot (default: 20)")
    parser.addoption("--attack", type=int, default=20_000, metavar="MESSAGES", help="how many hostile messages processes bear (default: 20000)")
    parser.addoption("--ends", type=int, default=5, metavar="COUNT", help="how often each kind of process is ended (default: 5)")
    parser.addoption("--kills", type=int, default=3, metavar="COUNT", help="how often the recorder is killed (default: 3)")
    parser.addoption("--structures", type=int, default=6, metavar="COUNT", help="how many structures random problems have (default: 6)")
    parser.addoption("--sets", type=int, default=8, metavar="COUNT", help="how many random problems there are of each structure (default: 8)")


def pytest_configure(config: pytest.Config) -> None:
    state = tempfile.mkdtemp(prefix="rti-mpc-state-")  # a test neither forgets a user's stop nor makes one
    config.add_cleanup(lambda: shutil.rmtree(state, ignore_errors=True))
    os.environ["STATE_DIRECTORY"] = state
    for number in (signal.SIGINT, signal.SIGHUP):  # ignored in the background and under nohup, and then by the processes that tests start, too
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    compiler = shutil.which("cc")
    if compiler is not None and "not slow" in config.getoption("markexpr") and not os.environ.get("PATH", os.defpath).startswith(UNOPTIMIZED):
        # Most of what tests compile serves once. Slow tests and benchmarks, whose figures are the product's, compile as it does.
        os.environ |= {"OPTIMIZING_CC": compiler, "PATH": UNOPTIMIZED + os.environ.get("PATH", os.defpath)}


def load_in_turn(worker: int, workers: int) -> None:
    """Load all tests in a worker, as it will anyway, but each from another place on: in a fresh clone it finds the rest compiled by the others."""
    names = [".".join(path.relative_to(TESTS.parent).with_suffix("").parts) for path in sorted(TESTS.rglob("test_*.py"))]
    first = worker * len(names) // workers
    for name in names[first:] + names[:first]:
        with suppress(Exception, pytest.skip.Exception):  # told when they are collected
            importlib.import_module(name)


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Let the collector of cycles leave modules and tests alone, of which every worker has all: a third of the time it takes to find them."""
    gc.disable()
    if "PYTEST_XDIST_WORKER" in os.environ and session.config.args_source is pytest.Config.ArgsSource.TESTPATHS:
        load_in_turn(int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw")), int(os.environ["PYTEST_XDIST_WORKER_COUNT"]))
    found = yield
    gc.freeze()
    gc.enable()
    return found


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """
    Begin with tests that wait, so that those that compute keep the cores busy to the end.

    In CI, run each slow test with every `SHORT_FORM`th of its sets of parameters; `make test-slow` runs them all.
    """
    if "PYTEST_XDIST_WORKER" in os.environ:
        items.sort(key=lambda item: WAITING.isdisjoint(item.path.relative_to(TESTS).parts))
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


@pytest.fixture
def optimizing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile as users do, in a test whose subject is the compiled code."""
    monkeypatch.setenv("PATH", os.environ["PATH"].removeprefix(UNOPTIMIZED))


@pytest.fixture(scope="module")
def interpreted() -> Iterator[None]:
    """Hide the compiler from tests that drive less than it takes: a plan is the same to rounding, see `tests.rti.test_rti`."""
    folders = os.environ["PATH"].split(os.pathsep)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", os.pathsep.join(folder for folder in folders if shutil.which("cc", path=folder) is None))
        yield


@pytest.fixture(scope="module")  # its timers take a tenth of a core
def host() -> Iterator[Host]:
    """The witness of the host: a promise in milliseconds is held with `tests.in_time`."""
    with Host() as host:
        yield host
