# SPDX-License-Identifier: Apache-2.0
"""Notice of a compilation, which only the first start of a problem on a machine waits for."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

MIN_DURATION_S = 1.0  # shorter ones are not worth a line


@contextmanager
def compilation_shown(duration_s: float, say: Callable[[str], object] = lambda _: None) -> Iterator[None]:
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
        with Progress(
            SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), console=Console(stderr=True), transient=True
        ) as progress:
            progress.add_task(text, total=None)
            yield
    else:
        say(text)
        yield
