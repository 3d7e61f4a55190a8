# SPDX-License-Identifier: Apache-2.0
"""Limits in milliseconds on a host that may be busy: a limit may be exceeded only by delays that the witness of the host has recorded."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rti_mpc_service.host.hold_up import Host, Threads

MS = 1_000_000
WAIT_BEFORE_DROP = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"  # us
WAIT_BEFORE_CLOSE = "transport/link/tx/queue/congestion_control/block/wait_before_close"  # us
PATIENT = (f"{WAIT_BEFORE_DROP}:60000000",)  # settings of a bus that waits rather than drop a message where a busy host holds up the link
SEEN = 0.8  # share of a delay that the witness sees at least, where the host is the reason
LOOK_MS = 20.0  # between two looks at a process that ends
MIN_HALT_MS = 20.0  # shorter ones are not told from timers that are late by themselves
PATIENCE_S = 120.0  # for an end: a busy host takes its time
BEFORE_NS = 50 * MS  # what has just been sent when something begins may be held up already


def in_time(host: Host, what: str, took_ms: float, limit_ms: float, since_ns: int) -> None:
    """Check a duration since an instant of the monotonic clock against its limit, less the delays caused by the host, which are printed."""
    late_ms = took_ms - limit_ms
    assert late_ms <= 0.0 or explained(host, f"{what} took {took_ms:.0f} ms of {limit_ms:.0f}", late_ms, since_ns, since_ns + round(took_ms * MS))


def on_time(host: Host, what: str, period_ms: float, since_ns: int) -> bool:
    """Whether the host has held processes up for less than half a period in any two since an instant of the monotonic clock; prints it if not."""
    worst_ms = host.worst_ms(since_ns - BEFORE_NS, time.monotonic_ns(), round(2 * period_ms * MS))
    if late := worst_ms > 0.5 * period_ms:
        print(f"\n{what} is not held to its numbers: within {2 * period_ms:.0f} ms the host held processes up for {worst_ms:.0f} ms")
    return not late


def explained(host: Host, what: str, by_ms: float, from_ns: int, to_ns: int) -> bool:
    """
    Whether the host held processes up for at least so long in a time of the monotonic clock; says so.

    What runs beside others also runs more slowly, and the witness does not see threads that live shorter than 0.1 s.
    """
    held_up_ms = host.held_up_ms(from_ns - BEFORE_NS, to_ns)
    print(f"\n{what}, while the host held processes up for {held_up_ms:.0f} ms, where {by_ms:.0f} would explain it")
    return held_up_ms >= SEEN * by_ms


def computed_ms(process: subprocess.Popen[bytes]) -> float:
    """Return for how long a process and the children it has waited for have computed: what a start takes of it is the host's speed."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) * 1000.0 / os.sysconf("SC_CLK_TCK")


def ends_in_time(
    process: subprocess.Popen[Any], what: str, limit_ms: float, patience_s: float = PATIENCE_S, asked: Sequence[subprocess.Popen[Any]] = ()
) -> int:
    """
    Hold a process that was just asked to end to a time, less that in which its own threads got no core; return its exit status.

    What others wait for meanwhile excuses nothing, but for those whose answer the end takes: where many end at once, that alone would excuse any end.

    Raises:
        subprocess.TimeoutExpired: It does not end.
    """
    since_ns = time.monotonic_ns()
    waits = [OwnWaits(one.pid) for one in (process, *asked)]
    while process.poll() is None:
        for one in waits:
            one.look()
        with suppress(subprocess.TimeoutExpired):
            process.wait(1e-3 * LOOK_MS)
        if time.monotonic_ns() - since_ns > 1e9 * patience_s:
            raise subprocess.TimeoutExpired(what, patience_s)
    took_ms = (time.monotonic_ns() - since_ns) / MS
    for one in waits:
        one.look()
        one.close()
    waited_ms = [round(one.ms) for one in waits]
    late = f"{what} took {took_ms:.0f} ms of {limit_ms:.0f}, of which its threads had no core for {waited_ms[0]} ms"
    assert SEEN * (took_ms - limit_ms) <= sum(waited_ms), late + "".join(f", those of a process that it asks {ms} ms" for ms in waited_ms[1:])
    return process.returncode


class OwnWaits:
    """
    For how long the threads of one process have got no core, at most the time that passed: they waited for one, or the host was halted.

    Attributes:
        ms: The sum until the last look.
    """

    def __init__(self, pid: int) -> None:
        self.ms = 0.0
        self._threads, self._looked_ns, self._busy_ns = Threads(pid), time.monotonic_ns(), busy_ns()

    def look(self) -> None:
        """Add what has passed since the last look; to be called every `LOOK_MS` by a thread that sleeps meanwhile, while the process lives."""
        self._threads.find()
        now_ns, now_busy_ns = time.monotonic_ns(), busy_ns()
        passed_ns = now_ns - self._looked_ns
        # Who was to sleep for `LOOK_MS`, and has neither computed nor waited for a core for the rest, was halted with everybody else.
        halted_ns = passed_ns - (now_busy_ns - self._busy_ns) - round(LOOK_MS * MS)
        gone_ns = self._threads.waited_ns() + (halted_ns if halted_ns > MIN_HALT_MS * MS else 0)
        self.ms += min(gone_ns, passed_ns) / MS
        self._looked_ns, self._busy_ns = now_ns, now_busy_ns

    def close(self) -> None:
        """Close what was opened of threads that live on."""
        self._threads.close()

    def explain(self, late_ms: float) -> bool:
        """Whether the process has been late by no more than its own waits explain."""
        return SEEN * late_ms <= self.ms


def busy_ns() -> int:
    """Return for how long this thread has computed or waited for a core."""
    return sum(map(int, Path("/proc/thread-self/schedstat").read_text().split()[:2]))
