# SPDX-License-Identifier: Apache-2.0
"""
Real time as far as the host gives it: each part attempted, its outcome told, none required.

What is granted to the calling thread is inherited by every thread it starts, and
by those they start: called before the bus is opened, it holds for the thread that
controls, for Zenoh's that receive and send, and for all others of Python. These
must not stay behind: the interpreter's lock knows no priority inheritance, so one
that is preempted while it holds the lock would stop the control of the robot.

SCHED_FIFO can hang a machine: a thread that never pauses takes its core from
everybody of lower priority. No thread here spins, and the kernel is asked to kill
the process (RLIMIT_RTTIME) should one compute for `MAX_UNBROKEN_COMPUTING_US` without a pause;
the robot then brakes, and a supervisor starts the controller again.
"""

from __future__ import annotations

import ctypes
import os
import resource
from collections.abc import Callable, Sequence
from dataclasses import dataclass

MAX_UNBROKEN_COMPUTING_US = 1_000_000  # a thread that computes longer without a pause is killed by the kernel
MCL_CURRENT, MCL_ONFAULT = 1, 4  # flags of mlockall(2)


@dataclass(frozen=True)
class RealtimeOutcome:
    """What became of one attempt."""

    what: str
    granted: bool
    text: str

    def __str__(self) -> str:
        return f"{self.what} {self.text}"


def attempt(priority: int | None = None, cores: Sequence[int] = (), *, lock_memory: bool = False) -> list[RealtimeOutcome]:
    """
    Ask the operating system for what is configured.

    Args:
        priority: Of SCHED_FIFO; the usual scheduler if None.
        cores: To run on; on any if empty.
        lock_memory: Whether to keep in memory what has been used, and what of it will be.

    Returns:
        An outcome for each part that was asked for.
    """
    parts: list[tuple[bool, str, Callable[[], str], Callable[[], str]]] = [
        (priority is not None, "priority", lambda: _schedule(priority or 0), lambda: f"RLIMIT_RTPRIO is {limit(resource.RLIMIT_RTPRIO)}"),
        (bool(cores), "cores", lambda: _pin(cores), lambda: f"those to run on are {_listed(available())}"),
        (lock_memory, "lock_memory", _lock, lambda: f"RLIMIT_MEMLOCK is {limit(resource.RLIMIT_MEMLOCK)} bytes"),
    ]
    return [_outcome(what, act, why_not) for asked_for, what, act, why_not in parts if asked_for]


def limit(number: int) -> str:
    """Return a limit of this process in words."""
    soft, _ = resource.getrlimit(number)
    return "unlimited" if soft == resource.RLIM_INFINITY else str(soft)


def available() -> Sequence[int]:
    """Return the cores that the calling thread may run on."""
    return sorted(os.sched_getaffinity(0))


def _outcome(what: str, act: Callable[[], str], why_not: Callable[[], str]) -> RealtimeOutcome:
    try:
        return RealtimeOutcome(what, True, act())
    except OSError as error:
        return RealtimeOutcome(what, False, f"refused: {error.strerror}, {why_not()}")
    except AttributeError:
        return RealtimeOutcome(what, False, "refused: this system has no such thing")


def _schedule(priority: int) -> str:
    _, hard = resource.getrlimit(resource.RLIMIT_RTTIME)
    runaway_us = MAX_UNBROKEN_COMPUTING_US if hard == resource.RLIM_INFINITY else min(hard, MAX_UNBROKEN_COMPUTING_US)
    resource.setrlimit(resource.RLIMIT_RTTIME, (runaway_us, runaway_us))
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    return f"SCHED_FIFO {priority}"


def _pin(cores: Sequence[int]) -> str:
    os.sched_setaffinity(0, cores)
    return _listed(available())


def _lock() -> str:
    # On fault: the whole address space, its unused stacks included, is ten times what is ever touched. Not of the
    # future: behind a limit, an allocation that cannot be locked would fail.
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_ONFAULT):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return "locked"


def _listed(cores: Sequence[int]) -> str:
    return ", ".join(map(str, cores))
