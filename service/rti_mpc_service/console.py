# SPDX-License-Identifier: Apache-2.0
"""Console for tables: wide enough for every number, also in a pipe or a narrow terminal."""

from __future__ import annotations

from rich.console import Console

MIN_WIDTH_COLUMNS = 140  # a narrower terminal wraps lines, which loses nothing; a narrower table would cut numbers off


def table_console() -> Console:
    """Return a console of at least `MIN_WIDTH_COLUMNS` columns."""
    return widened(Console())


def widened(console: Console) -> Console:
    """Give a console at least `MIN_WIDTH_COLUMNS` columns from now on; not while something is redrawn on it, which must fit the terminal."""
    console.width = max(console.width, MIN_WIDTH_COLUMNS)
    return console
