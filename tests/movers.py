# SPDX-License-Identifier: Apache-2.0
"""Robots that inputs at rest neither stop nor hold: driven by accelerations, forces and torques."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.model.model import Model, Signal
from rti_mpc.rti.kept_law import find_kept_stop_law
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.way_to_rest import StopLaw
from tests.problems import INF, pioneer

GRAVITY = 9.81  # m/s^2
BOUNDS = ("lbx", "ubx", "lbu", "ubu")
PATHS: dict[str, Callable[[Array], tuple[Array, Array]]] = {  # of the two outputs that a robot follows, over the time in s
    "car": lambda t: (3 * np.sin(t / 3), 3 - 3 * np.cos(t / 3)),
    "bicycle": lambda t: (8 * np.sin(t / 8), 8 - 8 * np.cos(t / 8)),
    "arm": lambda t: (0.5 * np.sin(t), -0.5 * np.sin(t)),
    "quadrotor": lambda t: (2 * np.sin(t / 3), 0.5 * np.sin(t / 3)),
    "floating": lambda t: (4 * np.sin(t / 8), 4 - 4 * np.cos(t / 8)),
}
SAMPLED = {"floating": (40, 0.05, 1e-4)}  # N, dt in s and R where others fit: thrusts of tens of newtons, without slew limits
FOLLOWED = {"car": "x y", "bicycle": "x y", "floating": "x y", "arm": "q_1 q_2", "quadrotor": "x z"}  # outputs of a robot on a reference


def mover(name: str, states: str, inputs: str, f: Callable[[Any, Any], tuple[Any, ...]], **options: Any) -> Ocp:
    """A robot of derivatives f(x, u), whose outputs are its states; signals are given as ``name:unit``."""
    signals = tuple(Signal(*each.split(":"), angle=each.endswith(":rad")) for each in states.split())
    driven = tuple(Signal(*each.split(":")) for each in inputs.split())
    x, u = ca.SX.sym("x", len(signals)), ca.SX.sym("u", len(driven))
    own = {key: options.pop(key) for key in ("u_rest", "stop_expr") if key in options}
    if callable(own.get("stop_expr")):
        own["stop_expr"] = own["stop_expr"](x, u)
    model = Model(name=name, x=x, u=u, f_expl_expr=ca.vertcat(*f(x, u)), y_expr=x, states=signals, inputs=driven, outputs=signals, **own)
    return Ocp(model, **({"N": 10, "dt": 0.05, "Q": np.ones(len(signals)), "R": 0.01 * np.ones(len(driven))} | options))


def car(**changes: Any) -> Ocp:
    """README's car, driven by acceleration and curvature."""

    def f(x: Any, u: Any) -> tuple[Any, ...]:
        return x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), x[3] * u[1], u[0]

    bounds = {"lbx": [-INF] * 3 + [0], "ubx": [INF] * 3 + [3], "lbu": [-2, -0.5], "ubu": [2, 0.5]}
    return mover("car", "x:m y:m psi:rad v:m/s", "a:m/s^2 kappa:1/m", f, **(bounds | changes))


def bicycle(**changes: Any) -> Ocp:
    """Acceleration and steering rate, with slew limits."""

    def f(x: Any, u: Any) -> tuple[Any, ...]:
        return x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), x[3] * ca.tan(x[4]) / 2.5, u[0], u[1]

    bounds = {"lbx": [-INF] * 3 + [0, -0.5], "ubx": [INF] * 3 + [3, 0.5], "lbu": [-2, -1], "ubu": [2, 1], "lbdu": -0.3, "ubdu": 0.3}
    return mover("bicycle", "x:m y:m psi:rad v:m/s delta:rad", "a:m/s^2 rate:rad/s", f, **(bounds | changes))


