# SPDX-License-Identifier: Apache-2.0
"""Terminal output that is redrawn in place while something goes on."""

from __future__ import annotations

from typing import Self

from rich.console import Console, RenderableType
from rich.live import Live


class Redrawn:
    """
    An area of the terminal that disappears when its context ends.

    Attributes:
        console: The console.
        live: Whether the console is a terminal; otherwise nothing is drawn.
    """

    def __init__(self, console: Console) -> None:
        self.console = console
        self.live = console.is_terminal
        self._area = Live(console=console, auto_refresh=False, transient=True)

    def __enter__(self) -> Self:
        if self.live:
            self._area.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._area.stop()

    def draw(self, what: RenderableType) -> None:
        """Replace the content of the area."""
        self._area.update(what, refresh=True)
