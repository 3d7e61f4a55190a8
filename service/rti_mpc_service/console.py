# SPDX-License-Identifier: Apache-2.0
"""Console whose texts and tables lose nothing: wide enough for every number, also in a pipe or a narrow terminal, and without markup."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

MAX_WIDTH_COLUMNS = 1000  # more than any table has
MIN_WIDTH_COLUMNS = 140  # a narrower terminal wraps lines, which loses nothing; a narrower table would cut numbers off


def plain_console() -> Console:
    """Return a console that prints texts as they are: what looks like markup, such as the extra in ``rti-mpc[view]``, is none."""
    return Console(markup=False, emoji=False)


def table_console() -> Console:
    """Return such a console of at least `MIN_WIDTH_COLUMNS` columns."""
    return widened(plain_console())


def widened(console: Console) -> Console:
    """Give a console at least `MIN_WIDTH_COLUMNS` columns from now on; not while something is redrawn on it, which must fit the terminal."""
    console.width = max(console.width, MIN_WIDTH_COLUMNS)
    return console


def whole_width(console: Console, table: Table) -> int:
    """Return how many columns a table needs for each row to be in one line."""
    return console.measure(table, options=console.options.update(max_width=MAX_WIDTH_COLUMNS)).maximum


def print_whole(console: Console, table: Table) -> None:
    """Print a table with each row in one line, on a console that from now on is as wide."""
    console.width = max(console.width, whole_width(console, table))
    console.print(table)
