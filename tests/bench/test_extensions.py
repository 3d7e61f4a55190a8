# SPDX-License-Identifier: Apache-2.0
"""
What a sample costs with each extension of the problem class, beside the same problem without it.

All problems take turns at each sample, every one in a closed loop of its own, so that load and
frequency of the host are shared: a ratio is of medians of CPU time of two problems that ran side by side.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from tests.bench.timed import timed
from tests.problems import arc, pioneer
from tests.rti.test_problem_class import attitude, turned

SHORT = "CI" in os.environ  # to see that all of it runs: figures need a quiet machine, and `make bench`
SAMPLES = 20 if SHORT else 1000
COLD_SAMPLES = 5 if SHORT else 50  # first samples, left out: the robot drives to its path
MOST = 4.0  # times the problem without it: none of these is to be a problem of another size

N, NONE = 20, np.inf
STATES = {"lbx": [-NONE] * 3 + [-0.15, -0.5], "ubx": [NONE] * 3 + [0.15, 0.5]}
SLOWING = {"lbx": np.tile(STATES["lbx"], (N, 1)), "ubx": np.column_stack([np.full((N, 3), NONE), np.linspace(0.2, 0.13, N), np.full(N, 0.5)])}
ALONG = np.linspace(0.5, 1.5, N)[:, None]


def robot(**changes: Any) -> Ocp:
    """The paper's robot with bounds of inputs and increments."""
    return pioneer(**{"N": N, "lbx": -NONE, "ubx": NONE} | changes)


def unturned() -> Ocp:
    """The turning body with its quaternion as four numbers."""
    ocp = attitude(N=N)
    return on_model(replace(ocp.model, quaternions=()), ocp)


def signals_of(model: Model) -> dict[str, Any]:
    """Return what the variables of a model stand for, and its parameters' values."""
    return {name: getattr(model, name) for name in ("states", "inputs", "outputs", "parameters", "p_nominal")}


def sampled() -> Model:
    """The paper's robot in discrete time, each period an RK4 step, as one would identify it."""
    ocp = robot()
    model = ocp.model
    after = ocp.phi()(model.x, model.u, model.p)
    return Model(name="sampled", x=model.x, u=model.u, p=model.p, disc_dyn_expr=after, dt=ocp.dt, y_expr=model.y_expr, **signals_of(model))


def in_mx() -> Model:
    """The same model in MX."""
    model = pioneer_3dx()
    variables: dict[str, Any] = {name: ca.MX.sym(name, getattr(model, name).numel()) for name in ("x", "u", "p")}
    rate = ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr])(*variables.values())
    return Model(name="in_mx", f_expl_expr=rate, y_expr=variables["x"][:3], **variables, **signals_of(model))


def felt() -> Model:
    """The robot with an output of state and input: its sideways acceleration."""
    model = pioneer_3dx()
    return replace(model, y_expr=ca.vertcat(model.y_expr, model.x[3] * model.u[1]), outputs=(*model.outputs, Signal("sideways", "m/s2")))


def on_model(model: Model, ocp: Ocp | None = None, **changes: Any) -> Ocp:
    """The problem of the robot, or another one, with another model."""
    ocp = ocp or robot()
    kept = {name: getattr(ocp, name) for name in ("N", "dt", "Q", "R", "delta", "lambda_", "lbu", "ubu", "lbdu", "ubdu")}
    return Ocp(model, **kept | changes)


def on_the_eight(ocp: Ocp, k: int) -> Array:
    """The eight; further outputs are to be zero."""
    t: Array = ocp.dt * np.arange(k + 1.0, k + ocp.N + 1.0)
    return np.pad(arc(t), ((0, 0), (0, ocp.model.ny - 3)))


def turning(ocp: Ocp, k: int) -> Array:
    t = ocp.dt * (k + np.arange(1, ocp.N + 1))
    return np.array([[*turned([1.0, 0.5, 0.2], 0.6 * np.sin(0.3 * one)), 0, 0, 0] for one in t])


class Loop:
    """A controller in closed loop with its own prediction, disturbed."""

    def __init__(self, ocp: Ocp, reference: Callable[[Ocp, int], Array]) -> None:
        self.rti, self._reference, self._rng = Rti(ocp, compile=not SHORT, iterations=1), reference, np.random.default_rng(3)
        self._ms: list[float] = []
        self._prepare, self._feedback = timed(self.rti.prepare, self._ms), timed(self.rti.feedback, self._ms)
        self._x = self.rti.x_nominal.copy()
        self._x[:2] += [0.2, -0.3] if reference is on_the_eight else 0.0
        self._u_prev = np.clip(np.zeros(ocp.model.nu), ocp.widest("lbu"), ocp.widest("ubu"))
        self.rti.reset(self._x, self._u_prev)

    def sample(self, k: int) -> None:
        self._prepare(self._reference(self.rti.ocp, k))
        assert self._feedback(self._x).usable
        self._x = self.rti.x[1] + 1e-3 * self._rng.normal(size=len(self._x))

    def us(self) -> Array:
        """CPU times of all samples but the first ones, both phases, us."""
        return np.asarray(1e3 * np.reshape(self._ms, (-1, 2)).sum(axis=1)[COLD_SAMPLES:])


