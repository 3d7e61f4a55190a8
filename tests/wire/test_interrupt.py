# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import Timer

import pytest

ROOT = Path(__file__).parents[2]
LOOP = """
import sys, threading
from rti_mpc.wire.interrupt import stop_on_signals

stop = stop_on_signals()
print("ready", flush=True)
storm = threading.Thread(target=sys.stdin.readline)
storm.start()
while storm.is_alive():
    stop.clear()
    stop.wait(1e-5)
while stop.wait(0.2):  # what is left of the storm
    stop.clear()
print("survived", flush=True)
stop.wait()
"""


def test_ctrl_c_never_hangs_a_process_that_waits_for_it() -> None:
    """The handler runs in the main thread, which may be inside the very wait that it ends."""
    with subprocess.Popen([sys.executable, "-c", LOOP], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        patience = Timer(120.0, process.kill)
        patience.start()
        try:
            assert process.stdin is not None
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            for _ in range(2000):
                process.send_signal(signal.SIGINT)
                time.sleep(5e-4)  # the pace of the storm: nobody is waited for
            process.stdin.write("over\n")
            process.stdin.flush()
            assert process.stdout.readline() == "survived\n"
            process.send_signal(signal.SIGINT)
            assert process.wait(60.0) == 0
        finally:
            patience.cancel()
            process.kill()


WAIT = """
from rti_mpc.wire.interrupt import stop_on_signals

stop = stop_on_signals()
print("ready", flush=True)
while not stop.wait(0.01):
    pass
print("stopped", flush=True)
"""


@pytest.mark.parametrize(("command", "numbers"), [([], [signal.SIGHUP]), ([], [signal.SIGTERM]), (["nohup"], [signal.SIGHUP, signal.SIGINT])])
def test_terminal_that_hangs_up_stops_a_process_unless_it_was_started_to_outlive_it(command: list[str], numbers: list[int]) -> None:
    with subprocess.Popen([*command, sys.executable, "-c", WAIT], cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            for number in numbers[:-1]:
                process.send_signal(number)
                with pytest.raises(subprocess.TimeoutExpired):
                    process.wait(0.5)
            process.send_signal(numbers[-1])
            assert process.stdout.readline() == "stopped\n"
            assert process.wait(60.0) == 0
        finally:
            process.kill()


ELSEWHERE = """
import signal, threading, time
from rti_mpc.wire.interrupt import stop_on_signals

stop = stop_on_signals()

def other():
    time.sleep(0.3)  # the main thread waits by then
    signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
    time.sleep(60.0)

threading.Thread(target=other, daemon=True).start()
stop.wait()
"""


def test_signal_that_the_kernel_hands_to_another_thread_stops_the_process_as_well() -> None:
    """As it does where the main thread has just been woken: a router that waited without a timeout then hung."""
    assert subprocess.run([sys.executable, "-c", ELSEWHERE], cwd=ROOT, timeout=120.0).returncode == 0
