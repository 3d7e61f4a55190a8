# SPDX-License-Identifier: Apache-2.0
"""A closed loop, one sample after the other, with the time each solve took by two clocks."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.codegen import bind
from rti_mpc.model.integrator import integrator
from rti_mpc_service.paper.contender import Contender
from rti_mpc_service.paper.experiment import DELTA, Experiment, Q, R

PLANT_STEPS_IN_100_MS = 20  # RK4 steps of the robot, after each of which its distance from the path is taken
NOISE_STD = np.array([1e-3, 1e-3, 2e-3, 5e-3, 5e-3])  # standard deviation of the measured state, in m, m, rad, m/s, rad/s
WARM_UP_SOLVES = 5  # before the first solve that is timed


class Loop:
    """
    An experiment in progress.

    Attributes:
        experiment: The experiment.
        contender: The driving contender.
        y: Reference rows, from `Experiment.reference`.
        x: True states at samples, shape ``(samples + 1, 5)``.
        u: Commands, shape ``(samples, 2)``.
        between_mm: Largest distance from the trajectory in each sampling interval, its end included, shape ``(samples,)``.
        wall_us: Wall time of each solve, shape ``(samples,)``.
        cpu_us: CPU time of each solve, shape ``(samples,)``.
    """

    def __init__(self, experiment: Experiment, contender: Contender) -> None:
        self.experiment, self.contender = experiment, contender
        n, model = experiment.samples, experiment.robot
        self.y = experiment.reference()
        self.x: Array = np.tile(experiment.x0, (n + 1, 1))
        self.u: Array = np.zeros((n, model.nu))
        self.between_mm, self.wall_us, self.cpu_us = np.zeros(n), np.zeros(n), np.zeros(n)
        self._k = 0
        self._rng = np.random.default_rng(1)
        euler = experiment.plant == "euler"
        looks = 1 if euler else max(1, round(PLANT_STEPS_IN_100_MS * experiment.T0 / 0.1))
        self._acting, self._p = np.zeros((looks, model.nu)), np.tile(model.p_nominal, (looks, 1))
        self._start, self._path = np.zeros(model.nx), np.zeros((looks, model.nx))
        step = integrator(model, "euler" if euler else "rk4").mapaccum("plant", looks)
        inputs = {"x": self._start, "u": self._acting, "p": self._p, "dt": np.full(looks, experiment.T0 / looks)}
        self._advance = bind(step, inputs, {"x_next": self._path})
        self._offsets = experiment.T0 * np.arange(1, looks + 1) / looks
        for _ in range(WARM_UP_SOLVES):
            contender.reset(experiment.x0)
            contender.solve(experiment.x0, np.zeros(model.nu), self.y[1 : 1 + experiment.N])
        contender.reset(experiment.x0)

    def step(self) -> None:
        """Take one sample: measure, solve, act."""
        k, N = self._k, self.experiment.N
        x = self.x[k] + NOISE_STD * self._rng.standard_normal(len(NOISE_STD)) if self.experiment.noise else self.x[k]
        u_prev, y_ref = self.u[k - 1] if k else np.zeros_like(self.u[0]), self.y[k + 1 : k + 1 + N]
        cpu_ns, wall_ns = time.thread_time_ns(), time.perf_counter_ns()
        u = self.contender.solve(x, u_prev, y_ref)
        done_ns = time.perf_counter_ns()
        self.cpu_us[k], self.wall_us[k] = 1e-3 * (time.thread_time_ns() - cpu_ns), 1e-3 * (done_ns - wall_ns)
        self.u[k], self._acting[:], self._start[:] = u, u, self.x[k]
        self._advance()
        self.x[k + 1] = self._path[-1]
        away = self._path[:, :2] - self.experiment.trajectory.position(k * self.experiment.T0 + self._offsets)
        self.between_mm[k] = 1e3 * np.sqrt((away**2).sum(axis=1).max())
        self._k += 1

    @property
    def t(self) -> Array:
        """Times of the samples after the first, shape ``(samples,)``, s: those of ``x[1:]``."""
        return np.asarray(self.experiment.T0 * np.arange(1, len(self.u) + 1))

    @property
    def error_mm(self) -> Array:
        """Distance of the robot from the trajectory at the samples after the first, shape ``(samples,)``."""
        dx, dy = (self.x[1:, :2] - self.experiment.trajectory.position(self.t)).T
        return np.asarray(1e3 * np.hypot(dx, dy))

    @property
    def settled(self) -> NDArray[np.bool_]:
        """Which samples come after the transient."""
        return np.asarray(self.t > self.experiment.transient_s)

    @property
    def cost(self) -> float:
        """The paper's cost of what was driven: the state at k + 1 against the reference at k + 1, increments from rest."""
        e, du = self.x[1:, :3] - self.y[1 : len(self.x)], np.diff(self.u, axis=0, prepend=0.0)
        return float(DELTA * ((e**2) @ Q).sum() + 0.8 * ((du**2) @ R).sum())

    def summary(self) -> dict[str, Any]:
        """Return the results in JSON; the errors count after the transient."""
        error, between, period_us = self.error_mm[self.settled], self.between_mm[self.settled], 1e6 * self.experiment.T0
        return {
            "max_mm": float(error.max()),
            "rms_mm": float(np.sqrt((error**2).mean())),
            "max_squared_m2": float((1e-3 * error.max()) ** 2),
            "between_mm": float(between.max()),
            "end_mm": float(error[-1]),
            "end_speed_mm_s": float(1e3 * np.hypot(self.x[-1, 3], self.experiment.a * self.x[-1, 4])),
            "increment_rms": float(np.sqrt((np.diff(self.u, axis=0)[self.settled[1:]] ** 2).mean())),
            "cost": self.cost,
            "samples": len(self.u),
            **{
                f"{clock}_us": {name: float(np.percentile(us, share)) for name, share in (("p50", 50), ("p99", 99), ("max", 100))}
                for clock, us in (("wall", self.wall_us), ("cpu", self.cpu_us))
            },
            "inside_period": float((self.wall_us < period_us).mean()),
            "inside_percent_wall": float((self.wall_us < 0.01 * period_us).mean()),
            "inside_percent_cpu": float((self.cpu_us < 0.01 * period_us).mean()),
        }
