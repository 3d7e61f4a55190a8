# SPDX-License-Identifier: Apache-2.0
"""Experiment: trajectory, problem and robot of one closed loop, without its solver. The defaults are the paper's values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from rti_mpc.array import Array
from rti_mpc.model.model import Model
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.trajectory import Trajectory, rows
from rti_mpc.rti.ocp import Ocp

Q, R, DELTA = np.array([1.0, 1.0, 0.05]), np.array([1.0, 1.0]), 28.0  # the paper's weights
BEST_SETTINGS: dict[str, Any] = {"heading": "none", "method": "rk4", "lambda_": 0.008}  # those with the smallest errors in the sweeps
INPUT_LIMITS = np.array([0.5, 0.745])  # largest magnitude of the inputs and of the speeds they command, in m/s and rad/s


@dataclass(frozen=True, eq=False)
class Experiment:
    """
    A closed loop.

    Attributes:
        trajectory: What is followed, from rest at its `pose0`.
        heading: Reference of the heading: ``"tangent"``; ``"atan"``, the tangent with the one-argument arc tangent of equation (14);
            ``"consistent"`` for a point `a` ahead of the axle; ``"none"``, without weight on it.
        N: Horizon.
        N_u: Control horizon; `N` by default.
        T0: Sampling time, s.
        method: Integrator of the controller's model.
        lambda_: Weight on increments.
        delta_N: Factor on the last of the sequence of weights delta: what the horizon does not see counts there.
        a: Distance of the reference point ahead of the axle, m, for controller and robot.
        plant: The robot: ``"continuous"``, or ``"euler"`` for the paper's discrete model itself.
        mismatch: Factors on the robot's parameters, which the controller does not know, by name.
        noise: Whether the controller sees noise beside the state.
        transient_s: The robot starts beside the path; errors count from here on.
    """

    trajectory: Trajectory
    heading: Literal["tangent", "atan", "consistent", "none"] = "tangent"
    N: int = 7
    N_u: int | None = None
    T0: float = 0.1
    method: str = "euler"
    lambda_: float = 0.8
    delta_N: float = 1.0
    a: float = 0.2
    plant: Literal["continuous", "euler"] = "continuous"
    mismatch: Mapping[str, float] = field(default_factory=dict)
    noise: bool = False
    transient_s: float = 20.0

    @property
    def samples(self) -> int:
        """How many samples there are."""
        return round(self.trajectory.duration_s / self.T0)

    @property
    def x0(self) -> Array:
        """Initial state: at rest, shape ``(5,)``."""
        return np.array([*self.trajectory.pose0, 0.0, 0.0])

    @property
    def robot(self) -> Model:
        """The robot's own model."""
        model = pioneer_3dx().with_parameters(a=self.a)
        nominal = dict(zip((signal.name for signal in model.parameters), model.p_nominal, strict=True))
        return model.with_parameters(**{name: factor * nominal[name] for name, factor in self.mismatch.items()})

    def ocp(self) -> Ocp:
        """Return the controller's problem."""
        free = np.full(3, np.inf)
        return Ocp(
            pioneer_3dx().with_parameters(a=self.a),
            N=self.N,
            N_u=self.N_u,
            dt=self.T0,
            method=self.method,
            Q=Q * (1.0, 1.0, self.heading != "none"),
            R=R,
            delta=[DELTA] * (self.N - 1) + [DELTA * self.delta_N],
            lambda_=self.lambda_,
            lbu=-INPUT_LIMITS,
            ubu=INPUT_LIMITS,
            lbx=np.concatenate([-free, -INPUT_LIMITS]),
            ubx=np.concatenate([free, INPUT_LIMITS]),
        )

    def reference(self) -> Array:
        """Return rows ``x, y, psi`` from time 0 to a horizon after the end, shape ``(samples + N + 1, 3)``; psi begins nearest to the robot's."""
        longer = self.trajectory.lasting((self.samples + self.N) * self.T0)
        y = rows(longer, self.T0, "consistent" if self.heading == "consistent" and self.a else "tangent", a=self.a or 1.0)
        if self.heading == "atan":
            y[:, 2] = np.arctan(np.tan(y[:, 2]))
        else:
            y[:, 2] += 2 * np.pi * np.round((self.trajectory.pose0[2] - y[0, 2]) / (2 * np.pi))
        return y

    def settings(self) -> dict[str, Any]:
        """Return what decides this closed loop, in JSON."""
        return {
            "trajectory": self.trajectory.name,
            "duration_s": round(self.trajectory.duration_s, 3),
            "heading": self.heading,
            "N": self.N,
            "N_u": self.N_u or self.N,
            "T0_s": self.T0,
            "method": self.method,
            "lambda": self.lambda_,
            "delta_N": self.delta_N,
            "a_m": self.a,
            "plant": self.plant,
            "mismatch": dict(self.mismatch),
            "noise": self.noise,
        }
