# SPDX-License-Identifier: Apache-2.0
"""Page of a simulated closed loop: its path in the plane, outputs against their reference, inputs between their bounds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rti_mpc import given
from rti_mpc.errors import RtiMpcError
from rti_mpc.rti.simulation import Simulation
from rti_mpc.signals import as_label, plane

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

REFERENCE, DRIVEN, INPUT, BOUND = "#9aa3b2", "#2f6fd0", "#e08a1e", "#c8404a"
PANEL_INCHES = 1.7


def plot(run: Simulation) -> Figure:
    """
    Draw a simulation.

    Returns:
        A figure of matplotlib's, without a window: `savefig` writes it, a notebook shows it.

    Raises:
        RtiMpcError: `run` is none, or matplotlib is not installed.
    """
    model = given.instance("run", run, Simulation).ocp.model
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise RtiMpcError(f"matplotlib must be installed for a plot: pip install 'rti-mpc[figure]', got: {error}") from None
    position = plane(model.outputs)
    panels = model.ny + model.nu
    columns = 1 if position is None else 2
    page = Figure(figsize=(6.5 * columns, max(3.5, PANEL_INCHES * panels)), layout="constrained")
    grid = page.add_gridspec(panels, columns)
    if position is not None:
        draw_path(page.add_subplot(grid[:, 0]), run, position)
    first: Axes | None = None
    for i in range(panels):
        axes = page.add_subplot(grid[i, -1], sharex=first)
        first = first or axes
        axes.grid(color="#dfe3ea", linewidth=0.7)
        axes.tick_params(labelbottom=i == panels - 1)
        if i < model.ny:
            draw_output(axes, run, i)
        else:
            draw_input(axes, run, i - model.ny)
    axes.set_xlabel("time [s]")
    return page


def draw_path(axes: Axes, run: Simulation, position: tuple[int, int]) -> None:
    """Draw the plane, equal axes."""
    axes.plot(*run.y_ref[:, position].T, color=REFERENCE, linewidth=4.0, alpha=0.6, label="reference")
    axes.plot(*run.y[:, position].T, color=DRIVEN, label="driven")
    axes.plot(*run.y[0, list(position)], "o", color=DRIVEN, markerfacecolor="white", label="start")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(title=as_label(run.ocp.model.name), xlabel="x [m]", ylabel="y [m]")
    axes.legend(frameon=False)


def draw_output(axes: Axes, run: Simulation, i: int) -> None:
    """Draw an output and its reference."""
    signal = run.ocp.model.outputs[i]
    axes.plot(run.t, run.y_ref[:, i], color=REFERENCE, linewidth=3.0, alpha=0.6, label="reference")
    axes.plot(run.t, run.y[:, i], color=DRIVEN, label=as_label(signal.name))
    axes.set_ylabel(as_label(f"{signal.name} [{signal.unit}]"))
    axes.legend(frameon=False, ncols=2)


def draw_input(axes: Axes, run: Simulation, i: int) -> None:
    """Draw an input as the steps it is, between its bounds."""
    signal, ocp = run.ocp.model.inputs[i], run.ocp
    for bound in (ocp.widest("lbu")[i], ocp.widest("ubu")[i]):
        if np.isfinite(bound):
            axes.axhline(bound, color=BOUND, linewidth=1.0, linestyle="--")
    axes.step(run.t, np.append(run.u[:, i], run.u[-1, i]), where="post", color=INPUT)
    axes.set_ylabel(as_label(f"{signal.name} [{signal.unit}]"))
