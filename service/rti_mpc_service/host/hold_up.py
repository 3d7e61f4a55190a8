# SPDX-License-Identifier: Apache-2.0
"""
Witness of the host: for how long a process and its descendants were ready to run and got no core.

A bare timer on each core, which computes nothing, measures when that core stood still.
One of the timers adds up how long each thread of the watched processes was ready to run
and had no core (`schedstat` in `proc(5)`). Where processes wait for each other, the sum
over all of them is an upper bound on the delay of the chain; so is the time itself, however
many wait at once.

`python -m rti_mpc_service.host.hold_up FILE CORE PID` is one such timer; with PID 0 it watches no process.
"""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from rti_mpc_service.host.realtime import available

TICK_PERIOD_NS = 2_000_000
MIN_COUNTED_LATENESS_NS = 500_000  # less is not counted: even a core in deep sleep wakes faster
TICKS_PER_ROW = 5  # a timer writes one row every 10 ms
ROWS_PER_THREAD_SEARCH = 10  # new threads are searched for every 0.1 s
ROW_LAYOUT = struct.Struct("<4q")  # the fields of `Row`
ROW_TIMEOUT_S = 10.0  # how long to wait for the rows of a requested time


class Unwitnessed(Exception):
    """The witness has not told what the host did in a time."""


class Row(NamedTuple):
    """Record of one timer between two instants of the monotonic clock: lateness of its ticks, and waiting time of the watched threads, ns."""

    since_ns: int
    until_ns: int
    late_ns: int
    waited_ns: int

    @property
    def held_up_ns(self) -> int:
        """Lateness and waiting time together, at most the time that passed: threads that wait at once hold up nobody for longer."""
        return min(self.late_ns + self.waited_ns, self.until_ns - self.since_ns)


class Host:
    """Witness that watches this process and all its descendants while its context is open."""

    def __enter__(self) -> Host:
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rti-mpc-host-")))
            self._timers = [Timer(folder, core, os.getpid() if core == available()[0] else 0, stack) for core in available()]
            self.held_up_ms(time.monotonic_ns(), time.monotonic_ns())
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._stack.close()

    def held_up_ms(self, from_ns: int, to_ns: int) -> float:
        """
        Return for how long the host held the watched processes up in a past interval, ms: at most for all of it.

        Args:
            from_ns: Start of the interval, by the monotonic clock.
            to_ns: End of the interval.

        Raises:
            Unwitnessed: A timer has ended, or has not recorded the interval within ten seconds.
        """
        return 1e-6 * min(to_ns - from_ns, sum(row.held_up_ns for timer in self._timers for row in timer.rows(from_ns, to_ns)))

    def worst_ms(self, from_ns: int, to_ns: int, within_ns: int) -> float:
        """
        Return the longest hold-up within any window of an interval, ms.

        Args:
            from_ns: Start of the interval, by the monotonic clock.
            to_ns: End of the interval.
            within_ns: Length of the window.

        Raises:
            Unwitnessed: A timer has ended, or has not recorded the interval within ten seconds.
        """
        rows = sorted(row for timer in self._timers for row in timer.rows(from_ns, to_ns))
        recent, held_up_ns, worst_ns = deque[Row](), 0, 0
        for row in rows:
            recent.append(row)
            held_up_ns += row.held_up_ns
            while row.since_ns - recent[0].since_ns > within_ns:
                held_up_ns -= recent.popleft().held_up_ns
            worst_ns = max(worst_ns, held_up_ns)
        return 1e-6 * worst_ns


class Timer:
    """A bare timer in a process of its own, and what it has written so far."""

    def __init__(self, folder: Path, core: int, watched: int, stack: ExitStack) -> None:
        self._file = stack.enter_context((folder / str(core)).open("w+b", buffering=0))
        self._rows: list[Row] = []
        command = [sys.executable, "-m", "rti_mpc_service.host.hold_up", str(folder / str(core)), str(core), str(watched)]
        self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, process_group=0)
        stack.callback(self.process.wait)
        stack.callback(self.process.kill)

    def rows(self, from_ns: int, to_ns: int) -> Iterator[Row]:
        """
        Wait until the timer has recorded an interval completely, and yield its rows, the last one first.

        Raises:
            Unwitnessed: It has ended, or has not recorded the interval within ten seconds.
        """
        deadline_s = time.monotonic() + ROW_TIMEOUT_S
        while not self._rows or self._rows[-1].until_ns < to_ns:
            if (status := self.process.poll()) is not None:
                raise Unwitnessed(f"the host's witness has ended with status {status}")
            if time.monotonic() > deadline_s:
                told = f"{1e-6 * TICKS_PER_ROW * TICK_PERIOD_NS:g} ms"
                raise Unwitnessed(f"the host's witness must tell every {told}, and was silent for {ROW_TIMEOUT_S:g} s")
            time.sleep(1e-9 * TICK_PERIOD_NS)
            self._rows += map(Row._make, ROW_LAYOUT.iter_unpack(self._file.read()))  # a row is written at once
        for row in reversed(self._rows):
            if row.until_ns < from_ns:
                return
            if row.since_ns <= to_ns:
                yield row


