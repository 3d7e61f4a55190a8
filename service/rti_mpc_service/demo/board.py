# SPDX-License-Identifier: Apache-2.0
"""Terminal output of a run: a live table, or lines where there is no terminal, and the summary at the end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rti_mpc.contract.message import Event, Severity, Telemetry
from rti_mpc.model.model import Signal
from rti_mpc.signals import quantity
from rti_mpc_service.redrawn import Redrawn

MEDIAN_SAMPLES = 200  # the shown medians are over the last samples
MAX_SHOWN_EVENTS = 3
MAX_TOLD = 10  # misses, and events, at the end: on a busy host hundreds of lines would hide the summary
PROGRESS_LINES = 10  # per run, where there is no terminal
MISSING_TEXT = "none"
COMMAND_COUNTS = {
    "lost": "The number is missing between those of two others: the command never came, came after a later one or was refused.",
    "late": "It came when its first row was over: the rows that are left act.",
    "expired": "It came when its last row or its validity was over: nothing of it acts.",
    "refused": "It is malformed, not finite, repeated, out of order, from another sender, for another life of the robot or a state still to come: "
    "nothing of it acts.",
}  # what became of commands at the robot, from its start on


class Board(Redrawn):
    """Shows the progress of a run."""

    def __init__(self, console: Console, title: str, inputs: Sequence[Signal], duration_s: float) -> None:
        super().__init__(console)
        self._title = title
        self._inputs = inputs
        self._duration_s = duration_s
        self._said = 0

    def wait(self, text: str) -> None:
        """Show what the run waits for."""
        if self.live:
            self.draw(Text(f"{self._title}: {text}"))
        else:
            self.console.print(text, soft_wrap=True)

    def show(self, time_s: float, error: str, telemetry: Sequence[Telemetry], events: Sequence[Event]) -> None:
        """Show progress, error and phase times; needs at least one sample."""
        rows = self._rows(error, telemetry)
        if self.live:
            table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
            for row in rows.items():
                table.add_row(*row)
            bar = ProgressBar(total=self._duration_s, completed=min(time_s, self._duration_s), width=48)
            news = [Text(event.text, "red" if event.severity is Severity.ERROR else "yellow") for event in events if event.severity]
            head = Table.grid(padding=(0, 2))
            head.add_row(self._title, bar, f"{max(time_s, 0.0):.0f} of {self._duration_s:.0f} s")
            self.draw(Group(head, table, *news[-MAX_SHOWN_EVENTS:]))
        elif time_s >= self._said * self._duration_s / PROGRESS_LINES:
            self._said = int(time_s * PROGRESS_LINES / self._duration_s) + 1
            self.console.print(
                f"{time_s:5.0f} of {self._duration_s:.0f} s: " + ", ".join(f"{name} {text}" for name, text in rows.items()), soft_wrap=True
            )

    def _rows(self, error: str, telemetry: Sequence[Telemetry]) -> dict[str, str]:
        last, recent = telemetry[-1], telemetry[-MEDIAN_SAMPLES:]
        medians = {name: np.median([getattr(sample, name) for sample in recent]) for name in ("prepare_us", "feedback_us")}
        return {
            "mode": last.mode.name.lower(),
            "error": error,
            "command": "  ".join(
                f"{signal.name} {quantity(value, signal.unit, '+.3f')}" for signal, value in zip(self._inputs, last.u[0], strict=True)
            ),
            "preparation": f"{medians['prepare_us']:.0f} us",
            "feedback": f"{medians['feedback_us']:.0f} us",
            "computed in period": f"{np.mean([sample.slack_s >= 0.0 for sample in telemetry]):.2%}",
            "fallbacks": str(last.fallbacks),
        }


def print_summary(console: Console, summary: Mapping[str, Any]) -> None:
    """Print the summary of a run."""
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    rows = [
        (f"error after {summary['transient_s']:g} s", "max {} mm, rms {} mm".format(*number_texts(summary, "max_error_mm", "rms_error_mm"))),
        ("error of the last lap", "max {} mm".format(*number_texts(summary, "last_lap_max_error_mm"))),
        ("at the end", "{} mm from the reference, at {} mm/s".format(*number_texts(summary, "final_error_mm", "final_speed_mm_s"))),
    ]
    if summary["final_error_mm"] is None:  # no path in the plane
        after = f"after {summary['transient_s']:g} s"
        rows = [(f"error of {name} {after}", output_text(error)) for name, error in summary["outputs"].items()]
    if (path := summary["path"]) is not None:
        rows = [("path", path_text(path)), ("nearer edge", f"at least {path['closest_to_edge_mm']:.3g} mm away"), *rows]
    rows = [row for row in rows if MISSING_TEXT not in row[1]]
    samples = summary["samples"] + summary["skipped"]
    rows += [
        ("computed in period", f"{summary['in_period_share']:.2%} of {samples} samples, {summary['skipped']} skipped"),
        ("inputs in bounds", "always" if inputs_in_bounds(summary) else "NOT ALWAYS"),
        ("states over bounds", f"at most {summary['states_over_share']:.2%}"),
        ("fallbacks", f"{summary['fallbacks']} samples without a new plan"),
        ("second opinion", second_opinion_text(summary["second_opinion"])),
        ("commands", ", ".join(f"{summary[name]} {name}" for name in COMMAND_COUNTS)),
    ]
    names = {"prepare_us": "preparation", "feedback_us": "feedback", "latency_us": "state out to command in", "echo_us": "bare echo"}
    rows += [(name, "p50 {p50}, p99 {p99}, max {max} us".format(**summary[key])) for key, name in names.items()]
    for row in rows:
        table.add_row(*row)
    console.print(table)
    misses = [
        "missed its period: the sample at {at_s:.1f} s, by {late:.1f} ms of the robot; "
        "preparation {prepare_us:.0f}, feedback {feedback_us:.0f} us".format(late=-1e3 * miss["slack_s"], **miss)
        for miss in summary["misses"]
    ]
    events = ["{severity} of the {source}{when}: {text}".format(when=when_text(fault["at_s"]), **fault) for fault in summary["events"]]
    for name, lines in {"misses": misses, "events": events}.items():
        for line in lines[:MAX_TOLD]:
            console.print(line, soft_wrap=True)
        if (more := len(lines) - MAX_TOLD) > 0:
            console.print(f"and {more} more {name}, in summary.json", soft_wrap=True)


def when_text(at_s: float) -> str:
    """Return a time of the robot's clock; empty for that of a process that does not know it, such as a recorder, whose stamps are zero."""
    return f" at {at_s:.1f} s" if at_s else ""


