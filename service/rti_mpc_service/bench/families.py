# SPDX-License-Identifier: Apache-2.0
"""
Problem families of the benchmark: each a problem, its plant, references and starts in closed loop.

They are chosen for QPs that are hard to solve: softened bounds that are active most of
the time, constraints that come and go, many states, large transients, cold starts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import Model, Signal
from rti_mpc.model.obstacle import with_obstacles
from rti_mpc.model.robots.chain import chain as hanging_chain
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.trajectory import Trajectory, eight, positioning, rows
from rti_mpc.rti.ocp import Ocp

INF = np.inf
SPEED_BOUNDS: dict[str, Any] = {"lbx": [-INF, -INF, -INF, -0.5, -0.745], "ubx": [INF, INF, INF, 0.5, 0.745]}
INPUT_BOUNDS: dict[str, Any] = {"lbu": [-0.5, -0.745], "ubu": [0.5, 0.745]}
INCREMENT_BOUNDS: dict[str, Any] = {"lbdu": [-0.25, -0.4], "ubdu": [0.25, 0.4]}  # per sample of 0.1 s
COST_WEIGHTS: dict[str, Any] = {"R": [1.0, 1.0], "delta": 28.0, "lambda_": 0.8}

Start = Callable[[int], Array | None]


@dataclass
class Family:
    """
    A problem in closed loop.

    Attributes:
        ocp: The problem.
        samples: Number of samples.
        at: Returns for a sample the reference rows at nodes 1 to N, shape ``(N, ny)``, and stage parameters, ``(N + 1, np)``; None: nominal ones.
        start: Returns the state from which the loop restarts at a sample, shape ``(nx,)``; None: it continues.
        body: Model of the plant; the model of the problem if left out.
        substeps: RK4 steps of the plant in a period.
        u0: Input before each start, shape ``(nu,)``; the model's rest.
    """

    ocp: Ocp
    samples: int
    at: Callable[[int], tuple[Array, Array | None]]
    start: Start
    body: Model | None = None
    substeps: int = 4
    u0: Array = field(init=False)

    def __post_init__(self) -> None:
        model = self.body or self.ocp.model
        ocp, soft = self.ocp, list(self.ocp.soft)
        self.u0 = np.array(ocp.model.u_rest, dtype=np.float64)
        self._phi, self._p = integrator(model, "rk4", self.substeps), np.array(model.p_nominal)
        self._nominal = np.array(ocp.model.p_nominal)
        symbols = [ocp.model.x, ocp.model.u, ocp.model.p]
        self._outputs = ca.Function("outputs", symbols, [ocp.model.y_expr, ca.vertcat(ocp.model.x[soft], ocp.h_expr)])
        self._slack_weights = np.concatenate([ocp.z[soft], ocp.zh]), np.concatenate([ocp.Z[soft], ocp.Zh])

    def plant(self, x: Array, u: Array) -> Array:
        """Return the state of the plant a period later, shape ``(nx,)``."""
        return np.array(self._phi(x, u, self._p, self.ocp.dt)).ravel()

    def cost(self, x: Array, u: Array, u_prev: Array, y_ref: Array, p: Array | None) -> float:
        """Return the cost of one period by the plant's state at its end, the terminal weight left out."""
        ocp = self.ocp
        y, g = (np.array(value).ravel() for value in self._outputs(x, u, self._nominal if p is None else p))
        e, du, (z, Z) = y - y_ref, u - u_prev, self._slack_weights
        s = np.maximum(0.0, np.maximum(g - ocp.ug, ocp.lg - g))
        return float(e @ ocp.Q_at(0) @ e + du @ ocp.R_at(0) @ du + z @ s + 0.5 * s @ (Z * s))


def paper_ocp(N: int) -> Ocp:
    """Return the paper's problem."""
    return Ocp(pioneer_3dx(), N=N, dt=0.1, method="euler", Q=[1, 1, 0.05], **COST_WEIGHTS, **INPUT_BOUNDS, **SPEED_BOUNDS)


