# SPDX-License-Identifier: Apache-2.0
"""Supervision of the processes of a run: waits for conditions, and notices a process that has ended by itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event

from rti_mpc_service.rig.children import Children

CLI_MODULE = "rti_mpc_service"  # the command line, as children are started with it
WATCHER_NICENESS = 10  # niceness of processes that only watch
START_TIMEOUT_S = 300.0  # for processes to come up: the first controller on a machine compiles, and watchers start last on a busy one
POLL_PERIOD_S = 0.05  # period at which a condition is checked


class Failed(Exception):
    """The run cannot go on; the text gives the reason."""


def wait(condition: Callable[[], object], children: Children, stop: Event, patience_s: float, what: str) -> None:
    """
    Wait for a condition, or until stopped.

    Raises:
        Failed: It did not come true in time, or a process has ended by itself.
    """
    deadline_s = time.monotonic() + patience_s
    while not condition() and not stop.is_set():
        check_children(children)
        if time.monotonic() > deadline_s:
            raise Failed(f"waited {patience_s:g} s for {what} in vain, see {children.folder}")
        stop.wait(POLL_PERIOD_S)


def check_children(children: Children) -> None:
    """
    Check that all processes still run.

    Raises:
        Failed: A process has ended by itself.
    """
    if name := children.ended():
        said = children.log(name).read_text(encoding="utf-8", errors="replace").splitlines()
        raise Failed(f"the {name} has ended by itself, see {children.log(name)}" + (f": {said[-1]}" if said else ""))
