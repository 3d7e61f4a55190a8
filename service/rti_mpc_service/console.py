# SPDX-License-Identifier: Apache-2.0
"""Console of commands that print tables: wide enough for every number, also in a pipe or a narrow terminal."""

from __future__ import annotations

from rich.console import Console

WIDTH = 140  # columns; a narrower terminal wraps lines, which loses nothing, where a narrower table cuts numbers off


def table_console() -> Console:
    """Return a console of at least `WIDTH` columns."""
    console = Console()
    return console if console.width >= WIDTH else Console(width=WIDTH)
