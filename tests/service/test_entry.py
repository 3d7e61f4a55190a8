# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import State
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.shipped import SHIPPED
from tests.processes.system import CONFIG, PATIENCE_S
from tests.slow import slow_but

ROOT = Path(__file__).parents[2]
KEYS = Keys(robot="test")
LISTENER = """
import sys, threading, time
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.entry import enter

class Slow:
    def __del__(self):
        time.sleep(0.2)  # with all the modules around it, as an interpreter takes that has many to clear

slow = Slow()

def main():
    bus = Bus.join(BusSettings(connect=(sys.argv[1],)), Keys(robot="test"))
    heard = threading.Event()
    def follow(subscriber):
        for _ in iter(subscriber.recv, None):
            heard.set()
    for _ in range(4):
        threading.Thread(target=follow, args=(bus.subscriber(bus.keys.state),), daemon=True).start()
    assert heard.wait(50.0)

enter(main)
"""


def run(code: str, *arguments: str, **options: object) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run([sys.executable, "-c", code, *arguments], cwd=ROOT, stderr=subprocess.PIPE, timeout=60, **options)  # type: ignore[call-overload,no-any-return]


@contextmanager
def flooded(endpoint: str) -> Iterator[None]:
    """States without a pause."""
    with Bus.join(BusSettings(listen=(endpoint,), connect=()), KEYS) as bus:
        states, over = bus.publisher(KEYS.state), threading.Event()

        def publish() -> None:
            seq = 0
            while not over.is_set():
                states.put(State(1, seq := seq + 1, seq, np.zeros(5)))

        flood = threading.Thread(target=publish)
        flood.start()
        try:
            yield
        finally:
            over.set()
            flood.join()


def test_process_ends_well_while_its_threads_are_inside_zenoh() -> None:
    """As when the bus could not be closed in time: messages arrive while the interpreter is finalizing."""
    endpoint = free_endpoint()
    with flooded(endpoint):
        done = run(LISTENER, endpoint)
    assert (done.returncode, done.stderr) == (0, b"")


