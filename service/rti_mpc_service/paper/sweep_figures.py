# SPDX-License-Identifier: Apache-2.0
"""Figures of what the paper leaves open, and of what lies beyond it; from the JSON of a run alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rti_mpc_service.paper.readings import PRINTED_MM
from rti_mpc_service.paper.sweeps import MISMATCHES

BLUE, ORANGE, GREEN, YELLOW, BLACK = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#000000"
Row = dict[str, Any]
WEIGHT_LABELS = {"consistent": "the paper's weights", "none": "best weights"}


def curve(axes: Axes, rows: Iterable[Row], x: Callable[[Row], float], y: Callable[[Row], float], **look: Any) -> None:
    """Draw one curve through rows."""
    points = [(x(row), y(row)) for row in rows]
    if points:
        axes.plot(*zip(*points, strict=True), **look)


def below(axes: Axes, columns: int = 2) -> None:
    """Put the legend where it covers nothing."""
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=columns)


def readings(figure: Figure, run: Row) -> None:
    """Which heading and which `a` give the paper's 3 mm."""
    for axes, name in zip(figure.subplots(1, 2, sharey=True), ("circle", "eight"), strict=True):
        for heading, color in (("tangent", ORANGE), ("consistent", BLUE), ("none", GREEN)):
            for plant, style in (("euler", "-o"), ("continuous", "--s")):
                chosen = [row for row in run["readings"]["headings"] if (row["trajectory"], row["heading"], row["plant"]) == (name, heading, plant)]
                look: Row = {"color": color, "markersize": 4.5, "label": f"{heading}, {plant} robot"}
                curve(
                    axes,
                    chosen,
                    lambda row: row["a_m"],
                    lambda row: max(row["max_mm"], 1e-4),
                    **look | {"linestyle": style[:-1], "marker": style[-1]},
                )
        axes.axhline(PRINTED_MM, color=BLACK, linewidth=1.0, linestyle=":", label="the paper's 3 mm")
        axes.set(title=name, yscale="log", xlabel="a [m]", ylabel="largest error after 20 s [mm]" if name == "circle" else "")
        below(axes)


def increments(figure: Figure, run: Row) -> None:
    """The weight on increments."""
    left, right = figure.subplots(1, 2)
    for heading, color in (("consistent", BLUE), ("none", YELLOW)):
        for noise, marker, style in ((False, "o", "-"), (True, "s", "--")):
            chosen = [row for row in run["sweeps"]["lambda"] if (row["heading"], row["noise"]) == (heading, noise)]
            title = f"heading {heading}, {'noise' if noise else 'no noise'}"
            look: Row = {"color": color, "marker": marker, "linestyle": style, "markersize": 4.5, "label": title}
            curve(left, chosen, lambda row: row["lambda"], lambda row: row["max_mm"], **look)
            curve(right, chosen, lambda row: row["lambda"], lambda row: row["increment_rms"], **look)
    left.set(title="error", xscale="log", yscale="log", xlabel="λ", ylabel="largest error after 20 s [mm]")
    right.set(title="unrest of the commands", xscale="log", yscale="log", xlabel="λ", ylabel="rms of increments [m/s and rad/s]")
    for axes in (left, right):
        below(axes)


def horizons(figure: Figure, run: Row) -> None:
    """Horizon, control horizon, integrator: error and time."""
    left, middle, right = figure.subplots(1, 3)
    for heading, color in (("consistent", BLUE), ("none", YELLOW)):
        for method, marker, style in (("euler", "s", "--"), ("rk4", "o", "-")):
            chosen = [row for row in run["sweeps"]["N"] if (row["heading"], row["method"]) == (heading, method)]
            look: Row = {"color": color, "marker": marker, "linestyle": style, "markersize": 4.0, "label": f"{WEIGHT_LABELS[heading]}, {method}"}
            curve(left, chosen, lambda row: row["N"], lambda row: row["max_mm"], **look)
            curve(right, chosen, lambda row: row["N"], lambda row: row["wall_us"]["p50"], **look)
        chosen = [row for row in run["sweeps"]["N_u"] if row["heading"] == heading]
        curve(
            middle, chosen, lambda row: row["N_u"], lambda row: row["max_mm"], color=color, marker="o", markersize=4.0, label=WEIGHT_LABELS[heading]
        )
    left.set(title="horizon", xscale="log", yscale="log", xlabel="N", ylabel="largest error after 20 s [mm]")
    middle.set(title="control horizon, N = 20", xscale="log", yscale="log", xlabel="$N_u$", ylabel="largest error after 20 s [mm]")
    right.set(title="time of a solve", xscale="log", yscale="log", xlabel="N", ylabel="median time of a solve [us]")
    for axes in (left, middle, right):
        below(axes, 1)


def periods(figure: Figure, run: Row) -> None:
    """The sampling time: error and time."""
    left, right = figure.subplots(1, 2)
    rows = run["sweeps"]["T0"]
    curve(left, rows, lambda row: 1e3 * row["T0_s"], lambda row: row["max_mm"], color=BLUE, marker="o", label="at the samples")
    curve(
        left, rows, lambda row: 1e3 * row["T0_s"], lambda row: row["between_mm"], color=ORANGE, marker="s", linestyle="--", label="between them, too"
    )
    for share, marker, color in (("p50", "o", BLUE), ("p99", "s", ORANGE)):
        label = {"p50": "median", "p99": "p99"}[share]
        curve(right, rows, lambda row: 1e3 * row["T0_s"], lambda row, s=share: row["wall_us"][s], color=color, marker=marker, label=label)  # type: ignore[misc]
    for part, style in ((1.0, "-"), (0.01, "--")):
        look: Row = {"color": BLACK, "linestyle": style, "linewidth": 1.2, "label": "the period" if part == 1.0 else "1 % of it"}
        curve(right, rows, lambda row: 1e3 * row["T0_s"], lambda row, p=part: 1e6 * p * row["T0_s"], **look)  # type: ignore[misc]
    left.set(title="error", xscale="log", yscale="log", xlabel="sampling time [ms]", ylabel="largest error after 20 s [mm]")
    right.set(title="time of a solve", xscale="log", yscale="log", xlabel="sampling time [ms]", ylabel="[us]")
    for axes in (left, right):
        below(axes)


def mismatch(figure: Figure, run: Row) -> None:
    """A robot that is not the model."""
    for axes, (title, names) in zip(figure.subplots(1, 3, sharey=True), MISMATCHES.items(), strict=True):
        for heading, color, marker in (("consistent", BLUE, "o"), ("none", YELLOW, "s")):
            chosen = [row for row in run["sweeps"]["mismatch"] if row["heading"] == heading and tuple(row["mismatch"]) == names]
            look: Row = {"color": color, "marker": marker, "label": WEIGHT_LABELS[heading]}
            curve(axes, chosen, lambda row: next(iter(row["mismatch"].values())), lambda row: row["max_mm"], **look)
        axes.set(title=f"{title}: {', '.join(names)}", yscale="log", xlabel="the robot's, times the model's")
        below(axes, 1)
    figure.axes[0].set_ylabel("largest error after 20 s [mm]")


SWEEP_FIGURES: dict[str, Callable[[Figure, Row], None]] = {
    "readings": readings,
    "increments": increments,
    "horizons": horizons,
    "periods": periods,
    "mismatch": mismatch,
}
