# SPDX-License-Identifier: Apache-2.0
"""
Real-time settings of a process: each is attempted and reported, and none is required.

Settings granted to the calling thread are inherited by every thread it starts, and
by their threads. Called before the bus is opened, they hold for the control
thread, for Zenoh's receiving and sending threads, and for all other Python threads.
All of them need the priority: the interpreter's lock has no priority inheritance,
so a thread of low priority, preempted while it holds the lock, would stop the control.

SCHED_FIFO can hang a machine: a thread that never pauses takes its core from all
threads of lower priority. No thread here spins, and the kernel kills the process
(RLIMIT_RTTIME) if a thread computes for `MAX_UNBROKEN_COMPUTING_US` without a pause.
The robot then brakes, and a supervisor restarts the controller.
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
    """Outcome of one attempted setting."""

    what: str
    granted: bool
    text: str

    def __str__(self) -> str:
        return f"{self.what} {self.text}"


def attempt(priority: int | None = None, cores: Sequence[int] = (), *, lock_memory: bool = False) -> list[RealtimeOutcome]:
    """
    Request the configured settings from the operating system.

    Args:
        priority: Priority of SCHED_FIFO; None: the usual scheduler.
        cores: Numbers of the cores to run on; empty: any core.
        lock_memory: Whether every used page of the present mappings stays in memory.

    Returns:
        An outcome for each requested setting.
    """
    parts: list[tuple[bool, str, Callable[[], str], Callable[[], str]]] = [
        (priority is not None, "priority", lambda: _schedule(priority or 0), lambda: f"RLIMIT_RTPRIO is {limit(resource.RLIMIT_RTPRIO)}"),
        (bool(cores), "cores", lambda: _pin(cores), lambda: f"those to run on are {_listed(available())}"),
        (lock_memory, "lock_memory", _lock, lambda: f"RLIMIT_MEMLOCK is {limit(resource.RLIMIT_MEMLOCK)} bytes"),
    ]
    return [_outcome(what, act, why_not) for asked_for, what, act, why_not in parts if asked_for]


def limit(number: int) -> str:
    """Return a resource limit of this process as text."""
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
    # On fault: the whole address space, with its unused stacks, is ten times what is ever touched. Not MCL_FUTURE:
    # with a limit on locked memory, an allocation that cannot be locked would fail.
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MCL_CURRENT | MCL_ONFAULT):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return "locked"


def _listed(cores: Sequence[int]) -> str:
    return ", ".join(map(str, cores))
