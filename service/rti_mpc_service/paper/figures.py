# SPDX-License-Identifier: Apache-2.0
"""The paper's figures 3 to 10 as they come out here, and those of what is open and beyond; colours that the colour-blind tell apart."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rti_mpc.array import Array
from rti_mpc_service.paper.experiment import INPUT_LIMITS
from rti_mpc_service.paper.loop import Loop
from rti_mpc_service.paper.sweep_figures import SWEEP_FIGURES
from rti_mpc_service.rig.figure import PLOT_STYLE

Loops = dict[str, Loop]

# Okabe and Ito's palette.
REFERENCE_COLOR, LIMIT_COLOR = "#9aa3b2", "#000000"
COLORS = {
    "slsqp_sequential": "#D55E00",
    "slsqp_simultaneous": "#D55E00",
    "ipopt": "#009E73",
    "osqp_sequential": "#CC79A7",
    "osqp_simultaneous": "#CC79A7",
    "rti_sequential": "#0072B2",
    "rti_simultaneous": "#0072B2",
    "best": "#E69F00",
}
NAMES = {
    "slsqp_sequential": "the paper's sequential (SLSQP)",
    "slsqp_simultaneous": "the paper's simultaneous (SLSQP)",
    "ipopt": "converged (IPOPT)",
    "osqp_sequential": "real-time iteration, OSQP",
    "osqp_simultaneous": "real-time iteration, OSQP",
    "rti_sequential": "real-time iteration",
    "rti_simultaneous": "real-time iteration",
    "best": "real-time iteration, best settings",
}
SHOWN_CONTENDERS = ("slsqp_sequential", "ipopt", "rti_simultaneous", "best")
STYLES = {"slsqp_sequential": "-", "ipopt": "--", "rti_simultaneous": ":", "best": "-"}
WIDTHS = {"slsqp_sequential": 3.2, "ipopt": 2.2, "rti_simultaneous": 2.2, "best": 1.2}
MIN_DRAWN_M2 = 1e-20  # smaller values are drawn as this: a logarithmic axis has no zero
DPI = 110


def draw(races: dict[str, Loops], run: dict[str, Any], folder: Path) -> None:
    """Write every figure of the report into a folder."""
    for scenario, loops in races.items():
        for name, paint in RACE_FIGURES.items():
            page(folder / f"{scenario}_{name}.png", paint, loops)
    for name, paint in SWEEP_FIGURES.items():
        page(folder / f"{name}.png", paint, run)


def page(path: Path, paint: Callable[[Figure, Any], None], content: Any) -> None:
    """Write one figure."""
    with mpl.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(9.6, 4.6), layout="constrained")
        paint(figure, content)
        figure.savefig(path, dpi=DPI, metadata={"Software": None})


def paths(figure: Figure, loops: Loops) -> None:
    """Figures 3 and 7: the trajectory, and the way to it enlarged."""
    whole, start = figure.subplots(1, 2)
    experiment = loops["best"].experiment
    reference = experiment.trajectory.position(np.linspace(0.0, experiment.trajectory.duration_s, 2000))
    for axes in (whole, start):
        axes.plot(*reference.T, color=REFERENCE_COLOR, linewidth=5.0, alpha=0.5, label="reference")
        for name in SHOWN_CONTENDERS:
            axes.plot(*loops[name].x[:, :2].T, STYLES[name], color=COLORS[name], linewidth=WIDTHS[name], label=NAMES[name])
        axes.plot(*experiment.x0[:2], "o", color=LIMIT_COLOR, markerfacecolor="white", markersize=7, zorder=5, label="start")
        axes.set(xlabel="x [m]", ylabel="y [m]")
        axes.set_aspect("equal", adjustable="box")
    near = np.vstack([loops[name].x[:61, :2] for name in SHOWN_CONTENDERS])
    start.set(xlim=(near[:, 0].min() - 0.08, near[:, 0].max() + 0.08), ylim=(near[:, 1].min() - 0.08, near[:, 1].max() + 0.08))
    start.set_title("the first 6 s")
    whole.set_title("the whole trajectory")
    figure.legend(*whole.get_legend_handles_labels(), loc="outside lower center", ncols=3)


def states(figure: Figure, loops: Loops) -> None:
    """Figures 4 and 8: position and quadratic error."""
    left, right = figure.subplots(1, 2)
    loop = loops["rti_simultaneous"]
    reference = loop.experiment.trajectory.position(loop.t)
    for i, (letter, color) in enumerate((("x", "#0072B2"), ("y", "#D55E00"))):
        left.plot(loop.t, reference[:, i], color=REFERENCE_COLOR, linewidth=5.0, alpha=0.5, label=f"{letter}, reference")
        left.plot(loop.t, loop.x[1:, i], color=color, label=f"{letter}, real-time iteration")
    left.set(title="(a) position, the paper's settings", xlabel="time [s]", ylabel="[m]")
    left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    for name in SHOWN_CONTENDERS:
        squared = np.maximum((1e-3 * loops[name].error_mm) ** 2, MIN_DRAWN_M2)
        right.semilogy(loops[name].t, squared, STYLES[name], color=COLORS[name], linewidth=min(WIDTHS[name], 2.2), label=NAMES[name])
    right.set(title="(b) quadratic error of the position", xlabel="time [s]", ylabel="[m²]")
    right.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)


def speeds(figure: Figure, loops: Loops) -> None:
    """Figures 5 and 9: commands against real speeds."""
    loop = loops["rti_simultaneous"]
    for i, (axes, letter, speed, unit) in enumerate(zip(figure.subplots(1, 2), ("u", "ω"), ("linear", "angular"), ("m/s", "rad/s"), strict=True)):
        for sign in (-1.0, 1.0):
            axes.axhline(sign * INPUT_LIMITS[i], color=LIMIT_COLOR, linewidth=1.0, linestyle="--", label="limits" if sign > 0 else None)
        axes.step(loop.t, loop.u[:, i], where="pre", color="#E69F00", linewidth=2.4, label=f"command {letter}_c")
        axes.plot(loop.t, loop.x[1:, 3 + i], color="#0072B2", linewidth=1.2, label=f"real speed {letter}")
        axes.set(title=f"({'ab'[i]}) {speed} speed", xlabel="time [s]", ylabel=f"[{unit}]")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3)


def times(figure: Figure, loops: Loops) -> None:
    """Figures 6 and 10: execution time at each sampling instant."""
    both: Array = figure.subplots(1, 2, sharey=True)
    for axes, formulation, letter in zip(both, ("sequential", "simultaneous"), "ab", strict=True):
        _times(axes, loops, [f"slsqp_{formulation}", *(["ipopt"] if letter == "b" else []), f"osqp_{formulation}", f"rti_{formulation}"])
        period_ms = 1e3 * loops["best"].experiment.T0
        axes.axhline(period_ms, color=LIMIT_COLOR, linewidth=1.3, label="sampling time")
        axes.axhline(0.01 * period_ms, color=LIMIT_COLOR, linewidth=1.3, linestyle="--", label="1 % of it")
        axes.set(title=f"({letter}) {formulation}", xlabel="time [s]")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    both[0].set_ylabel("execution time [ms]")


def _times(axes: Axes, loops: Loops, names: list[str]) -> None:
    """Draw the times of some contenders."""
    for name in names:
        axes.semilogy(loops[name].t, 1e-3 * loops[name].wall_us, ".", markersize=2.5, color=COLORS[name])
        axes.plot([], [], "o", markersize=5, color=COLORS[name], label=NAMES[name])


RACE_FIGURES: dict[str, Callable[[Figure, Loops], None]] = {"path": paths, "states": states, "speeds": speeds, "times": times}
