# SPDX-License-Identifier: Apache-2.0
"""Windows of a recording: short runs of measured states without a gap, and the inputs to which its commands led there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, State
from rti_mpc.model.model import Model

WINDOW_S = 0.8  # predicted from one fitted state, whatever the period: drives have delays and lags of tenths of a second
MIN_STEPS, MAX_STEPS = 8, 80  # of a window
MIN_WINDOWS, MAX_WINDOWS = 10, 150
UNITS = 8  # of time, of a window: delays and lags are looked for by them, as they are a few steps of a slow robot and many of a fast one
PARTS = 4  # of a unit, each with the mean of its inputs; a step has one at least
CELLS = 32  # of a unit, each with one input; a part has one at least
ROWS = 8  # of a command at least; a later one acts only after as many commands were lost in turn
ROWS_UNITS = 3  # of time that the rows last at least: one that is delayed acts from a later row on
MAX_GAP = 1.5  # periods between two states of a window
SETTLED_LAGS = 10.0  # before a window, after which the inputs have forgotten how they began: exp(-10)
MAX_UNITS_BEFORE = 100  # likewise, for lags that no robot has


@dataclass(frozen=True, eq=False)
class Windows:
    """
    Windows of a recording; W of them, each of S steps.

    Attributes:
        model: The dynamics, with the plant's parameters.
        x: Measured states, angles unwrapped, shape ``(W, S + 1, nx)``.
        t_s: Their times, shape ``(W, S + 1)``, in s of the robot from the recording's first state.
        step_s: Time from state to state, the median of the recording.
        starts_s: Stamp of each command, and of the state that it answers, shape ``(M, 2)``, likewise.
        rows: First rows of each command, shape ``(M, rows, nu)``.
        row_s: Time between rows.
        range: Range that each state went through, shape ``(nx,)``.
    """

    model: Model
    x: Array
    t_s: Array
    step_s: float
    starts_s: Array
    rows: Array
    row_s: float
    range: Array

    @property
    def steps(self) -> int:
        """Number of steps of each window, S."""
        return int(self.x.shape[1]) - 1

    @property
    def unit_s(self) -> float:
        """Time by which delays and lags are looked for: a step of a slow robot, several of a fast one."""
        return self.steps * self.step_s / UNITS

    @property
    def span_s(self) -> Array:
        """Duration of each step, shape ``(W, S)``."""
        return np.asarray(np.diff(self.t_s, axis=1))

    @property
    def assumed_delay_s(self) -> float:
        """Delay from state to action that the controller assumed; a smaller one cannot be seen."""
        return max(0.0, float(np.median(self.starts_s[:, 0] - self.starts_s[:, 1])))

    def only(self, kept: NDArray[np.bool_]) -> Windows:
        """Return some of the windows, by a mask of shape ``(W,)``."""
        return replace(self, x=self.x[kept], t_s=self.t_s[kept])


def windows_of(model: Model, states: Sequence[State], commands: Sequence[Command], dt_s: float) -> Windows:
    """
    Cut a recording into windows of `WINDOW_S`, shorter if there are few without a gap, and evenly over its time if there are more than `MAX_WINDOWS`.

    Args:
        model: The dynamics, with the plant's parameters.
        states: In order, of one life of the robot. Of states that come faster than samples some are left out.
        commands: In order, of the controller, or of the guard that the robot obeyed.
        dt_s: Period of the controller.
    """
    begin_ns = states[0].stamp_ns
    t = 1e-9 * np.array([state.stamp_ns - begin_ns for state in states])
    every = max(1, round(dt_s / float(np.median(np.diff(t)))))
    t, x = t[::every], np.array([state.x for state in states[::every]])
    model.rotations("states").unwrap(x)
    step_s = float(np.median(np.diff(t)))
    gaps = np.diff(t) > MAX_GAP * step_s
    steps = min(max(round(WINDOW_S / step_s), MIN_STEPS), MAX_STEPS)
    while len(firsts := without_gaps(gaps, steps)) < MIN_WINDOWS and steps > MIN_STEPS:
        steps = max(steps // 2, MIN_STEPS)
    index = firsts[:: max(1, -(-len(firsts) // MAX_WINDOWS)), None] + np.arange(steps + 1)
    row_s = 1e-9 * float(np.median([command.period_ns for command in commands]))
    rows = np.arange(max(ROWS, math.ceil(ROWS_UNITS * steps * step_s / UNITS / row_s)))
    return Windows(
        model,
        x[index],
        t[index],
        step_s,
        1e-9 * np.array([(command.stamp_ns - begin_ns, command.state_stamp_ns - begin_ns) for command in commands]),
        np.array([command.u[np.minimum(rows, len(command.u) - 1)] for command in commands]),
        row_s,
        np.ptp(x, axis=0),
    )


def without_gaps(gaps: NDArray[np.bool_], steps: int) -> NDArray[np.intp]:
    """Return the first state of each window of so many steps that has no gap."""
    return np.array([k for k in range(0, len(gaps) - steps + 1, steps) if not gaps[k : k + steps].any()], np.intp)


def inputs(windows: Windows, delay_s: float, lag_s: float) -> Array:
    """Return the input in each part of each step, shape ``(W, S, parts, nu)``."""
    t, step_s, steps = windows.t_s, windows.step_s, windows.steps
    parts = 1 if windows.model.dt is not None else -(-PARTS * UNITS // steps)  # of a step
    count = parts * -(-CELLS * UNITS // (steps * parts))  # of cells of a step
    before = min(math.ceil(SETTLED_LAGS * lag_s / step_s), round(MAX_UNITS_BEFORE * windows.unit_s / step_s))
    edges = np.concatenate([t[:, :1] - step_s * np.arange(before, 0, -1), t], axis=1)
    cells = edges[:, :-1, None] + np.diff(edges)[:, :, None] * (np.arange(count) + 0.5) / count
    stamps, answered = windows.starts_s.T
    starts = np.maximum.accumulate(np.maximum(stamps, answered + delay_s))
    newest = np.maximum(np.searchsorted(starts, cells.reshape(len(t), -1), side="right") - 1, 0)
    row = np.clip((cells.reshape(newest.shape) - stamps[newest]) / windows.row_s, 0, windows.rows.shape[1] - 1).astype(int)
    v = windows.rows[newest, row]
    if lag_s > 0.0:
        from scipy.signal import lfilter  # here, as it takes longer to import than all the rest

        left = float(np.exp(-step_s / count / lag_s))  # of the difference, after a cell
        ends = lfilter([1.0 - left], [1.0, -left], v, axis=1, zi=left * v[:, :1])[0]
        v = (np.concatenate([v[:, :1], ends[:, :-1]], axis=1) + ends) / 2
    return np.asarray(v[:, before * count :].reshape(len(t), steps, parts, count // parts, -1).mean(axis=3))