def arm(**changes: Any) -> Ocp:
    """Two links of 1 kg and 0.5 m in a vertical plane, driven by torques."""
    length, centre, inertia = 0.5, 0.25, 0.02

    def f(x: Any, u: Any) -> tuple[Any, ...]:
        q_1, q_2, w_1, w_2 = ca.vertsplit(x)
        near, far, coupled = 2 * inertia + 2 * centre**2 + length**2, inertia + centre**2, length * centre
        mass = near + 2 * coupled * ca.cos(q_2), far + coupled * ca.cos(q_2), far
        turning = coupled * ca.sin(q_2)
        weight_2 = centre * GRAVITY * ca.cos(q_1 + q_2)
        torque_1 = u[0] + turning * w_2 * (2 * w_1 + w_2) - (centre + length) * GRAVITY * ca.cos(q_1) - weight_2
        torque_2 = u[1] - turning * w_1**2 - weight_2
        determinant = mass[0] * mass[2] - mass[1] ** 2
        return w_1, w_2, (mass[2] * torque_1 - mass[1] * torque_2) / determinant, (mass[0] * torque_2 - mass[1] * torque_1) / determinant

    bounds = {"lbx": [-3, -2.5, -3, -3], "ubx": [3, 2.5, 3, 3], "lbu": [-30, -15], "ubu": [30, 15]}
    return mover("arm", "q_1:rad q_2:rad w_1:rad/s w_2:rad/s", "t_1:Nm t_2:Nm", f, **({"dt": 0.02, **bounds} | changes))


def quadrotor(**changes: Any) -> Ocp:
    """In a vertical plane, 1 kg, driven by the thrusts of two rotors."""

    def f(x: Any, u: Any) -> tuple[Any, ...]:
        thrust = u[0] + u[1]
        return x[3], x[4], x[5], -thrust * ca.sin(x[2]), thrust * ca.cos(x[2]) - GRAVITY, 10 * (u[0] - u[1])

    bounds = {"lbx": [-INF, -INF, -0.5, -2, -2, -2], "ubx": [INF, INF, 0.5, 2, 2, 2], "lbu": 0, "ubu": 10, "u_rest": (GRAVITY / 2,) * 2}
    states = "x:m z:m theta:rad v_x:m/s v_z:m/s omega:rad/s"
    return mover("quadrotor", states, "f_1:N f_2:N", f, **(bounds | changes))


def boat(**changes: Any) -> Ocp:
    """Driven by a force and a moment, slowed down by the water; nothing moves it sideways."""

    def f(x: Any, u: Any) -> tuple[Any, ...]:
        c, s = ca.cos(x[2]), ca.sin(x[2])
        return x[3] * c - x[4] * s, x[3] * s + x[4] * c, x[5], (u[0] - 40 * x[3]) / 50, -x[4], (u[1] - 8 * x[5]) / 8

    bounds = {"lbx": [-INF] * 3 + [-2, -0.5, -1], "ubx": [INF] * 3 + [2, 0.5, 1], "lbu": [-60, -10], "ubu": [60, 10], "dt": 0.1}
    return mover("boat", "x:m y:m psi:rad v_x:m/s v_y:m/s r:rad/s", "X:N N:Nm", f, **(bounds | changes))


def carried(model: Model) -> Model:
    """The same on water that moves: its velocity is a parameter, nominally zero."""
    c = ca.SX.sym("c", 2)
    moved = model.f_expl_expr + ca.vertcat(c, ca.SX.zeros(model.nx - 2))
    return replace(model, p=c, f_expl_expr=moved, parameters=(Signal("c_x", "m/s"), Signal("c_y", "m/s")), p_nominal=(0.0, 0.0))


def cart_pole(**changes: Any) -> Ocp:
    """A pole of 0.8 m upright on a cart that is driven by a force."""

    def f(x: Any, u: Any) -> tuple[Any, ...]:
        _, theta, v, omega = ca.vertsplit(x)
        c, s = ca.cos(theta), ca.sin(theta)
        moved = 1.0 + 0.1 * s**2
        pulled = -0.08 * s * omega**2 + u
        return v, omega, (pulled + 0.1 * GRAVITY * c * s) / moved, (pulled * c + 1.1 * GRAVITY * s) / (0.8 * moved)

    bounds = {"lbx": [-1.5, -0.3, -1, -1], "ubx": [1.5, 0.3, 1, 1], "lbu": -20, "ubu": 20}
    return mover("cart_pole", "x:m theta:rad v:m/s omega:rad/s", "F:N", f, **(bounds | changes))


