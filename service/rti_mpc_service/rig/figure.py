# SPDX-License-Identifier: Apache-2.0
"""A run on one page: path and tracking error, or outputs against references; commands against their limits, phase times against the period."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import SubplotSpec
from matplotlib.patches import Circle

from rti_mpc.array import Array
from rti_mpc.signals import as_label, plane
from rti_mpc_service.outline import outline, placed
from rti_mpc_service.rig.run_data import Run

INK_COLOR, GRID_COLOR, SHADE_COLOR = "#2b303b", "#dfe3ea", "#e6eaf2"
REFERENCE_COLOR, MEASURED_COLOR, COMMAND_COLOR, LIMIT_COLOR, ERROR_COLOR = "#9aa3b2", "#2f6fd0", "#e08a1e", "#c8404a", "#b8377e"
PHASE_COLORS = {"prepare": "#4c9f6b", "feedback": "#e08a1e", "latency": "#7a5cc9"}
PATH_PANELS = 3  # outputs over time whose height a path in the plane takes above them
MIN_DRAWN_MM = 1e-4  # smaller errors are drawn as this: a logarithmic axis has no zero
PLOT_STYLE: Any = {
    "font.size": 9.5,
    "font.family": "DejaVu Sans",
    "axes.edgecolor": "#b4bac6",
    "axes.labelcolor": INK_COLOR,
    "axes.titlecolor": INK_COLOR,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID_COLOR,
    "grid.linewidth": 0.7,
    "xtick.color": INK_COLOR,
    "ytick.color": INK_COLOR,
    "lines.linewidth": 1.5,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}


def figure(run: Run, path: Path) -> None:
    """
    Draw a run: its path in the plane, or each output against its reference.

    Args:
        run: At least one state and one sample.
        path: Image to write; its suffix is the format.
    """
    nu, ny = len(run.info.inputs), len(run.info.outputs)
    panels: list[Callable[[Axes, Run], None]] = [*(partial(_command, i=i) for i in range(nu)), _phases]
    if run.planar:
        panels = [_error, *panels]
    with mpl.rc_context(PLOT_STYLE):
        below = 0 if run.planar else ny
        above = PATH_PANELS if not run.planar and (run.along is not None or plane(run.info.outputs) is not None) else 0
        page = Figure(figsize=(13.0, max(7.6, 1.8 * len(panels), 1.8 * (above + below))), layout="constrained")
        halves = page.add_gridspec(1, 2, width_ratios=[1.0, 1.15])
        left = halves[0].subgridspec(above + below, 1) if above else None
        if run.planar or left is not None:
            _path(page.add_subplot(halves[0] if left is None else left[:above, 0]), run)
        if below:
            _stack(page, halves[0] if left is None else left[above:, 0], run, [partial(_output, i=i) for i in range(ny)])
        _stack(page, halves[1], run, panels)
        page.savefig(path, dpi=130)


def _stack(page: Figure, place: SubplotSpec, run: Run, panels: Sequence[Callable[[Axes, Run], None]]) -> None:
    """Draw panels over one axis of time, one below the other; a logarithmic one is higher."""
    grid = place.subgridspec(len(panels), 1, height_ratios=[1.3 if draw in (_error, _phases) else 1.0 for draw in panels])
    first: Axes | None = None
    for k, draw in enumerate(panels):
        axes = page.add_subplot(grid[k, 0], sharex=first)
        first = first or axes
        draw(axes, run)
        axes.tick_params(labelbottom=k == len(panels) - 1)
    axes.set_xlabel("robot time [s]")
    axes.set_xlim(0.0, run.time_s[-1])


def _path(axes: Axes, run: Run) -> None:
    """Draw the plane, equal axes, with the robot where it started and where it ended."""
    for edge in [] if run.along is None else run.along.edges:
        axes.plot(*edge.T, color=INK_COLOR, linewidth=1.0)
    wanted = "reference" if run.along is None else "path"
    axes.plot(*run.path.T, color=REFERENCE_COLOR, linewidth=5.0, alpha=0.55, solid_capstyle="round", label=wanted)
    axes.plot(*run.position.T, color=MEASURED_COLOR, label="robot, true position")
    if run.info.heading is not None:
        for row, alpha in ((0, 0.5), (-1, 1.0)):
            pose = (*run.position[row], run.x[row, run.info.heading])
            for polygon in outline(run.info.model):
                axes.fill(*placed(polygon, *pose).T, facecolor=SHADE_COLOR, edgecolor=INK_COLOR, linewidth=1.0, alpha=alpha, zorder=1)
    for i, disc in enumerate(run.discs):
        _obstacle(axes, run, disc, "" if i else "obstacle, when nearest")
    axes.plot(*run.position[0], "o", color=MEASURED_COLOR, markerfacecolor="white", zorder=4, label="start")
    axes.plot(*run.position[-1], "o", color=MEASURED_COLOR, zorder=4, label="end")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set(title=as_label(f"Path: {run.scenario}"), xlabel="x [m]", ylabel="y [m]")
    axes.legend(loc="upper center", ncols=4, bbox_to_anchor=(0.5, -0.07))


def _obstacle(axes: Axes, run: Run, disc: Array, label: str) -> None:
    """Draw a disc where the robot came nearest to it, and the way of its centre, dotted."""
    x, y, radius = disc[np.argmin(np.hypot(*(run.position - disc[:, :2]).T) - disc[:, 2])]
    axes.plot(*disc[:, :2].T, color=LIMIT_COLOR, linewidth=1.0, linestyle=":")
    axes.add_patch(Circle((x, y), radius, facecolor=SHADE_COLOR, edgecolor=LIMIT_COLOR, linewidth=1.0, zorder=1, label=label))


def _error(axes: Axes, run: Run) -> None:
    """Draw the error on a logarithmic scale, which shows transient and steady tracking alike."""
    axes.axvspan(0.0, min(run.transient_s, run.time_s[-1]), color=SHADE_COLOR, label="transient")
    axes.semilogy(run.time_s, np.maximum(run.error_mm, MIN_DRAWN_MM), color=ERROR_COLOR, linewidth=1.2)
    settled = run.error_mm[run.settled]
    if settled.size:
        label = f"after the transient: max {settled.max():.3g} mm, rms {np.sqrt((settled**2).mean()):.3g} mm"
        axes.axhline(settled.max(), color=ERROR_COLOR, linewidth=0.9, linestyle="--", label=label)
    axes.set(title="Tracking error", ylabel="distance [mm]")
    legend_above(axes)


def _output(axes: Axes, run: Run, i: int) -> None:
    """Draw an output against its reference, and say how far it is from it after the transient."""
    label, settled = run.info.outputs[i], np.abs(run.output_error[run.settled, i])
    axes.axvspan(0.0, min(run.transient_s, run.time_s[-1]), color=SHADE_COLOR)
    axes.plot(run.time_s, run.reference[:, i], color=REFERENCE_COLOR, linewidth=5.0, alpha=0.55, solid_capstyle="round", label="reference")
    said = f", then within {settled.max():.3g}" if settled.size else ""
    axes.plot(run.time_s, run.reference[:, i] + run.output_error[:, i], color=MEASURED_COLOR, label=f"true{said}")
    axes.margins(y=0.12)
    axes.set(title=as_label(f"Output {label.name}" if i else f"Output {label.name}: {run.scenario}"), ylabel=as_label(f"[{label.unit}]"))
    legend_above(axes)


def _command(axes: Axes, run: Run, i: int) -> None:
    """Draw an input as the steps it is, between its limits, and the speed it is about."""
    label, measured = run.info.inputs[i], run.info.measured(i)
    for bound in (run.info.lbu[i], run.info.ubu[i]):
        if np.isfinite(bound):
            axes.axhline(bound, color=LIMIT_COLOR, linewidth=1.0, linestyle="--")
    axes.step(run.time_s, run.u_applied[:, i], where="post", color=COMMAND_COLOR, label=as_label(f"{label.name}, applied"))
    if measured is not None:
        axes.plot(run.time_s, run.x[:, measured], color=MEASURED_COLOR, linewidth=1.2, label=as_label(f"{run.info.states[measured].name}, true"))
    axes.plot([], [], color=LIMIT_COLOR, linewidth=1.0, linestyle="--", label="limits")
    axes.margins(y=0.12)
    axes.set(title=as_label(f"Command {label.name}"), ylabel=as_label(f"[{label.unit}]"))
    legend_above(axes)


def _phases(axes: Axes, run: Run) -> None:
    """Draw phase times on a logarithmic scale, for the period is far away."""
    for name, color in PHASE_COLORS.items():
        values = getattr(run, f"{name}_us")
        median, p99 = np.percentile(values, [50, 99])
        label = f"{name}: median {median:.0f}, p99 {p99:.0f} us"
        axes.semilogy(run.sample_time_s, values, ".", color=color, markersize=2.2, alpha=0.6)
        axes.plot([], [], "o", color=color, markersize=4, label=label)
        axes.axhline(median, color=color, linewidth=0.9)
        axes.axhline(p99, color=color, linewidth=0.9, linestyle=":")
    axes.axhline(run.period_us, color=LIMIT_COLOR, linewidth=1.2, linestyle="--", label=f"period at speed {run.speed:g}: {run.period_us:.0f} us")
    axes.set(title="Phase times (lines: median, dotted p99)", ylabel="[us]", ylim=(None, 30 * run.period_us))
    axes.legend(loc="upper right", ncols=2)


def legend_above(axes: Axes) -> None:
    """Put the legend beside the title, where it covers nothing."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3, borderaxespad=0.0, borderpad=0.2)
