# SPDX-License-Identifier: Apache-2.0
r"""
State and disturbances of a robot, estimated together by an extended Kalman filter.

The state is augmented by disturbances that walk at random, :math:`z = (x, d)`,
:math:`\dot x = f(x, u, p, d)`, :math:`\dot d = w`. A controller that predicts with
the estimate tracks without offset although its model is wrong
[Pannocchia2003]_. The filter is corrected by one measured state after the other, in
Joseph's form, which holds for any gain: the gain of the disturbances is set to zero
where they are frozen. The disturbances are clipped to their limits. Noises that nobody
has configured are shares of the scales of the states, so that units mean nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite

import casadi as ca
import numpy as np

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled, function
from rti_mpc.errors import OcpError
from rti_mpc.model.disturbance import with_disturbances
from rti_mpc.model.integrator import sensitivities
from rti_mpc.model.model import Model

DEFAULT_NOISE = 1e-3  # standard deviation of a measured state, relative to its scale
DEFAULT_PROCESS_NOISE = 1e-3  # standard deviation of the random walk that is added to a state, relative to its scale, 1 / sqrt(s)


@dataclass(frozen=True, slots=True)
class Disturbance:
    """
    Settings of one disturbance, in the unit it has in `with_disturbances`.

    Attributes:
        drift: Standard deviation of its random walk, in its unit / sqrt(s). A larger one gives a faster and noisier estimate.
        limit: Largest magnitude of the estimate.
    """

    drift: float
    limit: float


@dataclass(frozen=True)
class ObserverSettings:
    """
    Settings of the filter.

    Attributes:
        disturbances: Settings of each disturbance, by the name of an input or a state.
        measured: Names of the states that are measured, or of the only one; empty if all are.
        noise: Standard deviation of measured states by name, in the state's unit; `DEFAULT_NOISE` of its scale if left out.
        process: Standard deviation of the random walk that is added to states, by name, in the state's unit / sqrt(s);
            `DEFAULT_PROCESS_NOISE` of its scale if left out.
    """

    disturbances: Mapping[str, Disturbance] = field(default_factory=dict)
    measured: tuple[str, ...] = ()
    noise: Mapping[str, float] = field(default_factory=dict)
    process: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Take one name for a tuple of it."""
        if isinstance(self.measured, str):
            object.__setattr__(self, "measured", (self.measured,))