def test_ctrl_c_while_modules_load_ends_the_process_without_a_traceback() -> None:
    """At once, or, where the host was busy and they have loaded meanwhile, with the status of an interrupt."""
    command = [sys.executable, "-X", "importtime", "-m", "rti_mpc_service", "robots", "--help"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as child:
        assert child.stderr is not None
        said = []
        for line in child.stderr:  # as they are loaded
            said.append(line)
            if "rti_mpc.errors" in line:
                child.send_signal(signal.SIGINT)
    assert child.returncode in (-signal.SIGINT, 0)
    assert all(line.startswith("import time:") for line in said), said


@pytest.mark.parametrize(
    ("step", "status", "said"),
    [
        ("pass", 0, ""),
        ("sys.exit(3)", 3, ""),
        ("raise ConfigError('a must be 1, got 2')", 2, "rti-mpc: a must be 1, got 2\n"),
        ("raise Stopped('while waiting')", 0, ""),
        ("raise KeyboardInterrupt", 130, ""),
        ("raise ModuleNotFoundError(name='rerun')", 2, "rti-mpc: rerun must be installed for this command: pip install 'rti-mpc[view]'\n"),
        ("os.write(1, b'x'); threading.Thread(target=time.sleep, args=(60,)).start()", 0, ""),
        ("atexit.register(time.sleep, 60)", 0, ""),
        ("atexit.register(print, 'last', file=sys.stderr)", 0, "last\n"),
        ("sys.stderr.write('unended')", 0, "unended"),
    ],
)
def test_process_ends_with_the_status_of_what_it_did_and_says_it_in_one_line(step: str, status: int, said: str) -> None:
    code = "import atexit, os, sys, threading, time\nfrom rti_mpc.errors import *\nfrom rti_mpc_service.entry import enter\ndef main():\n  "
    done = run(f"{code}{step}\nenter(main)", stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr.decode()) == (status, said)


def test_fault_of_our_own_keeps_its_traceback() -> None:
    done = run("from rti_mpc_service.entry import enter\nenter(lambda: 1 / 0)")
    assert done.returncode == 1
    assert b"Traceback" in done.stderr
    assert b"ZeroDivisionError" in done.stderr


def shell(command: str, *arguments: object, pass_fds: tuple[int, ...] = (), **environment: str) -> subprocess.CompletedProcess[str]:
    """A command of ours, as `$run`, in a shell, with the environment of a terminal that knows ASCII only."""
    line = f"{sys.executable} -c 'from rti_mpc_service.cli import main; main()'"
    ascii_only = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0", "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        ["bash", "-c", command.replace("$run", line), "bash", *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, **ascii_only, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        pass_fds=pass_fds,
    )


# How a command that takes long begins to say what it waits for, where there is no terminal.
WAITS = "compiling the model, once, ", "finding how the robot comes to rest", "stopping it from wherever", "solving samples along a wave"


def faults(stderr: str) -> str:
    """Return what was said of faults: not what is waited for."""
    return "".join(line for line in stderr.splitlines(keepends=True) if not line.startswith(WAITS))


FULL = f"rti-mpc: standard output must take what is printed, got: {os.strerror(errno.ENOSPC)}\n"


@pytest.mark.parametrize(
    ("command", "status", "stdout", "stderr"),
    [
        ("$run robots >&-", 0, "", ""),
        pytest.param("$run check >&-", 0, "", "", marks=pytest.mark.slow),
        ("$run --help <&- >&- 2>&-", 0, "", ""),
        ("$run robots > /dev/full", 1, "", FULL),
        pytest.param("$run check > /dev/full", 1, "", FULL, marks=pytest.mark.slow),
        pytest.param("$run --help > /dev/full", 1, "", FULL, marks=pytest.mark.slow),
        ("$run --help > /dev/full 2>&1", 1, "", ""),
        ("$run check nowhere.toml 2> /dev/full", 2, "", ""),
        ("$run check nowhere.toml 2>&-", 2, "", ""),
        pytest.param("$run stop --timeout 0.1 -e tcp/127.0.0.1:1 >&- 2>&-", 1, "", "", marks=pytest.mark.slow),
    ],
)
def test_output_that_is_closed_full_or_not_read_to_its_end_is_one_line_at_most(command: str, status: int, stdout: str, stderr: str) -> None:
    done = shell(command)
    assert (done.returncode, done.stdout, faults(done.stderr)) == (status, stdout, stderr)


@pytest.mark.parametrize("command", slow_but(["robots", "check"], "robots"))
def test_output_whose_reader_has_gone_ends_it_as_it_does_other_commands(command: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = shell(f"$run {command} >&{writer}; exit $?", pass_fds=(writer,))
    os.close(writer)
    assert (done.returncode, done.stdout, faults(done.stderr)) == (128 + signal.SIGPIPE, "", "")


@pytest.mark.parametrize("output", ["> /dev/full", ">&-", "| true"])
def test_log_that_nobody_takes_ends_nobody(output: str) -> None:
    endpoint = free_endpoint()
    line = f"{sys.executable} -c 'from rti_mpc_service.cli import main; main()' router {SHIPPED} -l {endpoint} {output}; exit ${{PIPESTATUS[0]}}"
    with (
        subprocess.Popen(["bash", "-c", line], cwd=ROOT, stderr=subprocess.PIPE, process_group=0) as process,
        Bus.join(BusSettings(mode="client", connect=(endpoint,)), CONFIG.keys()) as bus,
    ):
        try:
            assert bus.is_alive("router", PATIENCE_S)
            subprocess.run(["pkill", "-TERM", "-P", str(process.pid)], check=True)
            assert process.wait(PATIENCE_S) == 0
            assert process.stderr is not None
            assert process.stderr.read() == b""
        finally:
            os.killpg(process.pid, signal.SIGKILL) if process.poll() is None else None


@pytest.mark.slow
def test_path_with_an_umlaut_is_printed_as_it_is_where_only_ascii_is_known(tmp_path: Path) -> None:
    folder = tmp_path / "Jürgen"
    folder.mkdir()
    (folder / "röbot.toml").write_bytes(SHIPPED.read_bytes())
    done = shell('$run check "$1"', folder / "röbot.toml", XDG_CACHE_HOME=str(folder))
    assert (done.returncode, faults(done.stderr)) == (0, "")
    assert done.stdout.startswith(f"{folder}/röbot.toml: N = 20")
    assert list((folder / "rti_mpc").glob("*.so"))
    done = shell('$run check "$1"', folder / "nö.toml")
    assert (done.returncode, done.stderr) == (2, f"rti-mpc: {folder}/nö.toml: must be a readable file, got No such file or directory\n")


def test_warning_of_the_library_is_one_line_of_the_log() -> None:
    code = "import warnings\nfrom rti_mpc_service import entry, log\nentry.enter(log.start, lambda: warnings.warn('slow', stacklevel=1))"
    done = run(code, stdout=subprocess.PIPE)
    line = json.loads(done.stdout)
    assert (line["level"], line["logger"], line["text"]) == ("WARNING", "rti_mpc", "slow")
    assert done.stderr == b""