def floating(**changes: Any) -> Ocp:
    """The boat on water that moves."""
    still = boat()
    options = {"model": carried(still.model), "N": 10, "dt": 0.1, "Q": np.ones(6), "R": 0.01 * np.ones(2)}
    return Ocp(**(options | {name: getattr(still, name) for name in BOUNDS} | changes))


MOVERS: dict[str, Callable[..., Ocp]] = {
    "pioneer": pioneer,
    "car": car,
    "bicycle": bicycle,
    "arm": arm,
    "quadrotor": quadrotor,
    "boat": boat,
    "floating": floating,
    "cart_pole": cart_pole,
}


@cache
def ocp_of(name: str) -> Ocp:
    """The problem of one of these, built once."""
    return MOVERS[name]()


@cache
def law_of(name: str) -> StopLaw | None:
    """The law of one of these, found once for all processes of tests."""
    return find_kept_stop_law(ocp_of(name))


def following(name: str) -> Model:
    """One of these as its user would drive it: outputs are what it follows, with their roles."""
    model = ocp_of(name).model
    roles = {"x": "x", "y": "y", "psi": "heading"} if "y" in FOLLOWED[name].split() else {}
    states = tuple(replace(state, role=roles.get(state.name, "")) for state in model.states)
    followed = [i for i, state in enumerate(states) if state.name in FOLLOWED[name].split()]
    return replace(model, y_expr=model.x[followed], states=states, outputs=tuple(states[i] for i in followed))


def car_model() -> Model:
    return following("car")


def bicycle_model() -> Model:
    return following("bicycle")


def arm_model() -> Model:
    return following("arm")


def quadrotor_model() -> Model:
    return following("quadrotor")


def floating_model() -> Model:
    return following("floating")


def toml(name: str, more: str = "") -> str:
    """The configuration of one of these, driven behind a guard; `more` follows it."""
    ocp, model = ocp_of(name), following(name)
    N, dt, R = SAMPLED.get(name, (20, ocp.dt, 0.01))

    def table(signals: tuple[Signal, ...], lower: Any, upper: Any) -> str:
        bounded = [(each.name, low, high) for each, low, high in zip(signals, lower, upper, strict=True) if np.isfinite([low, high]).any()]
        return ", ".join(f"{each} = [{low}, {high}]" for each, low, high in bounded)

    return f"""
robot = "{name}"
model = {{ name = "tests.movers:{name}_model" }}
[ocp]
N = {N}
dt_s = {dt}
[ocp.weights]
Q = {{ {", ".join(f"{output.name} = 1.0" for output in model.outputs)} }}
R = {{ {", ".join(f"{signal.name} = {R}" for signal in model.inputs)} }}
[ocp.bounds]
inputs = {{ {table(model.inputs, ocp.lbu, ocp.ubu)} }}
increments = {{ {table(model.inputs, ocp.lbdu, ocp.ubdu)} }}
states = {{ {table(model.states, ocp.lbx, ocp.ubx)} }}
[guard]
enabled = true
{more}"""


CURRENT = """
[observer]
at_rest = true
disturbances = { x = { drift = 0.02, limit = 0.5 }, y = { drift = 0.02, limit = 0.5 } }
[sim]
parameters = { c_x = 0.2, c_y = -0.15 }
"""


def path_file(name: str, folder: Path) -> Path:
    """Write the path of one of these as a scenario of its outputs over ten minutes."""
    t, path = np.arange(0.0, 600.0, 0.1), folder / "path.csv"
    header = ",".join(("t", *(output.name for output in following(name).outputs)))
    np.savetxt(path, np.column_stack([t, *PATHS[name](t)]), delimiter=",", header=header, comments="", fmt="%.5f")
    return path