class Observer:
    """
    The filter of one robot.

    The scales of its states are those of the problem once it belongs to a `rti_mpc.control.controller.Controller`, until then one unit each.

    Attributes:
        model: The model with its disturbances, which the controller must predict with.
        x: Estimated state, shape ``(nx,)``.
        d: Estimated disturbances, shape ``(nd,)``: the last parameters of `model`.
        p: Its other parameters, shape ``(np,)``; nominal unless written.
        measured: Indices of the states that are measured.
        frozen: Whether the disturbances keep their values, because it is not known which inputs act.

    Raises:
        OcpError: A name is unknown, or a number not positive.
    """

    def __init__(self, model: Model, settings: ObserverSettings, *, compile: bool = True) -> None:
        states = [signal.name for signal in given.instance("model", model, Model).states]
        given.instance("settings", settings, ObserverSettings)
        for what, names in (("measured", settings.measured), ("noise", settings.noise), ("process", settings.process)):
            if unknown := [name for name in names if name not in states]:
                raise OcpError(f"{what} must be of states ({', '.join(states)}), got {', '.join(map(str, unknown))}")
        for name, of in settings.disturbances.items():
            given.instance(f"the disturbance of {name}", of, Disturbance)
            if not all(given.number(f"{field} of the disturbance of {name}", getattr(of, field)) > 0.0 for field in ("drift", "limit")):
                raise OcpError(f"drift and limit of the disturbance of {name} must be positive, got {of.drift} and {of.limit}")
        for what, table in (("noise", settings.noise), ("process", settings.process)):
            for name, value in table.items():
                given.number(f"{what} of {name}", value)
        self._rotations = model.rotations("states")
        self.model = with_disturbances(model, settings.disturbances)
        nx, nd = model.nx, len(settings.disturbances)
        self._limits: Array = np.array([of.limit for of in settings.disturbances.values()])
        self.measured = measured = [j for j, name in enumerate(states) if not settings.measured or name in settings.measured]
        for places in self._rotations.quaternions:
            if not set(places) <= set(measured):
                raise OcpError(f"measured must have all of a quaternion, {', '.join(states[j] for j in places)}, got {', '.join(settings.measured)}")
        if min((settings.noise[states[j]] for j in measured if states[j] in settings.noise), default=1.0) <= 0.0:
            raise OcpError(f"the noise of a measured state must be positive, got {dict(settings.noise)}")
        self._settings = settings
        self._variances, self._walks = np.zeros(len(measured)), np.zeros(nx + nd)
        self._initial, self._P = np.zeros((nx + nd, nx + nd)), np.zeros((nx + nd, nx + nd))
        self.take_scales(np.ones(nx))

        z: Array = np.zeros(nx + nd)
        self.x, self.d = z[:nx], z[nx:]
        self.frozen = False
        self._u, self._span, self._y, self._gain = np.zeros(model.nu), np.zeros(1), np.zeros(nx), np.ones(1)
        self.p: Array = np.array(model.p_nominal)
        functions = predict(self.model, nd), correct(nx, nd, measured, self._limits)
        made = compiled(*functions) if compile else functions
        z_next, P_next = np.zeros_like(z), np.zeros_like(self._P)
        before = {"z": z, "P": self._P, "u": self._u, "p": self.p, "span": self._span, "walks": self._walks}
        self._predict = bind(made[0], before, {"z_next": z_next, "P_next": P_next})
        measured_at = {"z": z_next, "P": P_next, "y": self._y, "gain": self._gain, "variances": self._variances}
        self._correct = bind(made[1], measured_at, {"z_corrected": z, "P_corrected": self._P})
        self._predicted = (z_next, P_next)
        self._z = z

    def take_scales(self, scale: Array) -> None:
        """Take the scales of the states, shape ``(nx,)``: noises that the settings leave out are shares of them. The covariance starts anew."""
        settings, model = self._settings, self.model
        names = [signal.name for signal in model.states]
        noise, process = (
            np.array([configured.get(name, share * of) for name, of in zip(names, scale, strict=True)])
            for configured, share in ((settings.noise, DEFAULT_NOISE), (settings.process, DEFAULT_PROCESS_NOISE))
        )
        self._variances[:] = noise[self.measured] ** 2
        self._walks[:] = np.square([*process, *(of.drift for of in settings.disturbances.values())])
        at_start = np.where(np.isin(np.arange(model.nx), self.measured), noise, scale)  # what is not measured may be anywhere
        np.fill_diagonal(self._initial, np.square([*at_start, *self._limits]))
        self._P[:] = self._initial

    def reset(self, x: Array) -> None:
        """Start from a state, shape ``(nx,)``; the disturbances keep their values if they are finite, and the covariance starts anew."""
        self.x[:] = x
        np.nan_to_num(self.d, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        self._P[:] = self._initial

    def predict(self, u: Array, span_s: float) -> None:
        """Predict over a time in s, under one input, shape ``(nu,)``."""
        self._u[:] = u
        self._span[0] = span_s
        self._predict()
        self._z[:], self._P[:] = self._predicted

    def correct(self, y: Array) -> None:
        """Correct by a state, shape ``(nx,)``, its rotations written near to those of `x`; components that are not measured are ignored."""
        self._predicted[0][:], self._predicted[1][:] = self._z, self._P
        self._y[:] = y
        self._gain[0] = not self.frozen
        self._correct()
        self._rotations.normalize(self.x)

    @property
    def finite(self) -> bool:
        """Whether the estimate is a number: a model may have none, such as the root of a level, where an estimate falls short of the state."""
        return isfinite(self._z.sum() + self._P.sum())


def predict(model: Model, nd: int) -> ca.Function:
    """Build ``(z, P, u, p, span, walks) -> (z_next, P_next)``: one step of the dynamics and of the covariance, which the walks' variances enlarge."""
    nx, n = model.nx, model.nx + nd
    P, span, walks = ca.SX.sym("P", n, n), ca.SX.sym("span"), ca.SX.sym("walks", n)
    p, d = model.p[: model.np_ - nd], model.p[model.np_ - nd :]
    z = ca.vertcat(model.x, d)
    x_next, A_x, _, A_p = sensitivities(model, span)
    z_next = ca.vertcat(x_next, d)
    A = ca.blockcat([[A_x, A_p[:, model.np_ - nd :]], [ca.SX(nd, nx), ca.SX.eye(nd)]])
    P_next = ca.densify(A @ P @ A.T + span * ca.diag(walks))
    inputs = {"z": z, "P": P, "u": model.u, "p": p, "span": span, "walks": walks}
    return function("observer_predict", inputs, {"z_next": z_next, "P_next": P_next})


def correct(nx: int, nd: int, measured: list[int], limits: Array) -> ca.Function:
    """Build ``(z, P, y, gain, variances) -> (z_corrected, P_corrected)``; a `gain` of 0 freezes the disturbances, 1 does not."""
    z, P = ca.SX.sym("z", nx + nd), ca.SX.sym("P", nx + nd, nx + nd)
    y, gain, variances = ca.SX.sym("y", nx), ca.SX.sym("gain"), ca.SX.sym("variances", len(measured))
    inputs = {"z": z, "P": P, "y": y, "gain": gain, "variances": variances}
    acts = ca.vertcat(ca.SX.ones(nx), gain * ca.SX.ones(nd))
    for j, variance in zip(measured, ca.vertsplit(variances), strict=True):
        column = P[:, j]
        s = P[j, j] + variance
        K = acts * column / s
        z = z + K * (y[j] - z[j])
        P = P - K @ column.T - column @ K.T + s * (K @ K.T)
    bounded = ca.fmax(ca.fmin(z[nx:, 0], ca.DM(limits)), -ca.DM(limits))
    return function("observer_correct", inputs, {"z_corrected": ca.vertcat(z[:nx], bounded), "P_corrected": ca.densify((P + P.T) / 2)})
