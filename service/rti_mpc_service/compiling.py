# SPDX-License-Identifier: Apache-2.0
"""Notice of what a start waits for: a compilation, or other work of seconds, most of it only at the first start of a problem on a machine."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Timer

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

MIN_DURATION_S = 1.0  # shorter waits are not worth a line


@contextmanager
def compilation_shown(duration_s: float, say: Callable[[str], object]) -> Iterator[None]:
    """
    Show that something is being compiled: on a terminal with the time elapsed, gone when it is done.

    Args:
        duration_s: How long it should take.
        say: Takes a line instead where there is no terminal.
    """
    text = f"compiling the model, once, about {duration_s:.0f} s"
    if duration_s < MIN_DURATION_S:
        yield
    elif sys.stderr.isatty():
        with spinner(text):
            yield
    else:
        say(text)
        yield


@contextmanager
def work_shown(text: str, say: Callable[[str], object]) -> Iterator[None]:
    """
    Show that something is being worked at whose duration is not known: on a terminal with the time elapsed, gone when it is done.

    Args:
        text: What is done.
        say: Takes the text instead where there is no terminal, in a thread of its own, once it has taken `MIN_DURATION_S`.
    """
    if sys.stderr.isatty():
        with spinner(text):
            yield
        return
    later = Timer(MIN_DURATION_S, say, (text,))
    later.daemon = True
    later.start()
    try:
        yield
    finally:
        later.cancel()


@contextmanager
def spinner(text: str) -> Iterator[None]:
    """Show a text and the time elapsed on the terminal of standard error."""
    with Progress(SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), console=Console(stderr=True), transient=True) as progress:
        progress.add_task(text, total=None)
        yield
