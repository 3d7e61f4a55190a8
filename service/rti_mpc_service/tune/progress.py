# SPDX-License-Identifier: Apache-2.0
"""Progress of a study: on a terminal one line with what is done and for how long, which goes when it is over; else a line as it begins."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn


@contextmanager
def doing(console: Console, what: str) -> Iterator[Callable[[str], object]]:
    """Tell what goes on that may take long; the function given is told how far it is."""
    if not console.is_terminal:
        console.print(what, soft_wrap=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(what, total=None)
        yield lambda far: progress.update(task, description=f"{what}: {far}")


@contextmanager
def counting(console: Console, what: str, total: int, done: int) -> Iterator[Callable[[int], object]]:
    """Show how many of `total` are done; the function given is told how many."""
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(what, total=total, completed=done)
        yield lambda count: progress.update(task, completed=count)