@dataclass(frozen=True)
class Extension:
    """A problem with an extension, and the name of that without it."""

    without: str
    build: Callable[[], Ocp]
    reference: Callable[[Ocp, int], Array] = on_the_eight


PLAIN: dict[str, Extension] = {
    "robot": Extension("", robot),
    "robot, states bounded": Extension("", lambda: robot(**STATES)),
    "turning body": Extension("", unturned, turning),
}
EXTENSIONS: dict[str, Extension] = {
    "model in MX": Extension("robot", lambda: on_model(in_mx())),
    "discrete time": Extension("robot", lambda: on_model(sampled())),
    "four steps within a stage": Extension("robot", lambda: robot(sim_method_num_steps=4)),
    "irk, two stages": Extension("robot", lambda: robot(method="irk")),
    "irk, three stages": Extension("robot", lambda: robot(method="irk", sim_method_num_stages=3)),
    "an input that is fixed": Extension("robot", lambda: robot(lbu=[0.2, -0.8], ubu=[0.2, 0.8])),
    "blocks of held inputs, 8 of them": Extension("robot", lambda: robot(blocks=[1, 1, 1, 1, 2, 2, 4, 8])),
    "control horizon of 8": Extension("robot", lambda: robot(N_u=8)),
    "an output of states and inputs": Extension("robot", lambda: on_model(felt(), Q=[1.0, 1.0, 0.05, 0.1])),
    "weights of outputs by stage": Extension("robot", lambda: robot(delta=np.tile(ALONG, 3))),
    "weights of increments by stage": Extension("robot", lambda: robot(lambda_=np.tile(ALONG, 2))),
    "weights of inputs": Extension("robot", lambda: robot(R_u=[0.05, 0.05])),
    "weights of inputs by stage": Extension("robot", lambda: robot(R_u=0.05 * np.tile(ALONG, 2))),
    "outputs that count at the end": Extension("robot", lambda: robot(Q_e=[1.0, 1.0, 0.1])),
    "terminal set": Extension("robot", lambda: robot(lbx_e=[-NONE] * 3 + [-0.1, -NONE], ubx_e=[NONE] * 3 + [0.1, NONE])),
    "bounds of two states": Extension("robot", lambda: robot(**STATES)),
    "bounds of inputs by stage": Extension("robot", lambda: robot(lbu=np.tile([-0.5, -0.8], (N, 1)), ubu=np.tile([0.5, 0.8], (N, 1)))),
    "bounds of two states by stage": Extension("robot, states bounded", lambda: robot(**SLOWING)),
    "bounds of two states, hard in effect": Extension("robot, states bounded", lambda: robot(**STATES, z=1e6)),
    "weights of slacks by stage": Extension("robot, states bounded", lambda: robot(**STATES, z=np.tile(1e3 * ALONG, 5))),
    "second differences of both inputs": Extension("robot", lambda: robot(lbddu=[-0.05, -0.1], ubddu=[0.05, 0.1])),
    "attitude as a quaternion": Extension("turning body", lambda: attitude(N=N), turning),
}


@pytest.mark.benchmark
def test_extensions_cost_what_they_add_and_no_more(capsys: pytest.CaptureFixture[str]) -> None:
    loops = {name: Loop(one.build(), one.reference) for name, one in (PLAIN | EXTENSIONS).items()}
    for k in range(SAMPLES):
        for loop in loops.values():
            loop.sample(k)
    us = {name: np.percentile(loop.us(), (50, 99)) for name, loop in loops.items()}
    with capsys.disabled():
        print(
            f"\nCPU time of a sample of one QP, N = {N}, riccati, {'interpreted' if SHORT else 'compiled'}, {SAMPLES - COLD_SAMPLES} samples in turn"
        )
        print("| what | p50 without, us | p50 with | ratio | p99 without | p99 with |\n| --- | --- | --- | --- | --- | --- |")
        for name, extension in EXTENSIONS.items():
            (p50, p99), (own50, own99) = us[extension.without], us[name]
            print(f"| {name} | {p50:.0f} | {own50:.0f} | {own50 / p50:.2f} | {p99:.0f} | {own99:.0f} |")
    for name, extension in EXTENSIONS.items():
        assert SHORT or us[name][0] < MOST * us[extension.without][0], name
