# SPDX-License-Identifier: Apache-2.0
"""Report of the fault matrix: a growing table on a terminal, and the whole table at the end; lines on a terminal that is too narrow for it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from rich.console import Console, Group
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rti_mpc_service.console import print_whole, whole_width, widened
from rti_mpc_service.faults.measure import Measured
from rti_mpc_service.faults.table import Fault
from rti_mpc_service.host import machine
from rti_mpc_service.redrawn import Redrawn

COLUMNS = (
    *("fault", "the robot", "speed\nUNIT/s", "braking\nms", "zero\nms", "standstill\ns"),
    *("way\nUNIT", "step\n%", "error\nmUNIT", "recovery\ns", "kept"),
)
NO_VALUE = "-"
PATIENCE_S = 10.0  # a wait that lasts longer is told, and again each time it has lasted twice as long


@dataclass(frozen=True)
class MatrixRow:
    """
    Result of one fault.

    Attributes:
        fault: The fault.
        measured: The robot's reaction; None if nothing could be measured.
        broken: Broken limits of the promise, in words.
        excused: Exceeded limits that delays of the host alone explain, in words.
        unit: Unit of what is called m, see `rti_mpc_service.faults.motion`.
    """

    fault: Fault
    measured: Measured | None
    broken: list[str]
    excused: list[str] = field(default_factory=list)
    unit: str = "m"

    @property
    def did(self) -> str:
        """What the robot did, in words."""
        if (measured := self.measured) is None:
            return "unknown"
        if measured.zero_s is None and measured.still_s is None:
            return "drove on"
        words = [
            word
            for word, done in (("braked", measured.brake_s), ("stood", measured.still_s), ("drove again", measured.recovery_s))
            if done is not None
        ]
        return ", ".join(words)

    def to_json(self) -> dict[str, Any]:
        """Return everything, in JSON."""
        return {
            "name": self.fault.name,
            "fault": self.fault.text,
            "wiring": self.fault.wiring.value,
            "promise": self.fault.promise.text,
            "kept": not self.broken,
            "broken": self.broken,
            "excused": self.excused,
            "robot": self.did,
            "unit": self.unit,
            **({} if self.measured is None else asdict(self.measured)),
        }

    def cells(self) -> tuple[str, ...]:
        """Return the cells of the table."""
        promised = self.fault.promise.at_most
        measured, verdict = self.measured, "NO" if self.broken else "host" if self.excused else "yes"
        if measured is None:
            return (self.fault.name, self.did, *[NO_VALUE] * (len(COLUMNS) - 3), verdict)
        return (
            self.fault.name,
            self.did,
            f"{measured.speed_m_s:.2f}",
            number_text(measured.brake_s, 1e3, 0),
            number_text(measured.zero_s, 1e3, 0),
            number_text(measured.still_s, 1.0, 2),
            f"{measured.distance_m:.3f}",
            f"{100 * measured.step_share:.0f}",
            number_text(next((getattr(measured, name) for name in ("error_m", "final_error_m") if name in promised), None), 1e3, 1),
            number_text(measured.recovery_s if "recovery_s" in promised else None, 1.0, 2),
            verdict,
        )


def number_text(value: float | None, factor: float, digits: int) -> str:
    """Return a number as text, multiplied by a factor; `NO_VALUE` for None."""
    return NO_VALUE if value is None else f"{factor * value:.{digits}f}"


class MatrixReport(Redrawn):
    """
    Shows the matrix while it grows.

    Attributes:
        rows: So far.
    """

    def __init__(self, console: Console, count: int) -> None:
        super().__init__(console)
        self.rows: list[MatrixRow] = []
        self._count = count
        self._now = ""  # what happens now, and since when
        self._since_s = self._tell_at_s = time.monotonic()

    @property
    def kept(self) -> bool:
        """Whether every promise was kept so far."""
        return not any(row.broken for row in self.rows)

    @property
    def complete(self) -> bool:
        """Whether each fault has its row."""
        return len(self.rows) == self._count

    def say(self, fault: Fault, text: str) -> None:
        """Show what happens now."""
        self._begin(fault.name, text)
        if self.live:
            head = Table.grid(padding=(0, 2))
            head.add_row(f"{len(self.rows)} of {self._count}", ProgressBar(total=self._count, completed=len(self.rows), width=32), fault.name, text)
            self.draw(Group(self._lines(self.rows[-1:]) if self._narrow() else self._table(), head) if self.rows else head)

    def waiting(self, text: str) -> None:
        """Print a line if a wait has lasted for long; `text` says what is waited for, and after a colon what is missing."""
        name, _, before = self._now.partition(", ")
        if before.partition(":")[0] != text.partition(":")[0]:
            self._begin(name, text)
        self._now = f"{name}, {text}"
        if (now_s := time.monotonic()) >= self._tell_at_s:
            lasted_s = now_s - self._since_s
            self._tell_at_s = now_s + lasted_s
            self.console.print(f"{self._now}, for {lasted_s:.0f} s", soft_wrap=True)

    def _begin(self, name: str, text: str) -> None:
        """Note what happens from now on."""
        self._now = f"{name}, {text}"
        self._since_s = time.monotonic()
        self._tell_at_s = self._since_s + PATIENCE_S

    def add(self, row: MatrixRow) -> None:
        """Add a row; without a terminal, as a line."""
        self.rows.append(row)
        if not self.live:
            said = "; ".join([*row.broken, *row.excused]) or "kept"
            self.console.print(f"{len(self.rows)} of {self._count}: {row.fault.name}, the robot {row.did}: {said}", soft_wrap=True)

    def conclude(self) -> None:
        """Print the whole table, and the broken or excused limits; lines are broken at words where the terminal is too narrow for the table."""
        whole = not self._narrow()
        if whole:
            print_whole(widened(self.console), self._table())
        else:
            self.console.print(self._lines(self.rows))
        for row in self.rows:
            if words := [*row.broken, *row.excused]:
                self.console.print(f"{row.fault.name}: {row.fault.promise.text}: {'; '.join(words)}", soft_wrap=whole)
        if not self.complete:
            self.console.print(f"stopped after {len(self.rows)} of {self._count} faults, in {self._now}", soft_wrap=whole)
        kept = sum(not row.broken for row in self.rows)
        about = machine.machine_info()
        self.console.print(
            f"{kept} of {len(self.rows)} within their promise; robot time at speed 1, {about['processor']}, {about['cores']} cores", soft_wrap=whole
        )

    def _table(self) -> Table:
        table = Table(box=None, padding=(0, 1))
        for name, title in zip(COLUMNS, self._titles(), strict=True):
            table.add_column(title, justify="left" if name in COLUMNS[:2] else "right", no_wrap=True)
        for row in self.rows:
            table.add_row(*(Text(cell, "red" if row.broken else "") for cell in row.cells()))
        return table

    def _titles(self) -> list[str]:
        """Return the headings, each with its unit in a second line."""
        unit = next((row.unit for row in self.rows), "m")
        return [name.replace("mUNIT", "1e-3" if unit == "1" else f"m{unit}").replace("UNIT", unit) for name in COLUMNS]

    def _narrow(self) -> bool:
        """Whether this is a terminal that is too narrow for the table, which would be cut off while it grows, and then wrapped."""
        return self.live and whole_width(self.console, self._table()) > self.console.width

    def _lines(self, rows: Sequence[MatrixRow]) -> Table:
        """Return a line for each value of some rows."""
        lines = Table.grid(padding=(0, 2, 0, 0))
        for row in rows:
            for title, cell in zip(self._titles(), row.cells(), strict=True):
                name, _, unit = title.partition("\n")
                if cell != NO_VALUE:
                    lines.add_row(name, Text(f"{cell} {unit}".rstrip(), "red" if row.broken else ""))
            lines.add_row("", "")
        return lines
