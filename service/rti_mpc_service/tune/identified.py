# SPDX-License-Identifier: Apache-2.0
r"""
Delay, lag of the inputs and measurement noise of a robot, identified from its recording and its model.

With a delay D and a lag T the commands lead to the inputs :math:`\dot v = (u(t; D) - v) / T`. D and T
are those with which the model predicts windows of `WINDOW` states with the least error. The first state
of each window is fitted as well: the commands answer its noise, which would look like their effect otherwise.
A value counts only if it is better than none by more than noise explains.

Noise follows from the errors of single steps, :math:`e_k = x_{k+1} - \phi(x_k, v_k) = n_{k+1} - A_k n_k + w_k`.
Their second differences remove what changes slowly, such as the effect of a wrong parameter. For a state that keeps itself,
A = 1, they are the third differences of what was measured, less what the model explains, with the variance :math:`20 \sigma^2`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, nnls
from scipy.signal import lfilter

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, State
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import Model

WINDOW = 8  # steps that are predicted from one fitted state
MIN_WINDOWS, MAX_WINDOWS = 10, 150
PARTS = 4  # of a step, each with the mean of its inputs
CELLS = 32  # of a step, each with one input
ROWS = 8  # of a command; a later one acts only after as many commands were lost in turn
MAX_GAP = 1.5  # periods between two states of a window
DELAYS = np.arange(7) / 4  # periods beyond the delay that the controller assumed, from which the fit begins
LAGS = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 4.0])  # periods, likewise
MIN_ADVANTAGE = 12.0  # of twice the log-likelihood: noise alone would have to be 3.5 sigma
NEGLIGIBLE = 1e-5  # error, relative to the range that the state went through
TINY = 1e-12  # in the unit of a state, of one that does not move at all


@dataclass(frozen=True, eq=False)
class Windows:
    """
    Windows of a recording; W of them, each of `WINDOW` steps.

    Attributes:
        model: The dynamics, with the plant's parameters.
        x: Measured states, angles unwrapped, shape ``(W, WINDOW + 1, nx)``.
        index: Number of each step in the recording, shape ``(W, WINDOW)``.
        t_s: Time of every state of the recording, shape ``(K + 1,)``, in s of the robot from its first one.
        starts_s: Stamp of each command, and of the state that it answers, shape ``(M, 2)``, likewise.
        rows: First rows of each command, shape ``(M, ROWS, nu)``.
        row_s: Time between rows.
        range: Range that each state went through, shape ``(nx,)``.
    """

    model: Model
    x: Array
    index: NDArray[np.intp]
    t_s: Array
    starts_s: Array
    rows: Array
    row_s: float
    range: Array

    @property
    def step_s(self) -> float:
        """Time from state to state."""
        return float(np.median(np.diff(self.t_s)))

    @property
    def assumed_delay_s(self) -> float:
        """Delay from state to action that the controller assumed; a smaller one cannot be seen."""
        return max(0.0, float(np.median(self.starts_s[:, 0] - self.starts_s[:, 1])))


def windows_of(model: Model, states: Sequence[State], commands: Sequence[Command], dt_s: float) -> Windows:
    """
    Cut a recording into windows, evenly over its time if there are more than `MAX_WINDOWS`.

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
    angles = [i for i, signal in enumerate(model.states) if signal.angle]
    x[:, angles] = np.unwrap(x[:, angles], axis=0)
    gaps = np.diff(t) > MAX_GAP * np.median(np.diff(t))
    firsts = np.array([k for k in range(0, len(gaps) - WINDOW + 1, WINDOW) if not gaps[k : k + WINDOW].any()], np.intp)
    index = firsts[:: max(1, -(-len(firsts) // MAX_WINDOWS)), None] + np.arange(WINDOW)
    return Windows(
        model,
        x[np.column_stack([index, index[:, -1:] + 1])],
        index,
        t,
        1e-9 * np.array([(command.stamp_ns - begin_ns, command.state_stamp_ns - begin_ns) for command in commands]),
        np.array([command.u[np.minimum(np.arange(ROWS), len(command.u) - 1)] for command in commands]),
        1e-9 * float(np.median([command.period_ns for command in commands])),
        np.ptp(x, axis=0),
    )


def inputs(windows: Windows, delay_s: float, lag_s: float) -> Array:
    """Return the input in each part of each step, shape ``(W, WINDOW, parts, nu)``."""
    t, span = windows.t_s, np.diff(windows.t_s)
    cells = (t[:-1, None] + span[:, None] * (np.arange(CELLS) + 0.5) / CELLS).ravel()
    stamps, answered = windows.starts_s.T
    starts = np.maximum.accumulate(np.maximum(stamps, answered + delay_s))
    newest = np.maximum(np.searchsorted(starts, cells, side="right") - 1, 0)
    row = np.clip((cells - stamps[newest]) / windows.row_s, 0, ROWS - 1).astype(int)
    v = windows.rows[newest, row]
    if lag_s > 0.0:
        left = float(np.exp(-windows.step_s / CELLS / lag_s))  # of the difference, after a cell
        ends = lfilter([1.0 - left], [1.0, -left], v, axis=0, zi=left * v[:1])[0]
        v = (np.concatenate([v[:1], ends[:-1]]) + ends) / 2
    parts = PARTS if windows.model.dt is None else 1
    return np.asarray(v.reshape(len(span), parts, CELLS // parts, -1).mean(axis=2)[windows.index])


def mapped(function: Any, windows: Windows, x: Array, v: Array, span: Array) -> Array:
    """Evaluate a CasADi function of x, u, p and dt at many points, shapes ``(n, nx)``, ``(n, nu)`` and ``(n,)``; a row per column of its result."""
    count = len(x)
    p = np.tile(np.array(windows.model.p_nominal)[:, None], count)
    return np.array(function.map(count)(x.T, v.T, p, span[None])).T


class Predictor:
    """
    Predictions of the states of windows.

    Args:
        windows: The windows.
    """

    def __init__(self, windows: Windows) -> None:
        self.windows = windows
        self._phi = integrator(windows.model)
        self._span = np.diff(windows.t_s)[windows.index]  # (W, WINDOW)

    def after(self, x: Array, v: Array, span: Array) -> Array:
        """Return the states after a step, from states ``(n, nx)``, inputs ``(n, parts, nu)`` and durations ``(n,)``."""
        for part in v.swapaxes(0, 1):
            x = mapped(self._phi, self.windows, x, part, span / v.shape[1])
        return x

    def step_errors(self, v: Array) -> Array:
        """Return the error of each single step, shape ``(W, WINDOW, nx)``."""
        x = self.windows.x
        flat = self.after(x[:, :-1].reshape(-1, x.shape[2]), v.reshape(-1, *v.shape[2:]), self._span.ravel())
        return np.asarray(x[:, 1:] - flat.reshape(x[:, 1:].shape))

    def window_errors(self, v: Array) -> Array:
        """Return the errors of the states of each window, predicted from its first one, shape ``(W, WINDOW + 1, nx)``."""
        measured = self.windows.x
        x, errors = measured[:, 0], [np.zeros_like(measured[:, 0])]
        for k in range(WINDOW):
            x = self.after(x, v[:, k], self._span[:, k])
            errors.append(measured[:, k + 1] - x)
        return np.stack(errors, axis=1)

    def slopes(self, v: Array) -> Array:
        """Return the sensitivity of each step to its state, A, shape ``(W, WINDOW, nx, nx)``."""
        A = self._phi.factory("A", ["x", "u", "p", "dt"], ["jac:x_next:x"])
        x = self.windows.x[:, :-1]
        rows = mapped(A, self.windows, x.reshape(-1, x.shape[2]), v.mean(axis=2).reshape(-1, v.shape[3]), self._span.ravel())
        return rows.reshape(*x.shape, x.shape[2]).swapaxes(2, 3)


def noise_of(errors: Array, A: Array) -> Array:
    """
    Return the standard deviation of the noise of each state, shape ``(nx,)``.

    Args:
        errors: Of single steps, shape ``(W, WINDOW, nx)``.
        A: Sensitivities of the steps, shape ``(W, WINDOW, nx, nx)``.
    """
    variance = np.diff(errors, 2, axis=1).var(axis=(0, 1))
    one = np.eye(A.shape[2])
    gains = one + sum((part**2).mean(axis=(0, 1)) for part in (2 * one + A, one + 2 * A, A))  # of each state's noise, squared
    if not (moving := variance > 0.0).any():
        return np.zeros(len(variance))
    unit = variance[moving]
    found = np.zeros(len(variance))
    found[moving] = nnls(gains[np.ix_(moving, moving)] * unit / unit[:, None], np.ones(len(unit)))[0] * unit
    return np.sqrt(found)


def identified(windows: Windows, delay_s: float | None = None, lag_s: float | None = None) -> tuple[float, float, Array]:
    """
    Return delay and lag of the inputs, in s, and the standard deviation of the noise of each state, shape ``(nx,)``.

    Args:
        windows: Of the recording.
        delay_s: The delay, where it is known.
        lag_s: The lag, where it is known.
    """
    predict, step_s, least = Predictor(windows), windows.step_s, np.maximum(NEGLIGIBLE * windows.range, TINY)
    none = np.array([windows.assumed_delay_s if delay_s is None else delay_s, lag_s or 0.0])
    v = inputs(windows, *none)
    A = predict.slopes(v)
    unit = np.maximum(noise_of(predict.step_errors(v), A), least)
    transitions = [np.broadcast_to(np.eye(A.shape[2]), A[:, 0].shape)]
    for k in range(WINDOW):
        transitions.append(A[:, k] @ transitions[-1])
    seen = np.stack(transitions, axis=1) / unit[:, None]  # effect of the first state on all, (W, WINDOW + 1, nx, nx)
    basis = np.linalg.qr(seen.reshape(len(seen), -1, A.shape[2]))[0]

    def misfit(values: Array) -> float:
        """Twice the negative log-likelihood of a delay and a lag, up to a constant."""
        errors = (predict.window_errors(inputs(windows, *values)) / unit).reshape(len(seen), -1)
        errors = errors - (basis @ (basis.swapaxes(1, 2) @ errors[:, :, None]))[:, :, 0]
        value = float(errors.size * np.log((errors**2).mean() + TINY))
        return value if np.isfinite(value) else np.inf

    delays = none[0] + (DELAYS * step_s if delay_s is None else np.zeros(1))
    lags = LAGS * step_s if lag_s is None else none[1:]
    costs = {(delay, lag): misfit(np.array([delay, lag])) for delay in delays for lag in lags}
    best, score = none, costs[none[0], none[1]]
    for free in ([True, False], [False, True], [True, True]):
        if (free[0] and delay_s is not None) or (free[1] and lag_s is not None):
            continue
        kept = ~np.array(free)
        begin = min((pair for pair in costs if (np.array(pair) == none)[kept].all()), key=costs.__getitem__)
        found, cost = refined(misfit, np.array(begin), np.array(free), none, step_s)
        if cost + MIN_ADVANTAGE * sum(free) < score:
            best, score = found, cost + MIN_ADVANTAGE * sum(free)
    noise = noise_of(predict.step_errors(inputs(windows, *best)), A)
    return float(best[0]), float(best[1]), np.where(noise > least, noise, 0.0)


def refined(misfit: Callable[[Array], float], begin: Array, free: Array, least: Array, step_s: float) -> tuple[Array, float]:
    """Return the values that are fitted best from a beginning on, and their misfit; those that are not `free` stay."""

    def values(z: Array) -> Array:
        moved = begin.copy()
        moved[free] = step_s * z
        return np.maximum(moved, least)

    at = begin[free] / step_s
    simplex = np.vstack([at, at + 0.1 * np.eye(len(at))])
    options = {"initial_simplex": simplex, "xatol": 0.005, "fatol": 0.1, "maxfev": 60}  # steps, and twice the log-likelihood
    problem: dict[str, Any] = {"fun": lambda z: misfit(values(z)), "x0": at, "method": "Nelder-Mead", "options": options}
    found = minimize(**problem)
    return values(found.x), float(found.fun)
