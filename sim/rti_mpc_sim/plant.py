# SPDX-License-Identifier: Apache-2.0
r"""
Plant: the simulated robot's own model, integrated in finer steps than the controller's, or sampled if it is one in discrete time.

A first-order lag of the actuators, :math:`T \dot v = u - v`, is part of the
plant: `v` joins its state, so that inputs that lag are integrated as exactly as
the rest.
"""

from __future__ import annotations

import math
from dataclasses import replace
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import Model, Signal

_steps: WeakKeyDictionary[Model, dict[tuple[int, float], ca.Function]] = WeakKeyDictionary()  # of plants: robots of one model share them


def step(model: Model, substeps: int, lag_s: float) -> ca.Function:
    """Return the integration step of a plant, ``(x, u, p, dt) -> x_next``, built once for all robots of a model."""
    known = _steps.setdefault(model, {})
    key = substeps, lag_s
    if key not in known:
        known[key] = integrator(lagging(model, lag_s) if lag_s > 0.0 else model, substeps=substeps)
    return known[key]


def lagging(model: Model, lag_s: float) -> Model:
    """Return a model whose inputs follow with a first-order lag, as further states."""
    v = ca.SX.sym("v", model.nu)
    f = ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr])
    return replace(
        model,
        x=ca.vertcat(model.x, v),
        f_expl_expr=ca.vertcat(f(model.x, v, model.p), (model.u - v) / lag_s),
        x_nominal=(*model.x_nominal, *model.u_rest) if model.x_nominal else (),
        states=(*model.states, *(Signal(f"{s.name}_applied", s.unit) for s in model.inputs)),
    )


class Plant:
    """
    The continuous plant, advanced over any interval of constant input.

    One call into CasADi covers up to `max_step_s`, cut into equal steps of the model's integrator;
    nothing is allocated.

    Attributes:
        x: True state, shape ``(nx,)``; angles do not wrap.
        u: Input acting on the plant now, after the lag, shape ``(nu,)``.
    """

    def __init__(self, model: Model, x0: Array, max_step_s: float, substeps: int, lag_s: float = 0.0) -> None:
        if lag_s > 0.0:
            substeps = max(substeps, math.ceil(2.0 * max_step_s / lag_s))
        self._max_step_s = max_step_s
        self._state = np.concatenate([x0, model.u_rest]) if lag_s > 0.0 else np.array(x0)  # (nx,) or (nx + nu,)
        self._next = np.zeros_like(self._state)
        self._input = np.array(model.u_rest, dtype=np.float64)  # (nu,)
        self._p = np.array(model.p_nominal, dtype=np.float64)  # (np,)
        self._dt = np.zeros(1)
        self.x = self._state[: model.nx]
        self.u = self._state[model.nx :] if lag_s > 0.0 else self._input
        given = {"x": self._state, "u": self._input, "p": self._p, "dt": self._dt}
        self._evaluate = bind(step(model, substeps, lag_s), given, {"x_next": self._next})

    def place(self, x: Array) -> None:
        """Go on from another state, shape ``(nx,)``; inputs that lag go on from what they are."""
        self.x[:] = x

    def advance(self, u: Array, duration_s: float) -> None:
        """Integrate over an interval in which the input, shape ``(nu,)``, is held."""
        self._input[:] = u
        calls = max(1, math.ceil(duration_s / self._max_step_s - 1e-9))
        self._dt[0] = duration_s / calls
        for _ in range(calls):
            self._evaluate()
            self._state[:] = self._next


class SampledPlant:
    """
    The plant of a model in discrete time: exact after whole periods, interpolated within them.

    An input that changes within a period counts by its mean over the period.

    Attributes:
        x: True state, shape ``(nx,)``; angles do not wrap.
        u: Input acting on the plant now, after the lag, shape ``(nu,)``.
    """

    def __init__(self, model: Model, x0: Array, lag_s: float) -> None:
        assert model.dt is not None
        self._period_s, self._lag_s = model.dt, lag_s
        self.x = np.array(x0, dtype=np.float64)
        self.u = np.array(model.u_rest, dtype=np.float64)
        self._start, self._next = self.x.copy(), np.zeros_like(self.x)  # states at the beginning and at the end of the period, (nx,)
        self._sum, self._mean = np.zeros_like(self.u), np.zeros_like(self.u)  # of the input in this period, (nu,)
        self._elapsed_s = 0.0  # of the period
        self._p = np.array(model.p_nominal, dtype=np.float64)  # (np,)
        after = ca.Function("after", [model.x, model.u, model.p], [ca.densify(model.disc_dyn_expr)], ["x", "u", "p"], ["x_next"])
        self._evaluate = bind(after, {"x": self._start, "u": self._mean, "p": self._p}, {"x_next": self._next})

    def place(self, x: Array) -> None:
        """Go on from another state, shape ``(nx,)``, at the beginning of a period."""
        self.x[:] = self._start[:] = x
        self._sum[:] = self._elapsed_s = 0.0

    def advance(self, u: Array, duration_s: float) -> None:
        """Advance over an interval in which the input, shape ``(nu,)``, is held."""
        while duration_s > 1e-9 * self._period_s:
            span_s = min(duration_s, self._period_s - self._elapsed_s)
            left = math.exp(-span_s / self._lag_s) if self._lag_s > 0.0 else 0.0  # of the difference between command and input, after the span
            self._sum += span_s * u + self._lag_s * (1.0 - left) * (self.u - u)
            self.u[:] = u + left * (self.u - u)
            duration_s -= span_s
            self._elapsed_s += span_s
            self._mean[:] = self._sum / self._elapsed_s
            self._evaluate()
            self.x[:] = self._start + self._elapsed_s / self._period_s * (self._next - self._start)
            if self._elapsed_s >= (1.0 - 1e-9) * self._period_s:
                self.x[:] = self._start[:] = self._next
                self._sum[:] = self._elapsed_s = 0.0


def plant(model: Model, x0: Array, max_step_s: float, substeps: int, lag_s: float = 0.0) -> Plant | SampledPlant:
    """Return the plant of a model."""
    return Plant(model, x0, max_step_s, substeps, lag_s) if model.dt is None else SampledPlant(model, x0, lag_s)
