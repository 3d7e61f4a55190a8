# SPDX-License-Identifier: Apache-2.0
"""Figure of a recorded drive and the same one in closed loop: path and distance, or outputs; commands inside their limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rti_mpc.signals import as_label
from rti_mpc_service.rig.figure import COMMAND_COLOR, LIMIT_COLOR, MEASURED_COLOR, MIN_DRAWN_MM, PLOT_STYLE, REFERENCE_COLOR, legend_above
from rti_mpc_service.rig.run_data import Run

COLORS = MEASURED_COLOR, COMMAND_COLOR  # of the recorded drive, and of the closed loop
WIDTHS = 2.6, 1.2  # the later one is drawn on top, and must not hide the other
Panel = Callable[[Axes, Sequence[Run]], None]


def figure(runs: Sequence[Run], path: Path, title: str) -> None:
    """
    Draw two drives.

    Args:
        runs: The recorded one and the closed loop, with what they are called as their scenarios.
        path: Image to write; its suffix is the format.
        title: Of the page.
    """
    info = runs[0].info
    commands: list[Panel] = [partial(_command, i=i) for i in range(len(info.inputs))]
    outputs: list[Panel] = [partial(_output, i=i) for i in range(len(info.outputs))]
    planar = runs[0].planar
    columns: list[list[Panel]] = [[_path], [_distance, *commands]] if planar else [outputs, commands]
    with mpl.rc_context(PLOT_STYLE):
        page = Figure(figsize=(13.0, max(6.0, 1.9 * max(map(len, columns)))), layout="constrained")
        page.suptitle(as_label(title), x=0.01, ha="left", fontsize=12)
        halves = page.add_gridspec(1, 2, width_ratios=[1.0, 1.15])
        for half, panels in enumerate(columns):
            grid = halves[half].subgridspec(len(panels), 1)
            for k, draw in enumerate(panels):
                axes = page.add_subplot(grid[k, 0])
                draw(axes, runs)
                if draw is not _path:
                    axes.set_xlim(0.0, runs[0].time_s[-1])
                    axes.tick_params(labelbottom=k == len(panels) - 1)
                    axes.set_xlabel("time since the first state [s]" if k == len(panels) - 1 else "")
            if half or not planar:
                legend_above(page.axes[-len(panels)])
        page.savefig(path, dpi=130)


def _times(run: Run, runs: Sequence[Run]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the times of a drive on the axis of the first one."""
    return np.asarray(1e-9 * (run.stamp_ns - runs[0].stamp_ns[0]))


def _path(axes: Axes, runs: Sequence[Run]) -> None:
    axes.plot(*runs[0].path.T, color=REFERENCE_COLOR, linewidth=6.0, alpha=0.5, solid_capstyle="round", label="reference")
    for run, color, width in zip(runs, COLORS, WIDTHS, strict=True):
        axes.plot(*run.position.T, color=color, linewidth=width, label=as_label(run.scenario))
    axes.plot(*runs[0].position[0], "o", color=MEASURED_COLOR, markerfacecolor="white", zorder=4, label="begin")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set(title="Path", xlabel="x [m]", ylabel="y [m]")
    axes.legend(loc="upper center", ncols=4, bbox_to_anchor=(0.5, -0.07))


def _distance(axes: Axes, runs: Sequence[Run]) -> None:
    for run, color, width in zip(runs, COLORS, WIDTHS, strict=True):
        axes.semilogy(_times(run, runs), np.maximum(run.error_mm, MIN_DRAWN_MM), color=color, linewidth=width, label=as_label(run.scenario))
    axes.set(title="Tracking error", ylabel="distance [mm]")


def _output(axes: Axes, runs: Sequence[Run], i: int) -> None:
    label = runs[0].info.outputs[i]
    axes.plot(_times(runs[0], runs), runs[0].reference[:, i], color=REFERENCE_COLOR, linewidth=6.0, alpha=0.5, label="reference")
    for run, color, width in zip(runs, COLORS, WIDTHS, strict=True):
        axes.plot(_times(run, runs), run.reference[:, i] + run.output_error[:, i], color=color, linewidth=width, label=as_label(run.scenario))
    axes.set(title=f"Output {as_label(label.name)}", ylabel=f"[{as_label(label.unit)}]")


def _command(axes: Axes, runs: Sequence[Run], i: int) -> None:
    info = runs[0].info
    for bound in (info.lbu[i], info.ubu[i]):
        if np.isfinite(bound):
            axes.axhline(bound, color=LIMIT_COLOR, linewidth=1.0, linestyle="--")
    for run, color, width in zip(runs, COLORS, WIDTHS, strict=True):
        axes.step(_times(run, runs), run.u_applied[:, i], where="post", color=color, linewidth=width, label=as_label(run.scenario))
    axes.margins(y=0.12)
    axes.set(title=f"Command {as_label(info.inputs[i].name)}", ylabel=f"[{as_label(info.inputs[i].unit)}]")
