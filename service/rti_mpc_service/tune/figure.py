# SPDX-License-Identifier: Apache-2.0
"""Figure of a study: error against effort of all trials, and how those of its Pareto front do on the held-out scenario."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rti_mpc.signals import as_label
from rti_mpc_service.rig.figure import COMMAND_COLOR, ERROR_COLOR, LIMIT_COLOR, MEASURED_COLOR, PLOT_STYLE, REFERENCE_COLOR
from rti_mpc_service.tune.closed_loop import Driven
from rti_mpc_service.tune.study import Tried

MAX_DRAWN = 4.0  # times today's error or effort: worse trials are outside the picture

Point = Tried | Driven


def figure(
    path: Path,
    unit: str,
    limit: float,
    studied: tuple[str, Sequence[Tried], Sequence[Tried], Driven, Tried | None],
    held_out: tuple[str, Sequence[Driven], Driven, Driven | None],
) -> None:
    """
    Draw a study.

    Args:
        path: Image to write; its suffix is the format.
        unit: Of the error.
        limit: Effort that is allowed, relative to today's.
        studied: Name of the scenario, all trials, the Pareto front, today's drive, and the chosen trial.
        held_out: Name of the scenario, and on it the trials of the front, today's values, and the chosen ones.
    """
    with mpl.rc_context(PLOT_STYLE):
        page = Figure(figsize=(12.0, 5.4), layout="constrained")
        left, right = page.subplots(1, 2)
        name, trials, front, today, chosen = studied
        _points(left, trials, color=REFERENCE_COLOR, size=3.5, label=f"{len(trials)} trials")
        effort, error = _scaled(front)
        left.step(effort, error, where="pre", color=MEASURED_COLOR, linewidth=1.2, marker="o", markersize=4.5, label="Pareto front")
        _finish(left, f"Studied: {name}", unit, limit, today, chosen, [*front])
        name, drives, today, driven = held_out
        _points(right, drives, color=MEASURED_COLOR, size=4.5, label="the same front")
        _finish(right, f"Held out: {name}", unit, limit, today, driven, drives)
        page.savefig(path, dpi=130)


def _scaled(points: Sequence[Point]) -> tuple[list[float], list[float]]:
    """Return efforts, in percent, and errors."""
    return [100 * point.effort for point in points], [point.error for point in points]


def _points(axes: Axes, points: Sequence[Point], *, color: str, size: float, label: str) -> None:
    axes.plot(*_scaled(points), "o", color=color, markersize=size, label=label)


def _finish(axes: Axes, title: str, unit: str, limit: float, today: Driven, chosen: Point | None, shown: Sequence[Point]) -> None:
    """Mark today's values, the chosen ones and the effort that is allowed, and frame them with the points that must be seen."""
    axes.axvline(100 * limit * today.effort, color=LIMIT_COLOR, linestyle="--", linewidth=1.0, label="effort allowed")
    axes.plot(*_scaled([today]), "D", color=ERROR_COLOR, markersize=8, label="today", zorder=4)
    if chosen is not None:
        axes.plot(*_scaled([chosen]), "*", color=COMMAND_COLOR, markersize=15, markeredgecolor="white", label="chosen", zorder=5)
    for axis, value, values in (
        ("x", 100 * today.effort, [100 * point.effort for point in shown]),
        ("y", today.error, [point.error for point in shown]),
    ):
        seen = np.array([value, *(each for each in values if each <= MAX_DRAWN * value)])
        margin = 0.15 * (np.ptp(seen) or value)
        (axes.set_xlim if axis == "x" else axes.set_ylim)(max(seen.min() - margin, 0.0), seen.max() + 2 * margin)
    axes.set(title=as_label(title), xlabel="effort: rms increment [% of half an input's range]", ylabel=as_label(f"error: rms [{unit}]"))
    axes.legend(loc="best")
