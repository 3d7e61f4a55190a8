# SPDX-License-Identifier: Apache-2.0
"""The report of a run: report.md beside this file, filled with numbers of its JSON and with nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

TEMPLATE = Path(__file__).with_name("report.md")
Row = dict[str, Any]

# What the paper prints of its own runs: largest error in mm, and the share of solves inside the sampling time.
PRINTED_IN_PAPER: dict[str, dict[str, Row]] = {
    "eight": {"sequential": {"max_mm": 3, "inside_period": 0.97}, "simultaneous": {"max_mm": 3, "inside_period": 0.72}},
    "positioning": {"sequential": {"inside_period": 0.93}, "simultaneous": {"inside_period": 0.81}},
}
CONTENDER_TITLES = {
    "slsqp_sequential": "the paper's sequential, SLSQP, finite differences",
    "slsqp_simultaneous": "the paper's simultaneous, SLSQP, analytic gradients",
    "ipopt": "converged NMPC, IPOPT",
    "osqp_sequential": "real-time iteration, sequential, OSQP",
    "osqp_simultaneous": "real-time iteration, simultaneous, OSQP",
    "rti_sequential": "real-time iteration, sequential, default solver",
    "rti_simultaneous": "real-time iteration, simultaneous, default solver",
    "best": "real-time iteration, best settings",
}
MISMATCH_TITLES = {"theta_1": "inertia (theta_1, theta_2)", "theta_4": "friction (theta_4, theta_6)", "a": "offset a"}
WEIGHT_TITLES = {"consistent": "the paper's", "none": "best"}
Column = tuple[str, Callable[[Row], str]]


def report(run: Row) -> str:
    """Return the report of a run, Markdown."""
    tables = {name: make(run) for name, make in TABLES.items()}
    return TEMPLATE.read_text(encoding="utf-8").format(run=run, tables=tables, took_min=run["took_s"] / 60.0)


def table(rows: Iterable[Row], columns: Sequence[Column]) -> str:
    """Return rows as a Markdown table."""
    lines = [[title for title, _ in columns], ["---"] * len(columns), *([cell(row) for _, cell in columns] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number_cell(key: str, digits: int = 3) -> Callable[[Row], str]:
    """Return a cell of significant digits."""
    return lambda row: f"{row[key]:.{digits}g}"


def percent_cell(key: str) -> Callable[[Row], str]:
    """Return a cell of percent."""
    return lambda row: percent(row[key])


def percent(value: float) -> str:
    """Return a share; 100 % is said only of all."""
    return f"{100.0 * value:.4g} %" if value < 1.0 else "100 %"


def quantiles_cell(key: str, unit_us: float) -> Callable[[Row], str]:
    """Return a cell of median, p99 and maximum."""
    return lambda row: " / ".join(f"{row[key][name] / unit_us:.3g}" for name in ("p50", "p99", "max"))


WALL_TIME_COLUMN: Column = ("time of a solve, us, p50 / p99 / max", quantiles_cell("wall_us", 1.0))
MAX_ERROR_COLUMN: Column = ("largest error, mm", number_cell("max_mm"))


def headline(scenario: str) -> Callable[[Row], str]:
    """Return the maker of the table beside the paper's own figures."""

    def make(run: Row) -> str:
        columns: Sequence[Column] = (
            ("", lambda row: row["name"]),
            MAX_ERROR_COLUMN,
            ("between samples, mm", number_cell("between_mm")),
            ("error at the end, mm", number_cell("end_mm")),
            ("speed at the end, mm/s", number_cell("end_speed_mm_s", 2)),
            ("cost", lambda row: "-" if row["name"] == CONTENDER_TITLES["best"] else f"{row['cost']:.5g}"),
            ("wall time of a solve, ms, p50 / p99 / max", quantiles_cell("wall_us", 1e3)),
            ("CPU time, ms, p50 / p99 / max", quantiles_cell("cpu_us", 1e3)),
            ("inside T0", percent_cell("inside_period")),
            ("inside 1 % of T0, wall", percent_cell("inside_percent_wall")),
            ("inside 1 % of T0, CPU", percent_cell("inside_percent_cpu")),
        )
        printed = []
        for formulation, row in PRINTED_IN_PAPER[scenario].items():
            cells = ["-"] * len(columns)
            cells[0], cells[8] = f"*printed in the paper, {formulation}*", percent(row["inside_period"])
            cells[1] = str(row.get("max_mm", "-"))
            printed.append(f"| {' | '.join(cells)} |")
        ours = table(({"name": title} | run["race"][scenario][name] for name, title in CONTENDER_TITLES.items()), columns).split("\n")
        return "\n".join([*ours[:2], *printed, *ours[2:]])

    return make


def short(run: Row) -> str:
    """Return the figures of both experiments in one small table, Markdown."""
    eight, positioning = run["race"]["eight"], run["race"]["positioning"]
    chosen = ("slsqp_sequential", "slsqp_simultaneous", "ipopt", "rti_simultaneous", "best")
    rows = [{"name": CONTENDER_TITLES[name], "eight": eight[name], "positioning": positioning[name]} for name in chosen]
    columns: Sequence[Column] = (
        ("", lambda row: row["name"]),
        ("eight, largest error, mm", lambda row: f"{row['eight']['max_mm']:.3g}"),
        ("positioning, error at the end, mm", lambda row: f"{row['positioning']['end_mm']:.2g}"),
        ("time of a solve, ms, p50 / p99", lambda row: f"{1e-3 * row['eight']['wall_us']['p50']:.2g} / {1e-3 * row['eight']['wall_us']['p99']:.2g}"),
        ("inside T0", lambda row: f"{percent(row['eight']['inside_period'])}, {percent(row['positioning']['inside_period'])}"),
        (
            "CPU time inside 1 % of T0",
            lambda row: f"{percent(row['eight']['inside_percent_cpu'])}, {percent(row['positioning']['inside_percent_cpu'])}",
        ),
    )
    return table(rows, columns)


