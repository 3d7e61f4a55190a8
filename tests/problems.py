# SPDX-License-Identifier: Apache-2.0
"""Optimal control problems that tests share, small ones first."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti

INF = np.inf
SHARED = 64  # problems that are kept, a few MB each


def shared(build: Callable[..., Ocp]) -> Callable[..., Ocp]:
    """
    Return one object for equal changes: expressions of a problem are built once an object, see `rti_mpc.rti.construction`.

    Changes that cannot be pickled, such as expressions, give a new one.
    """

    @lru_cache(SHARED)
    def built(pickled: bytes) -> Ocp:
        return build(**dict(pickle.loads(pickled)))

    @wraps(build)
    def one(**changes: Any) -> Ocp:
        try:
            pickled = pickle.dumps(sorted(changes.items()))
        except Exception:  # CasADi's own
            return build(**changes)
        return built(pickled)

    return one


@shared
def double_integrator(**changes: Any) -> Ocp:
    """A mass on a line, 2 states, 1 input, linear: position and speed follow a reference."""
    x = ca.SX.sym("x", 2)
    u = ca.SX.sym("u")
    model = Model(
        name="double_integrator",
        x=x,
        u=u,
        f_expl_expr=ca.vertcat(x[1], u),
        y_expr=x,
        states=(Signal("r", "m"), Signal("v", "m/s")),
        inputs=(Signal("a", "m/s^2"),),
        outputs=(Signal("r", "m"), Signal("v", "m/s")),
    )
    return Ocp(model, **({"N": 10, "dt": 0.1, "Q": [1.0, 0.1], "R": [0.05]} | changes))


@shared
def beacon(**changes: Any) -> Ocp:
    """A unicycle that sees the range and the bearing of a beacon, 3 states, 2 inputs: outputs not linear, a parameter in them, no bounds."""
    x = ca.SX.sym("x", 3)
    u = ca.SX.sym("u", 2)
    p = ca.SX.sym("p", 2)
    dx, dy = p[0] - x[0], p[1] - x[1]
    model = Model(
        name="beacon",
        x=x,
        u=u,
        p=p,
        f_expl_expr=ca.vertcat(u[0] * ca.cos(x[2]), u[0] * ca.sin(x[2]), u[1]),
        y_expr=ca.vertcat(ca.sqrt(dx**2 + dy**2), ca.atan2(dy, dx) - x[2]),
        states=(Signal("x", "m"), Signal("y", "m"), Signal("psi", "rad", angle=True)),
        inputs=(Signal("v", "m/s"), Signal("omega", "rad/s")),
        outputs=(Signal("range", "m"), Signal("bearing", "rad", angle=True)),
        parameters=(Signal("x_b", "m"), Signal("y_b", "m")),
        p_nominal=(5.0, 3.0),
    )
    return Ocp(model, **({"N": 6, "dt": 0.1, "Q": [[2.0, 0.3], [0.3, 1.0]], "R": [[1.0, 0.2], [0.2, 0.5]]} | changes))


PAPER: dict[str, Any] = {
    "N": 7,
    "dt": 0.1,
    "Q": [1.0, 1.0, 0.05],
    "R": [1.0, 1.0],
    "delta": 28.0,
    "lambda_": 0.8,
    "lbu": [-0.5, -0.745],
    "ubu": [0.5, 0.745],
    "lbx": [-INF, -INF, -INF, -0.5, -0.745],
    "ubx": [INF, INF, INF, 0.5, 0.745],
}
SLEW: dict[str, Any] = {"lbdu": [-0.25, -0.4], "ubdu": [0.25, 0.4]}


def new_pioneer(**changes: Any) -> Ocp:
    """The paper's robot with the shipped configuration's bounds, 5 states, 2 inputs: everything at once."""
    return Ocp(pioneer_3dx(), **(PAPER | SLEW | changes))


pioneer = shared(new_pioneer)


@shared
def fenced(**changes: Any) -> Ocp:
    """The paper's robot beside a disc, its power limited by an input at once, and a terminal weight: general constraints in x, u and p."""
    model = pioneer_3dx()
    x, y = model.x[0], model.x[1]
    constraints = {
        "h_expr": ca.vertcat((x - 1) ** 2 + (y - model.p[6]) ** 2, model.x[3] * model.u[0]),
        "lh": [0.2, -INF],
        "uh": [INF, 0.1],
        "zh": [5.0, 7.0],
        "Zh": [2.0, 3.0],
    }
    weights = {"Q": [[1.0, 0.1, 0.0], [0.1, 1.0, 0.0], [0.0, 0.0, 0.05]], "Q_e": [[9.0, 1.0, 0.0], [1.0, 8.0, 0.0], [0.0, 0.0, 0.5]]}
    return Ocp(model, **(PAPER | SLEW | constraints | weights | changes))


def arc(t: Array, psi0: float = 0.0) -> Array:
    """Rows ``x, y, psi`` of the paper's eight and its tangent at times t, shape ``(N, 3)``; psi nearest to `psi0` at the start."""
    psi = np.unwrap(np.arctan2(np.cos(t / 5) / 5, np.cos(t / 10) / 10))
    return np.column_stack([np.sin(t / 10), np.sin(t / 5), psi + 2 * np.pi * np.round((psi0 - psi[0]) / (2 * np.pi))])


def cart(newtons: float = 1.0) -> Model:
    """A vehicle of 1500 kg, 2 states, 1 input, linear: its drive force in units of so many N."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    return Model(
        name="cart",
        x=x,
        u=u,
        f_expl_expr=ca.vertcat(x[1], (u * newtons - 200 * x[1]) / 1500),
        y_expr=x[0],
        states=(Signal("r", "m"), Signal("v", "m/s")),
        inputs=(Signal("F", "N"),),
        outputs=(Signal("r", "m"),),
    )


def tank() -> Model:
    """A tank that flows out with the root of its level, which has no derivative at zero and is none below; 1 state, 1 input."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    return Model("tank", x, u, u - 0.5 * ca.sqrt(x), x, Signal("h", "m"), Signal("q", "m^2/s"), "h", x_nominal=1.0, u_rest=0.5)


def solve(one: Rti, seed: int) -> QpStatus:
    """Solve at a guess that depends on nothing but the seed."""
    rng = np.random.default_rng(seed)
    one.x[:] = rng.normal(size=one.x.shape)
    one.u[:] = 0.1 * rng.normal(size=one.u.shape)
    one.u_prev[:] = 0.0
    one.prepare(rng.normal(size=one.y_ref.shape), shift=False)
    return one.feedback(rng.normal(size=one.ocp.model.nx))