def paper(N: int) -> Family:
    """Return the paper's problem on its two trajectories."""
    driven = (eight(), 800), (positioning(), 400)
    legs = [(reference_rows(trajectory, count, N), np.array([*trajectory.pose0, 0.0, 0.0])) for trajectory, count in driven]

    def at(k: int) -> tuple[Array, None]:
        leg, j = divmod(k, 800)
        return legs[leg][0][j + 1 : j + 1 + N], None

    return Family(paper_ocp(N), 1200, at, lambda k: legs[k // 800][1] if k % 800 == 0 else None, substeps=20)


def tight(N: int) -> Family:
    """Return the eight with bounds on speeds below the needed ones: most samples are at softened bounds and at slew limits."""
    bounds: dict[str, Any] = {
        "lbx": [-INF, -INF, -INF, -0.02, -0.25],
        "ubx": [INF, INF, INF, 0.17, 0.25],
        "lbdu": [-0.05, -0.08],
        "ubdu": [0.05, 0.08],
    }
    ocp = Ocp(pioneer_3dx(), N=N, dt=0.1, Q=[1, 1, 0], **COST_WEIGHTS, **INPUT_BOUNDS, **bounds)
    y, x0 = reference_rows(eight(), 600, N), np.array([*eight().pose0, 0.0, 0.0])
    return Family(ocp, 600, lambda k: (y[k + 1 : k + 1 + N], None), once(x0))


def reference_rows(trajectory: Trajectory, samples: int, N: int) -> Array:
    """Return rows of a trajectory for so many samples of 0.1 s and the horizon after them, headings nearest to the pose at the start."""
    y = rows(trajectory.lasting(0.1 * (samples + N + 2)), 0.1, "tangent")
    y[:, 2] += 2.0 * np.pi * np.round((trajectory.pose0[2] - y[0, 2]) / (2.0 * np.pi))
    return y


def once(x0: Array) -> Start:
    """Return a start at sample 0 only."""
    return lambda k: x0 if k == 0 else None


def discs(N: int, centres: list[tuple[float, float, float]], speeds: list[tuple[float, float]], end_m: float) -> Family:
    """Return a straight line at 0.25 m/s among discs, each with x, y, radius in m and a velocity in m/s."""
    model = with_obstacles(pioneer_3dx(), centres)
    ocp = Ocp(model, N=N, dt=0.1, Q=[1, 1, 0], lh=0.0, **COST_WEIGHTS, **INPUT_BOUNDS, **INCREMENT_BOUNDS, **SPEED_BOUNDS)
    own, placed, moving = np.array(pioneer_3dx().p_nominal), np.array(centres), np.array([(*speed, 0.0) for speed in speeds])

    def at(k: int) -> tuple[Array, Array]:
        t = 0.1 * np.arange(k, k + N + 1)
        y = np.stack([np.minimum(0.25 * t, end_m), 0.0 * t, 0.0 * t], axis=-1)[1:]
        where = placed + t[:, None, None] * moving
        return y, np.hstack([np.tile(own, (N + 1, 1)), where.reshape(N + 1, -1)])

    return Family(ocp, 240, at, once(np.array([0.0, 0.02, 0.0, 0.0, 0.0])), body=pioneer_3dx())


def discs_passed(N: int) -> Family:
    """Return the line among three discs that leave a way past them."""
    return discs(N, [(1.0, 0.05, 0.3), (2.0, -0.1, 0.3), (3.0, 1.0, 0.3)], [(0, 0), (0, 0), (0, -0.07)], 4.0)


def discs_blocked(N: int) -> Family:
    """Return the line with three discs side by side that block it."""
    return discs(N, [(1.5, -0.6, 0.35), (1.5, 0.0, 0.35), (1.5, 0.6, 0.35)], [(0, 0)] * 3, 4.0)


def slalom(N: int) -> Family:
    """Return the line among six discs, one of them moving, to be passed on alternating sides."""
    centres = [(0.8, 0.1, 0.3), (1.6, -0.15, 0.3), (2.4, 0.15, 0.3), (3.2, -0.1, 0.3), (4.0, 0.1, 0.3), (2.4, -0.9, 0.3)]
    return discs(N, centres, [(0, 0)] * 5 + [(0, 0.05)], 5.0)


def signals(letter: str, count: int) -> tuple[Signal, ...]:
    """Return signals without names of their own."""
    return tuple(Signal(f"{letter}{i}", "1") for i in range(count))


def plain(name: str, x: ca.SX, u: ca.SX, f: ca.SX, u_rest: tuple[float, ...] = ()) -> Model:
    """Return a model whose outputs are its states."""
    rest: dict[str, Any] = {"u_rest": u_rest} if u_rest else {}
    nx, nu = x.numel(), u.numel()
    return Model(name=name, x=x, u=u, f_expl_expr=f, y_expr=x, states=signals("x", nx), inputs=signals("u", nu), outputs=signals("y", nx), **rest)


def quadrotor_model() -> Model:
    """Return a rigid quadrotor of 1 kg: position, quaternion, velocity, body rates; thrusts of four rotors, N."""
    mass, arm, drag, gravity, inertia = 1.0, 0.17, 0.016, 9.81, ca.DM([0.0082, 0.0082, 0.0149])
    x, thrust = ca.SX.sym("x", 13), ca.SX.sym("u", 4)
    (w, i, j, k), velocity, rate = ca.vertsplit(x[3:7]), x[7:10], x[10:13]
    up = ca.vertcat(2 * (i * k + w * j), 2 * (j * k - w * i), 1 - 2 * (i**2 + j**2))
    turning = ca.vertcat(-i, w, k, -j), ca.vertcat(-j, -k, w, i), ca.vertcat(-k, j, -i, w)
    torque = ca.vertcat(arm * (thrust[1] - thrust[3]), arm * (thrust[2] - thrust[0]), drag * (thrust[0] - thrust[1] + thrust[2] - thrust[3]))
    f = ca.vertcat(
        velocity,
        0.5 * sum((turning[axis] * rate[axis] for axis in range(3)), ca.SX.zeros(4)),
        up * ca.sum1(thrust) / mass - ca.DM([0.0, 0.0, gravity]),
        (torque - ca.cross(rate, inertia * rate)) / inertia,
    )
    return plain("quadrotor", x, thrust, f, u_rest=(mass * gravity / 4,) * 4)


def quadrotor(N: int, *, bounded: bool = False) -> Family:
    """Return jumps between eight points, one every 3 s."""
    lbx, ubx = np.full(13, -INF), np.full(13, INF)
    if bounded:
        lbx[7:10], ubx[7:10], lbx[10:13], ubx[10:13] = -2.5, 2.5, -3.0, 3.0  # m/s and rad/s
    Q, Q_e = [10.0] * 3 + [1.0] * 4 + [0.5] * 3 + [0.1] * 3, [50.0] * 3 + [1.0] * 4 + [5.0] * 3 + [0.1] * 3
    ocp = Ocp(quadrotor_model(), N=N, dt=0.05, Q=Q, Q_e=Q_e, R=[0.05] * 4, lbu=0.0, ubu=4.0, lbx=lbx, ubx=ubx, z=100.0, Z=100.0)
    points = np.array([[0, 0, 0], [2, 0, 1], [2, 2, 0], [-1, 2, 1.5], [0, -2, 0.5], [1.5, 1, 2], [-2, -1, 0.5], [0, 0, 1]], dtype=np.float64)
    level: Array = np.zeros(13)
    level[3] = 1.0

    def at(k: int) -> tuple[Array, None]:
        y = np.tile(level, (N, 1))
        y[:, :3] = points[k // 60]
        return y, None

    return Family(ocp, 480, at, once(level))


def quadrotor_bounded(N: int) -> Family:
    """Return the same with bounds on speeds and body rates, which act in every jump."""
    return quadrotor(N, bounded=True)


def cart_pole(N: int) -> Family:
    """Return swing-ups of a pole on a cart, from hanging and from five random states."""
    cart, pole, length, gravity, force = 1.0, 0.1, 0.8, 9.81, 20.0
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 1)
    _, theta, v, omega = ca.vertsplit(x)
    c, s = ca.cos(theta), ca.sin(theta)
    moved = cart + pole - pole * c**2
    f = ca.vertcat(
        v,
        omega,
        (-pole * length * s * omega**2 + pole * gravity * c * s + u) / moved,
        (-pole * length * c * s * omega**2 + u * c + (cart + pole) * gravity * s) / (length * moved),
    )
    bounds: dict[str, Any] = {"lbu": -force, "ubu": force, "lbx": [-1.5, -INF, -INF, -INF], "ubx": [1.5, INF, INF, INF], "z": 100.0, "Z": 100.0}
    ocp = Ocp(plain("cart_pole", x, u, f), N=N, dt=0.05, Q=[10, 10, 0.1, 0.1], R=[0.01], **bounds)
    rng = np.random.default_rng(5)
    starts = [np.array([0.0, np.pi, 0.0, 0.0])]
    starts += [np.array([rng.uniform(-1, 1), np.pi + rng.uniform(-0.5, 0.5), 0.0, rng.uniform(-1, 1)]) for _ in range(5)]
    return Family(ocp, 600, lambda _: (np.zeros((N, 4)), None), lambda k: starts[k // 100] if k % 100 == 0 else None, substeps=10)


def chain(N: int, masses: int) -> Family:
    """Return a hanging chain between a fixed point and one whose velocity is commanded, with a wall, disturbed six times [Wirsching2006]."""
    hung, free = hanging_chain(masses, drag=0.0), masses - 2
    nx = hung.nx
    x = ca.SX.sym("x", nx)  # deviation from rest
    model = plain(f"chain_{masses}", x, hung.u, ca.substitute(hung.f_expl_expr, hung.x, x + ca.DM(hung.x_nominal)))
    lbx = np.full(nx, -INF)
    lbx[1 : 3 * (free + 1) : 3] = -0.05  # m: the wall
    Q = [2.0] * (3 * free) + [2.5] * 3 + [0.25] * (3 * free)
    ocp = Ocp(model, N=N, dt=0.2, Q=Q, R=[0.1] * 3, lbu=-1.0, ubu=1.0, lbx=lbx, z=1e3, Z=1e3)
    plant, rng, starts = integrator(model, "rk4", 10), np.random.default_rng(3), []
    for disturbed in range(6):
        push = rng.uniform(-1.0, 1.0, 3)
        push[1] = abs(push[1])
        push = np.array([-1.0, 1.0, 1.0]) if disturbed == 0 else push / np.abs(push).max()
        state: Array = np.zeros(nx)
        for _ in range(5):
            state = np.array(plant(state, push, [], 0.2)).ravel()
        starts.append(state)
    return Family(ocp, 240, lambda _: (np.zeros((N, nx)), None), lambda k: starts[k // 40] if k % 40 == 0 else None, substeps=10)


def chain_3(N: int) -> Family:
    """Return the chain of three masses, 9 states."""
    return chain(N, 3)


def chain_5(N: int) -> Family:
    """Return the chain of five masses, 21 states."""
    return chain(N, 5)


def chain_7(N: int) -> Family:
    """Return the chain of seven masses, 33 states."""
    return chain(N, 7)


def restarts(N: int) -> Family:
    """Return 80 cold starts of the shipped problem from random states on random lines, five samples each."""
    ocp = Ocp(pioneer_3dx(), N=N, dt=0.1, Q=[1, 1, 0.05], **COST_WEIGHTS, **INPUT_BOUNDS, **INCREMENT_BOUNDS, **SPEED_BOUNDS)
    rng, starts, lines = np.random.default_rng(11), [], []
    t = 0.1 * np.arange(N + 7)
    for _ in range(80):
        starts.append(np.concatenate([rng.uniform(-1, 1, 2), [rng.uniform(-np.pi, np.pi), rng.uniform(-0.5, 0.5), rng.uniform(-0.745, 0.745)]]))
        heading, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 0.4)
        from_x, from_y = rng.uniform(-1, 1, 2)
        lines.append(np.stack([from_x + speed * t * np.cos(heading), from_y + speed * t * np.sin(heading), heading + 0.0 * t], axis=1))

    def at(k: int) -> tuple[Array, None]:
        run, j = divmod(k, 5)
        return lines[run][j + 1 : j + 1 + N], None

    return Family(ocp, 400, at, lambda k: starts[k // 5] if k % 5 == 0 else None)


# Each with the horizons it is measured at unless told otherwise.
FAMILIES: dict[str, tuple[Callable[[int], Family], tuple[int, ...]]] = {
    "paper": (paper, (7, 20, 50, 100, 200)),
    "tight": (tight, (20, 50)),
    "discs_passed": (discs_passed, (20,)),
    "discs_blocked": (discs_blocked, (20,)),
    "slalom": (slalom, (20, 50)),
    "quadrotor": (quadrotor, (20,)),
    "quadrotor_bounded": (quadrotor_bounded, (20,)),
    "cart_pole": (cart_pole, (40,)),
    "chain_3": (chain_3, (40,)),
    "chain_5": (chain_5, (40,)),
    "chain_7": (chain_7, (40,)),
    "restarts": (restarts, (20,)),
}