def headings(run: Row) -> str:
    """Return the readings of the first experiment."""
    columns: Sequence[Column] = (
        ("curve", lambda row: row["trajectory"]),
        ("heading", lambda row: row["heading"]),
        ("a, m", number_cell("a_m")),
        ("robot", lambda row: row["plant"]),
        MAX_ERROR_COLUMN,
        ("squared, m²", number_cell("max_squared_m2", 2)),
        ("error at the end, mm", number_cell("end_mm")),
    )
    return table(run["readings"]["headings"], columns)


def converged(run: Row) -> str:
    """Return the readings judged by converged NMPC."""
    columns: Sequence[Column] = (
        ("curve", lambda row: row["trajectory"]),
        ("heading", lambda row: row["heading"]),
        ("robot", lambda row: row["plant"]),
        ("largest error, converged NMPC, mm", number_cell("max_mm")),
        ("squared, m²", number_cell("max_squared_m2", 2)),
    )
    return table(run["readings"]["converged"], columns)


def speeds(run: Row) -> str:
    """Return the speeds of the references."""
    rows = ({"name": name} | row for name, row in run["readings"]["speeds"].items())
    return table(rows, (("reference", lambda row: row["name"]), *((f"{key}, m/s", number_cell(key)) for key in ("min", "mean", "max"))))


def at_printed_speed(run: Row) -> str:
    """Return the errors at the speed that is printed."""
    rows = run["readings"]["at_printed_speed"]
    columns: Sequence[Column] = (
        ("curve", lambda row: row["trajectory"]),
        ("mean speed, m/s", number_cell("mean_speed_m_s")),
        ("weights", lambda row: WEIGHT_TITLES[row["heading"]]),
        ("integrator", lambda row: row["method"]),
        MAX_ERROR_COLUMN,
    )
    return table(rows, columns)


def goals(run: Row) -> str:
    """Return both ends the second reference may have."""
    rows = ({"name": name} | row for name, row in run["readings"]["goals"].items())
    columns: Sequence[Column] = (
        ("end", lambda row: {"continuous": "(-r √2, -r √2/2)", "jumping": "(-r √2, -r √2)"}[row["name"]]),
        ("jump of the reference, mm", number_cell("jump_mm")),
        ("error at the end, mm", number_cell("end_mm")),
    )
    return table(rows, columns)


def increments(run: Row) -> str:
    """Return the sweep of the weight on increments."""
    columns: Sequence[Column] = (
        ("λ", number_cell("lambda")),
        ("heading", lambda row: row["heading"]),
        ("noise", lambda row: "yes" if row["noise"] else "no"),
        MAX_ERROR_COLUMN,
        ("rms of increments", number_cell("increment_rms")),
        WALL_TIME_COLUMN,
    )
    return table(run["sweeps"]["lambda"], columns)


def horizons(name: str) -> Callable[[Row], str]:
    """Return the maker of the table of a sweep of a horizon."""

    def make(run: Row) -> str:
        columns: Sequence[Column] = (
            ("N", number_cell("N")),
            ("N_u", number_cell("N_u")),
            ("weights", lambda row: WEIGHT_TITLES[row["heading"]]),
            ("integrator", lambda row: row["method"]),
            MAX_ERROR_COLUMN,
            WALL_TIME_COLUMN,
        )
        return table(run["sweeps"][name], columns)

    return make


def periods(run: Row) -> str:
    """Return the sweep of the sampling time."""
    columns: Sequence[Column] = (
        ("T0, ms", lambda row: f"{1e3 * row['T0_s']:.3g}"),
        MAX_ERROR_COLUMN,
        ("between samples, mm", number_cell("between_mm")),
        WALL_TIME_COLUMN,
        ("CPU time, us, p50 / p99 / max", quantiles_cell("cpu_us", 1.0)),
        ("inside T0", percent_cell("inside_period")),
    )
    return table(run["sweeps"]["T0"], columns)


def mismatch(run: Row) -> str:
    """Return the sweep of the robot's parameters."""
    columns: Sequence[Column] = (
        ("the robot's", lambda row: MISMATCH_TITLES[next(iter(row["mismatch"]))]),
        ("times the model's", lambda row: f"{next(iter(row['mismatch'].values())):.3g}"),
        ("weights", lambda row: WEIGHT_TITLES[row["heading"]]),
        MAX_ERROR_COLUMN,
    )
    return table(run["sweeps"]["mismatch"], columns)


TABLES: dict[str, Callable[[Row], str]] = {
    "eight": headline("eight"),
    "positioning": headline("positioning"),
    "headings": headings,
    "converged": converged,
    "speeds": speeds,
    "at_printed_speed": at_printed_speed,
    "goals": goals,
    "increments": increments,
    "N": horizons("N"),
    "N_u": horizons("N_u"),
    "periods": periods,
    "mismatch": mismatch,
}
