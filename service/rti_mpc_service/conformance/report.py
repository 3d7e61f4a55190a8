# SPDX-License-Identifier: Apache-2.0
"""Report of a conformance test: a line per case while it goes on, the table at the end, and what to mend."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rti_mpc_service.conformance.finding import Judgement
from rti_mpc_service.console import widened

VERDICTS = {"yes": "kept", "host": "excused by the host", "NO": "broken", "not visible": "not visible"}


def progress(console: Console, judgement: Judgement, number: int, count: int) -> None:
    """Print the line of a case that was just judged."""
    console.print(f"{number} of {count}: {judgement.case.name}: {VERDICTS[judgement.verdict]}", soft_wrap=True)


def conclude(console: Console, what: str, judgements: Sequence[Judgement]) -> None:
    """Print the table, what is right and what to mend where something is broken, and how many promises are kept."""
    table = Table(box=None, padding=(0, 1))
    table.add_column("case", no_wrap=True)
    table.add_column("kept", no_wrap=True)
    table.add_column("seen")
    for judgement in judgements:
        style = "red" if judgement.broken else ""
        table.add_row(Text(judgement.case.name, style), Text(judgement.verdict, style), Text(judgement.finding.seen, style))
    widened(console).print(table)
    for judgement in judgements:
        if judgement.broken:
            console.print(f"{judgement.case.name}: right is: {judgement.case.promise}; mend: {judgement.case.mend}", soft_wrap=True)
    found = Counter(VERDICTS[judgement.verdict] for judgement in judgements)
    console.print(f"{what}: {', '.join(f'{found[words]} {words}' for words in VERDICTS.values() if found[words])}", soft_wrap=True)