class Threads:
    """
    All threads of a process and its descendants, except this timer's own, and how long each has waited for a core.

    The kernel counts a wait only when it is over. A wait that still lasts is counted here
    meanwhile, since the thread is runnable and does not run; so is the last wait of a thread that ends in it.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._open: dict[str, Waits] = {}  # by folder in proc
        self._looked_ns = time.monotonic_ns()
        self.find()
        self.waited_ns()

    def find(self) -> None:
        """Find the threads that exist now."""
        pids = [str(self._pid)] if self._pid else []
        for pid in pids:
            with suppress(OSError):  # it ends meanwhile
                for thread in os.listdir(f"/proc/{pid}/task"):
                    with open(f"/proc/{pid}/task/{thread}/children") as children:
                        pids += [child for child in children.read().split() if int(child) != os.getpid()]
                    folder = f"/proc/{pid}/task/{thread}"
                    if folder not in self._open:
                        self._open[folder] = Waits(folder)

    def waited_ns(self) -> int:
        """Return how long all threads together have waited since the last call, ns."""
        total_ns, now_ns = 0, time.monotonic_ns()
        for folder, waits in list(self._open.items()):
            try:
                total_ns += waits.since(now_ns - self._looked_ns)
            except OSError:  # it has ended
                waits.close()
                del self._open[folder]
        self._looked_ns = now_ns
        return total_ns

    def close(self) -> None:
        """Close the files in proc of all threads that live."""
        while self._open:
            self._open.popitem()[1].close()


class Waits:
    """How long one thread has waited for a core."""

    def __init__(self, folder: str) -> None:
        self._stat = f"{folder}/stat"
        self._descriptor = os.open(f"{folder}/schedstat", os.O_RDONLY)
        self._ran_ns = self._waited_ns = 0
        self._told_ns = 0  # already returned part of a wait that still lasts

    def since(self, elapsed_ns: int) -> int:
        """
        Return how long the thread has waited since the last call, which was `elapsed_ns` ago.

        Raises:
            OSError: The thread has ended.
        """
        ran_ns, waited_ns, _ = map(int, os.pread(self._descriptor, 128, 0).split())
        if (ran_ns, waited_ns) == (self._ran_ns, self._waited_ns):
            with open(self._stat, "rb") as stat:
                runnable = stat.read().rpartition(b") ")[2][:1] == b"R"
            self._told_ns += elapsed_ns * runnable
            return elapsed_ns * runnable
        more_ns = max(0, waited_ns - self._waited_ns - self._told_ns)
        self._ran_ns, self._waited_ns, self._told_ns = ran_ns, waited_ns, 0
        return more_ns

    def close(self) -> None:
        """Close the thread's file in proc."""
        os.close(self._descriptor)


def main(path: str, core: int, pid: int) -> None:
    """Write a row every ten milliseconds while the parent process lives."""
    os.sched_setaffinity(0, {core})
    parent, threads, number = os.getppid(), Threads(pid), 0
    since_ns = due_ns = time.monotonic_ns()
    with Path(path).open("ab", buffering=0) as file:
        while os.getppid() == parent:
            late_ns = 0
            for _ in range(TICKS_PER_ROW):
                due_ns += TICK_PERIOD_NS
                due_ns += max(0, time.monotonic_ns() - due_ns) // TICK_PERIOD_NS * TICK_PERIOD_NS  # missed ticks are skipped
                time.sleep(max(0.0, 1e-9 * (due_ns - time.monotonic_ns())))
                if (lateness_ns := time.monotonic_ns() - due_ns) > MIN_COUNTED_LATENESS_NS:
                    late_ns += lateness_ns
            if (number := number + 1) % ROWS_PER_THREAD_SEARCH == 0:
                threads.find()
            waited_ns, now_ns = threads.waited_ns(), time.monotonic_ns()
            file.write(ROW_LAYOUT.pack(since_ns, now_ns, late_ns, waited_ns))
            since_ns = now_ns


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
