# SPDX-License-Identifier: Apache-2.0
"""Processes that drive closed loops side by side, and end with the process that started them, however it ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import wait
from threading import Thread

from rti_mpc_service.config.schema import Config
from rti_mpc_service.scenario import Scenario
from rti_mpc_service.tune.closed_loop import ClosedLoop, Course, Driven, MakeBody, attempted

Values = Mapping[str, float]
Laid = Mapping[str, tuple[Config, Scenario]]  # by name of the course
DriveAll = Callable[[Iterable[tuple[str, Values]]], Iterator[Driven | None]]  # of courses by name and values, in order

_loops: dict[str, ClosedLoop] = {}  # of this worker


@contextmanager
def workers(loops: Mapping[str, ClosedLoop], remake: tuple[Config, Mapping[str, Course], Laid, MakeBody], jobs: int) -> Iterator[DriveAll]:
    """
    Give a function that drives several closed loops.

    Args:
        loops: Those of this process, which drive here where one job is enough.
        remake: What another process makes them from; what is laid out already, such as a recording, it need not read again.
        jobs: Number of processes.
    """
    if jobs == 1:
        yield lambda drives: (attempted(loops[name], values) for name, values in drives)
        return
    context = multiprocessing.get_context("spawn")  # a fork would copy threads of numpy and of the progress bar
    pool = ProcessPoolExecutor(jobs, context, initializer=partial(_begin, *remake))
    try:
        yield lambda drives: pool.map(_drive, drives)
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(config: Config, courses: Mapping[str, Course], laid: Laid, make_body: MakeBody) -> None:
    """Make the closed loops of a worker. Ctrl-C is the starter's alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_starter, daemon=True).start()
    _loops.update({name: ClosedLoop(config, course, make_body, laid.get(name)) for name, course in courses.items()})


def _end_with_starter() -> None:
    """End this process when its starter has ended, even by SIGKILL, after which nobody would tell it."""
    if (starter := multiprocessing.parent_process()) is not None:
        wait([starter.sentinel])
        os._exit(1)


def _drive(drive: tuple[str, Values]) -> Driven | None:
    name, values = drive
    return attempted(_loops[name], values)
