# SPDX-License-Identifier: Apache-2.0
r"""
Delay, lag of the inputs and measurement noise of a robot, identified from its recording and its model.

With a delay D and a lag T the commands lead to the inputs :math:`\dot v = (u(t; D) - v) / T`. D and T
are those with which the model predicts windows of the recording with the least error. The first state
of each window is fitted as well: the commands answer its noise, which would look like their effect otherwise.
Windows that the model does not predict to a finite end, as from beside a singularity, are left out.
A value counts only if it is better than none by more than noise explains.

Noise follows from the errors of single steps, :math:`e_k = x_{k+1} - \phi(x_k, v_k) = n_{k+1} - A_k n_k + w_k`.
Their second differences remove what changes slowly, such as the effect of a wrong parameter. For a state that keeps itself,
A = 1, they are the third differences of what was measured, less what the model explains, with the variance :math:`20 \sigma^2`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, nnls

from rti_mpc.array import Array
from rti_mpc.si import ones
from rti_mpc_service.tune.prediction import Predictor
from rti_mpc_service.tune.windows import MIN_WINDOWS, Windows, inputs

DELAYS = np.arange(7) / 4  # units of time of the windows, beyond the delay that the controller assumed, from which the fit begins
LAGS = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 4.0])  # likewise
MIN_ADVANTAGE = 12.0  # of twice the log-likelihood: noise alone would have to be 3.5 sigma
NEGLIGIBLE = 1e-5  # error, relative to the range that the state went through
TINY = 1e-12  # in the SI unit of a state, of one that does not move at all; also of a mean square relative to noise


class Identified(NamedTuple):
    """
    What was found.

    Attributes:
        delay_s: Delay of the inputs.
        lag_s: Lag of the inputs.
        noise: Standard deviation of the noise of each state, shape ``(nx,)``.
        left_out: Windows that the model does not predict to a finite end.
    """

    delay_s: float
    lag_s: float
    noise: Array
    left_out: int


def noise_of(errors: Array, A: Array) -> Array:
    """
    Return the standard deviation of the noise of each state, shape ``(nx,)``.

    Args:
        errors: Of single steps, shape ``(W, S, nx)``.
        A: Sensitivities of the steps, shape ``(W, S, nx, nx)``.
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


def identified(windows: Windows, delay_s: float | None = None, lag_s: float | None = None) -> Identified | None:
    """
    Find delay, lag and noise; None if the model predicts fewer than `MIN_WINDOWS` windows to a finite end.

    Args:
        windows: Of the recording.
        delay_s: The delay, where it is known, in s.
        lag_s: The lag, where it is known, in s.
    """
    predict, unit_s, least = Predictor(windows.model), windows.unit_s, np.maximum(NEGLIGIBLE * windows.range, TINY * ones(windows.model.states))
    none = np.array([windows.assumed_delay_s if delay_s is None else delay_s, lag_s or 0.0])
    delays = none[0] + (DELAYS * unit_s if delay_s is None else np.zeros(1))
    lags = LAGS * unit_s if lag_s is None else none[1:]
    v = inputs(windows, *none)
    steps, A = predict.step_errors(windows, v), predict.slopes(windows, v)
    errors = {(delay, lag): predict.window_errors(windows, inputs(windows, delay, lag)) for delay in delays for lag in lags}
    if (kept := finite(steps, A, *errors.values())).sum() < MIN_WINDOWS:
        return None
    used, steps, A = windows.only(kept), steps[kept], A[kept]
    unit = np.maximum(noise_of(steps, A), least)
    transitions = [np.broadcast_to(np.eye(A.shape[2]), A[:, 0].shape)]
    for k in range(windows.steps):
        transitions.append(A[:, k] @ transitions[-1])
    seen = np.stack(transitions, axis=1) / unit[:, None]  # effect of the first state on all, (W, S + 1, nx, nx)
    basis = np.linalg.qr(seen.reshape(len(seen), -1, A.shape[2]))[0]

    def misfit(errors: Array) -> float:
        """Twice the negative log-likelihood of errors, shape ``(W, S + 1, nx)``, up to a constant."""
        errors = (errors / unit).reshape(len(basis), -1)
        errors = errors - (basis @ (basis.swapaxes(1, 2) @ errors[:, :, None]))[:, :, 0]
        value = float(errors.size * np.log((errors**2).mean() + TINY))
        return value if np.isfinite(value) else np.inf

    def predicted(values: Array) -> float:
        """Misfit of a delay and a lag."""
        return misfit(predict.window_errors(used, inputs(used, *values)))

    costs = {pair: misfit(each[kept]) for pair, each in errors.items()}
    best, score = none, costs[none[0], none[1]]
    for free in ([True, False], [False, True], [True, True]):
        if (free[0] and delay_s is not None) or (free[1] and lag_s is not None):
            continue
        fixed = ~np.array(free)
        begin = min((pair for pair in costs if (np.array(pair) == none)[fixed].all()), key=costs.__getitem__)
        found, cost = refined(predicted, np.array(begin), np.array(free), none, unit_s)
        if cost + MIN_ADVANTAGE * sum(free) < score:
            best, score = found, cost + MIN_ADVANTAGE * sum(free)
    steps = predict.step_errors(used, inputs(used, *best))
    noise = noise_of(steps[finite(steps)], A[finite(steps)])
    return Identified(float(best[0]), float(best[1]), np.where(noise > least, noise, 0.0), len(windows.x) - len(used.x))


def finite(*of: Array) -> NDArray[np.bool_]:
    """Return which windows have nothing that is not finite, shape ``(W,)``, of arrays with a window a row."""
    return np.asarray(np.all([np.isfinite(each).reshape(len(each), -1).all(axis=1) for each in of], axis=0))


def refined(misfit: Callable[[Array], float], begin: Array, free: Array, least: Array, unit_s: float) -> tuple[Array, float]:
    """Return the values that are fitted best from a beginning on, and their misfit; those that are not `free` stay."""

    def values(z: Array) -> Array:
        moved = begin.copy()
        moved[free] = unit_s * z
        return np.maximum(moved, least)

    at = begin[free] / unit_s
    simplex = np.vstack([at, at + 0.1 * np.eye(len(at))])
    options = {"initial_simplex": simplex, "xatol": 0.005, "fatol": 0.1, "maxfev": 60}  # units of time, and twice the log-likelihood
    problem: dict[str, Any] = {"fun": lambda z: misfit(values(z)), "x0": at, "method": "Nelder-Mead", "options": options}
    found = minimize(**problem)
    return values(found.x), float(found.fun)
