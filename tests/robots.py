# SPDX-License-Identifier: Apache-2.0
"""Robots with unusual orders and names of signals; `tests.robots:NAME` in a configuration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca

from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.model.robots.unicycle import unicycle
from tests.units import PIONEER_TEXTS, with_units

OUTPUTS = (2, 0, 1)  # psi, x, y
SHIPPED = Path(__file__).parents[1] / "deploy" / "pioneer_3dx.toml"
STATES = (3, 2, 4, 0, 1)  # u, psi, omega, x, y


def shuffled() -> Model:
    """The paper's robot with its outputs and its states in another order."""
    model = pioneer_3dx()
    x = ca.SX.sym("z", 5)
    places = [STATES.index(j) for j in range(5)]
    f, y = (ca.substitute(expr, model.x, x[places]) for expr in (model.f_expl_expr[list(STATES)], model.y_expr[list(OUTPUTS)]))
    return replace(
        model,
        name="shuffled",
        x=x,
        f_expl_expr=f,
        y_expr=y,
        states=tuple(model.states[j] for j in STATES),
        outputs=tuple(model.outputs[i] for i in OUTPUTS),
    )


def pioneer() -> Model:
    """The paper's robot without roles, as one must be whose position is not in m."""
    return with_units(pioneer_3dx(), {})


def pioneer_in_other_units() -> Model:
    """The same in kilometres, millimetres, degrees and revolutions per minute."""
    return with_units(pioneer_3dx(), PIONEER_TEXTS)


def glider() -> Model:
    """A point moved by its velocity, without heading; its names usually mean something else, and its parameter `a` is not the axle's offset."""
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u", 2), ca.SX.sym("a")
    return Model(
        name="glider",
        x=x,
        u=u,
        p=p,
        f_expl_expr=p * u,
        y_expr=x,
        states=(Signal("psi", "m", role="x"), Signal("x", "m", role="y")),
        inputs=(Signal("u", "m/s"), Signal("v", "m/s")),
        outputs=(Signal("psi", "m", role="x"), Signal("x", "m", role="y")),
        parameters=(Signal("a", "1"),),
        p_nominal=(-1.0,),
    )


def rover() -> Model:
    """A unicycle, its position on the axle: a heading, and no offset."""
    return replace(unicycle(), name="rover", inputs=(Signal("v", "m/s"), Signal("w", "rad/s")))


def arm() -> Model:
    """Two joints, one of them named as if it were a position."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    joints = (Signal("x", "rad", angle=True), Signal("elbow", "rad", angle=True))
    return Model(
        name="arm", x=x, u=u, f_expl_expr=u, y_expr=x, states=joints, inputs=(Signal("w_1", "rad/s"), Signal("w_2", "rad/s")), outputs=joints
    )


def polar() -> Model:
    """A point whose direction from the origin is an output, undefined at the origin."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    return Model(
        name="polar",
        x=x,
        u=u,
        f_expl_expr=u,
        y_expr=ca.vertcat(x[0], x[1] / ca.norm_2(x)),
        states=(Signal("east", "m"), Signal("north", "m")),
        inputs=(Signal("v_east", "m/s"), Signal("v_north", "m/s")),
        outputs=(Signal("east", "m"), Signal("direction", "1")),
    )


def toml(name: str) -> str:
    """A configuration of one of these; that of the shipped robot where it is the same one."""
    if name == "shuffled":
        return SHIPPED.read_text().replace('name = "pioneer_3dx"', 'name = "tests.robots:shuffled"')
    model: Model = globals()[name]()
    Q = ", ".join(f"{signal.name} = {0.05 if signal.angle else 1.0}" for signal in model.outputs)
    R = ", ".join(f"{signal.name} = 1.0" for signal in model.inputs)
    limits, steps = (", ".join(f"{signal.name} = [-{most}, {most}]" for signal in model.inputs) for most in (1.0, 0.2))
    return f"""
robot = "{name}"
model = {{ name = "tests.robots:{name}" }}
[ocp]
N = 20
dt_s = 0.1
weights = {{ Q = {{ {Q} }}, R = {{ {R} }}, lambda = 0.01 }}
bounds = {{ inputs = {{ {limits} }}, increments = {{ {steps} }} }}
"""


def pushed() -> Model:
    """A mass that is pushed: an input of zero lets it coast."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    signals = {"states": (Signal("p", "m"), Signal("v", "m/s")), "inputs": (Signal("a", "m/s^2"),), "outputs": (Signal("p", "m"),)}
    return Model("pushed", x, u, ca.vertcat(x[1], u[0]), x[0], **signals)