def path_text(path: Mapping[str, Any]) -> str:
    """Return how far a robot has driven along a path, and how long that should have taken."""
    laps = f", laps of {', '.join(f'{lap:.2f}' for lap in path['laps_s'])} s" if path["laps_s"] else ""
    return "{driven_m:.1f} m of {length_m:.1f} m{laps}; {profile_s:.1f} s by the speed profile".format(laps=laps, **path)


def second_opinion_text(opinion: Mapping[str, Any]) -> str:
    """Return how many samples OSQP has judged, and how far its plans are from those commanded."""
    if opinion["max_difference"] is None:
        return "none"
    return "{share:.2%} of the samples, at most {max_difference:.1g} of half a range off, p50 {us[p50]}, p99 {us[p99]} us".format(**opinion)


def output_text(error: Mapping[str, Any]) -> str:
    """Return the errors of an output in words."""
    unit = "" if error["unit"] == "1" else f" {error['unit']}"
    return "max {}{unit}, rms {}{unit}".format(*number_texts(error, "max", "rms"), unit=unit)


def number_texts(summary: Mapping[str, Any], *names: str) -> list[str]:
    """Return values as text, `MISSING_TEXT` for those that the run was too short for."""
    return [MISSING_TEXT if summary[name] is None else f"{summary[name]:.3g}" for name in names]


def inputs_in_bounds(summary: Mapping[str, Any]) -> bool:
    """Whether inputs and their increments were inside their bounds."""
    return all(summary[f"{name}_in_bounds"] for name in ("commanded_inputs", "commanded_increments", "applied_inputs"))
