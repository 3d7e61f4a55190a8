# SPDX-License-Identifier: Apache-2.0
"""Tables on a console that is too narrow for them."""

from __future__ import annotations

from io import StringIO

from rich.console import Console
from rich.table import Table

from rti_mpc_service.console import MIN_WIDTH_COLUMNS, print_whole, widened


def test_each_row_of_a_table_is_printed_in_one_line_however_wide_it_is() -> None:
    table, cells = Table(), [f"{number} / {number} / {number}" for number in range(100_000, 100_012)]
    for heading in range(len(cells)):
        table.add_column(f"column {heading}")
    table.add_row(*cells)
    console = widened(Console(file=StringIO(), width=80))
    print_whole(console, table)
    printed = console.file.getvalue()
    assert max(map(len, printed.splitlines())) > MIN_WIDTH_COLUMNS
    assert all(cell in printed for cell in cells)


def test_a_console_stays_as_wide_as_it_is_for_a_table_that_fits() -> None:
    table, console = Table("one", "two"), Console(file=StringIO(), width=90)
    print_whole(console, table)
    assert console.width == 90
