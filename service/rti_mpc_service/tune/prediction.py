# SPDX-License-Identifier: Apache-2.0
"""Prediction of the states of windows by the model."""

from __future__ import annotations

from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import at_points
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import Model
from rti_mpc_service.tune.windows import Windows


class Predictor:
    """
    Predictions of windows of one model.

    Args:
        model: The dynamics, with the plant's parameters.
    """

    def __init__(self, model: Model) -> None:
        self._phi = integrator(model)
        self._A = self._phi.factory("A", ["x", "u", "p", "dt"], ["jac:x_next:x"])
        self._p = np.array(model.p_nominal)

    def _at(self, function: Any, x: Array, v: Array, span: Array) -> Array:
        """Evaluate a function of x, u, p and dt at many points, shapes ``(n, nx)``, ``(n, nu)`` and ``(n,)``; a row per column of its result."""
        return at_points(function, x, v, np.tile(self._p, (len(x), 1)), span)

    def after(self, x: Array, v: Array, span: Array) -> Array:
        """Return the states after a step, from states ``(n, nx)``, inputs ``(n, parts, nu)`` and durations ``(n,)``."""
        for part in v.swapaxes(0, 1):
            x = self._at(self._phi, x, part, span / v.shape[1])
        return x

    def step_errors(self, windows: Windows, v: Array) -> Array:
        """Return the error of each single step, shape ``(W, S, nx)``."""
        x = windows.x
        flat = self.after(x[:, :-1].reshape(-1, x.shape[2]), v.reshape(-1, *v.shape[2:]), windows.span_s.ravel())
        return np.asarray(x[:, 1:] - flat.reshape(x[:, 1:].shape))

    def window_errors(self, windows: Windows, v: Array) -> Array:
        """Return the errors of the states of each window, predicted from its first one, shape ``(W, S + 1, nx)``."""
        measured, span = windows.x, windows.span_s
        x, errors = measured[:, 0], [np.zeros_like(measured[:, 0])]
        for k in range(windows.steps):
            x = self.after(x, v[:, k], span[:, k])
            errors.append(measured[:, k + 1] - x)
        return np.stack(errors, axis=1)

    def slopes(self, windows: Windows, v: Array) -> Array:
        """Return the sensitivity of each step to its state, A, shape ``(W, S, nx, nx)``."""
        x = windows.x[:, :-1]
        rows = self._at(self._A, x.reshape(-1, x.shape[2]), v.mean(axis=2).reshape(-1, v.shape[3]), windows.span_s.ravel())
        return rows.reshape(*x.shape, x.shape[2]).swapaxes(2, 3)
