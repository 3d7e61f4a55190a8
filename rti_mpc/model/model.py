# SPDX-License-Identifier: Apache-2.0
r"""
Model of a robot as CasADi expressions, with names and units: dynamics, outputs and general constraints.

In continuous time the dynamics are :math:`\dot x = f(x, u, p)`, in discrete time :math:`x_{k+1} = F(x_k, u_k, p)`.

The attributes have the names of acados (`f_expl_expr`), so that a model written for it
can be reused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from rti_mpc import given
from rti_mpc.errors import OcpError
from rti_mpc.model.expressions import from_text, to_sx, to_text
from rti_mpc.rotation import Rotations
from rti_mpc.signals import ROLES_OF_VECTOR, misplaced, signals
from rti_mpc.signals import Signal as Signal

SYMBOLS, EXPRESSIONS, VALUES = ("x", "u", "p"), ("y_expr", "h_expr"), ("p_nominal", "u_rest", "x_nominal")
OPTIONAL_EXPRESSIONS = ("f_expl_expr", "disc_dyn_expr", "stop_expr")
IRK = "irk"
METHODS = ("rk4", IRK)  # by which a model is integrated; Euler is one for the stages of a problem only
MAX_IMPLICIT_STAGES = 3
MAX_STEPS = 1000  # each is written out in the expressions of a stage, which take some 20 s to build with that many
LEFT_OUT: Any = None  # in place of an expression that a model does not have


@dataclass(frozen=True, eq=False)
class Model:
    """
    A model in continuous time, or in discrete time.

    Expressions may also be given in MX or as lists of components, signals as names alone, and a vector of one entry as that entry. The attributes
    are as documented all the same.

    Attributes:
        name: Name of the model, as in the configuration.
        x: State symbol, shape ``(nx, 1)``.
        u: Input symbol, shape ``(nu, 1)``.
        p: Parameter symbol, shape ``(np, 1)``.
        f_expl_expr: Right-hand side f(x, u, p) in continuous time, shape ``(nx, 1)``; None in discrete time.
        y_expr: Output y(x, u, p), shape ``(ny, 1)``; in the cost, u is the input of the stage before the node. An angle must not depend on u.
        states: Names and units of `x`.
        inputs: Names and units of `u`.
        outputs: Names and units of `y_expr`.
        parameters: Names and units of `p`.
        h_expr: General constraints h(x, u, p), which may be bounded like states, shape ``(nh, 1)``; none by default.
        constraints: Names and units of `h_expr`.
        p_nominal: Values of `p`, unless a reference carries others.
        u_rest: Input at which the robot stands still; zeros by default.
        stop_expr: Input to command next while coming to rest, of x, u (the last input that acted) and p, shape ``(nu, 1)``; derived by default
            where inputs at rest do not stop the robot.
        x_nominal: State around which the model is finite and differentiable, where solvers start and scales are found; if it is left out, zero or,
            where the model is singular there, a state that is looked for.
        disc_dyn_expr: State after one period, of x, u and p, shape ``(nx, 1)``, in discrete time; None in continuous time.
        dt: The period of a model in discrete time, s; None in continuous time.
        method: How the model is integrated by all who predict with it: ``"rk4"``, or ``"irk"`` for a stiff one, which is Radau IIA.
        sim_method_num_stages: Stages of an implicit step, 1 to 3, of order 1, 3 and 5.
        sim_method_num_steps: Steps into which the integrator divides what it integrates over, at most 1000.
        quaternions: Names of w, x, y, z of each attitude, of outputs, of states or of both. Of outputs the cost weighs not the differences from the
            reference, but the small angles between the two, see `residual`: w has no weight, x, y, z those of angles in rad about the axes of the
            body. Of states, that they have length 1 and may be written with either sign is known to the controller, to the guard and to ways to rest.

    Raises:
        OcpError: An argument, a dimension, a name or a free symbol does not fit.
    """

    name: str
    x: ca.SX
    u: ca.SX
    f_expl_expr: ca.SX = LEFT_OUT
    y_expr: ca.SX = LEFT_OUT  # this and the next three are needed; that f_expl_expr may be left out gives them defaults
    states: tuple[Signal, ...] = ()
    inputs: tuple[Signal, ...] = ()
    outputs: tuple[Signal, ...] = ()
    p: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    parameters: tuple[Signal, ...] = ()
    p_nominal: tuple[float, ...] = ()
    h_expr: ca.SX = field(default_factory=lambda: ca.SX(0, 1))
    constraints: tuple[Signal, ...] = ()
    u_rest: tuple[float, ...] = ()
    stop_expr: ca.SX | None = None
    x_nominal: tuple[float, ...] = ()
    disc_dyn_expr: ca.SX = LEFT_OUT
    dt: float | None = None
    method: str = "rk4"
    sim_method_num_stages: int = 2
    sim_method_num_steps: int = 1
    quaternions: tuple[tuple[str, str, str, str], ...] = ()

    def __post_init__(self) -> None:
        """Take what is given in other forms, and check that names, dimensions and symbols fit together."""
        if not isinstance(self.name, str):
            raise OcpError(f"name of a model must be text, got {given.quoted(self.name)}")
        if not (self.name.strip() and self.name.isprintable()):
            raise OcpError(f"name of a model must be printable, in one line, got {self.name!r}")
        try:
            for name, value in (self._taken() | self._checked_integration()).items():
                object.__setattr__(self, name, value)
        except OcpError as error:
            raise OcpError(f"model {self.name}: {error}") from None
        if not self.u_rest:
            object.__setattr__(self, "u_rest", (0.0,) * len(self.inputs))
        object.__setattr__(self, "quaternions", quaternions_of(self))
        laws = self.dynamics if self.stop_expr is None else {**self.dynamics, "stop_expr": self.stop_expr}
        expressions = {**laws, "y_expr": self.y_expr, "h_expr": self.h_expr}
        columns = {"x": self.x, "u": self.u, "p": self.p, **expressions}
        for name, expr in columns.items():
            if expr.numel() and expr.shape[1] != 1:
                raise OcpError(f"model {self.name}: {name} must be a column, of shape {(expr.numel(), 1)}, got shape {expr.shape}")
        for label, got, like in (
            ("states", len(self.states), "x"),
            ("inputs", len(self.inputs), "u"),
            ("outputs", len(self.outputs), "y_expr"),
            ("parameters", len(self.parameters), "p"),
            ("constraints", len(self.constraints), "h_expr"),
            *((name, expr.numel(), "u" if name == "stop_expr" else "x") for name, expr in laws.items()),
            ("p_nominal", len(self.p_nominal), "p"),
            ("u_rest", len(self.u_rest), "u"),
            ("x_nominal", len(self.x_nominal) or self.nx, "x"),
        ):
            if got != columns[like].numel():
                raise OcpError(f"model {self.name}: {label} must have {columns[like].numel()} entries, as {like} has, got {got}")
        for vector in ROLES_OF_VECTOR:
            signals: tuple[Signal, ...] = getattr(self, vector)
            names = [signal.name for signal in signals]
            if len(set(names)) < len(names):
                raise OcpError(f"model {self.name}: names must be unique within a vector, got {names}")
            if wrong := misplaced(vector, signals, self.states):
                raise OcpError(f"model {self.name}: {wrong}")
        for output, state in zip(self.outputs, states_among(self.y_expr, self.x, self.states), strict=True):
            if state is not None and state.angle is not output.angle:
                told = f"output {output.name} is the state {state.name}, both or none must be an angle"
                raise OcpError(f"model {self.name}: {told}, got angle={output.angle} and angle={state.angle}")
        for output, y_i in zip(self.outputs, ca.vertsplit(self.y_expr), strict=True):
            if output.angle and depends_on(y_i, self.u):
                raise OcpError(f"model {self.name}: output {output.name} is an angle and must not depend on u, got {y_i}")
        known = {symbol.element_hash() for symbol in ca.symvar(ca.vertcat(self.x, self.u, self.p))}
        for label, expr in expressions.items():
            free = [str(s) for s in ca.symvar(expr) if s.element_hash() not in known]
            if free:
                raise OcpError(f"model {self.name}: {label} must depend only on x, u, p, also has {', '.join(free)}")

    def _taken(self) -> dict[str, Any]:
        """Return fields as they are documented, by name, from what was given."""
        named = (*(name for name in OPTIONAL_EXPRESSIONS if getattr(self, name) is not None), *EXPRESSIONS)
        symbols, expressions = ({name: getattr(self, name) for name in names} for names in (SYMBOLS, named))
        columns = to_sx(symbols, expressions)
        vectors = {vector: signals(vector, getattr(self, vector)) for vector in ROLES_OF_VECTOR if vector != "outputs"}
        vectors["outputs"] = signals("outputs", self.outputs, states_among(columns["y_expr"], columns["x"], vectors["states"]))
        values = {name: given.numbers(name, getattr(self, name)).ravel() for name in VALUES}
        for name, array in values.items():
            if not np.isfinite(array).all():
                raise OcpError(f"{name} must be finite, got {array.tolist()}")
        return {**columns, **vectors, **{name: tuple(array.tolist()) for name, array in values.items()}}

    def _checked_integration(self) -> dict[str, Any]:
        """Return the fields that say how the model moves on in time, checked."""
        if len(self.dynamics) != 1:
            both = "both" if self.dynamics else "neither"
            raise OcpError(f"f_expl_expr must be given in continuous time, or disc_dyn_expr and dt in discrete time, got {both}")
        if (self.disc_dyn_expr is None) is not (self.dt is None):
            raise OcpError(f"dt must be the period of disc_dyn_expr in s, given with it only, got {self.dt}")
        dt = None if self.dt is None else given.number("dt", self.dt)
        if dt is not None and not (np.isfinite(dt) and dt > 0):
            raise OcpError(f"dt must be a positive number of seconds, got {dt}")
        stages = given.whole("sim_method_num_stages", self.sim_method_num_stages, 1)
        if stages > MAX_IMPLICIT_STAGES:
            raise OcpError(f"sim_method_num_stages must be at most {MAX_IMPLICIT_STAGES}, got {stages}")
        steps = given.whole("sim_method_num_steps", self.sim_method_num_steps, 1)
        if steps > MAX_STEPS:
            raise OcpError(f"sim_method_num_steps must be at most {MAX_STEPS}, got {steps}")
        given.one_of("method", self.method, METHODS)
        return {"dt": dt, "sim_method_num_steps": steps}

    def __copy__(self) -> Model:
        """Return this model: nothing in it changes, and expressions of its symbols stay such."""
        return self

    def __deepcopy__(self, memo: Any) -> Model:
        """As a copy."""
        return self

    def __getstate__(self) -> tuple[dict[str, Any], tuple[str, ...], str]:
        """Return the fields for a pickle, expressions as text."""
        fields = dict(vars(self))
        names = [name for name in (*SYMBOLS, *EXPRESSIONS, *OPTIONAL_EXPRESSIONS) if fields[name] is not None]
        columns = {name: fields.pop(name) for name in names}
        return fields, tuple(columns), to_text(columns)

    def __setstate__(self, state: tuple[dict[str, Any], tuple[str, ...], str]) -> None:
        """Take the fields of a pickle."""
        fields, names, text = state
        vars(self).update(fields | from_text(names, text))

    @property
    def dynamics(self) -> dict[str, ca.SX]:
        """The dynamics as they were given, by the name of the attribute."""
        return {name: expr for name in ("f_expl_expr", "disc_dyn_expr") if (expr := getattr(self, name)) is not None}

    @property
    def rate_expr(self) -> ca.SX:
        """Rates of the states: f(x, u, p), or in discrete time the mean rates over a period; shape ``(nx, 1)``."""
        return self.f_expl_expr if self.dt is None else (self.disc_dyn_expr - self.x) / self.dt

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    @property
    def np_(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def outputs_of_inputs(self) -> bool:
        """Whether an output depends on inputs."""
        return depends_on(self.y_expr, self.u)

    def h(self) -> ca.Function:
        """Return the outputs at a node, ``h(x, p) -> y``; of inputs at rest, where they depend on inputs."""
        y_expr = ca.substitute(self.y_expr, self.u, ca.DM(self.u_rest)) if self.outputs_of_inputs else self.y_expr
        return ca.Function("h", [self.x, self.p], [ca.densify(y_expr)], ["x", "p"], ["y"])

    def outputs_at(self) -> ca.Function:
        """Return the outputs at a node and the input before it, ``(x, u, p) -> y``."""
        return ca.Function("outputs_at", [self.x, self.u, self.p], [ca.densify(self.y_expr)], ["x", "u", "p"], ["y"])

    def residual(self, y: Any, y_ref: Any) -> Any:
        r"""
        Return what the cost weighs of outputs beside their reference, each an expression of shape ``(ny, 1)``: their difference.

        Of a quaternion q beside :math:`q_{ref}`, of any length and sign, it is :math:`(0, 2 \, \mathrm{vec}(\bar q_{ref} q))`: for small errors
        the angles in rad about the axes of the body. It grows up to half a turn, and the shorter way round is taken.
        """
        e = ca.vertsplit(y - y_ref)
        for places in map(list, self.rotations("outputs").quaternions):
            for i, part in zip(places, ca.vertsplit(small_angles(y[places], y_ref[places])), strict=True):
                e[i] = part
        return ca.vertcat(*e)

    def rotations(self, vector: str) -> Rotations:
        """Return the rotations among ``states`` or ``outputs``; states that are outputs belong to a quaternion as those do, whatever their names."""
        if vector == "outputs":
            return Rotations.of(self.outputs, self.quaternions)
        states = {output.name: name for output, name in zip(self.outputs, self.counterparts()["outputs"], strict=True)}
        known = {state.name for state in self.states}
        quaternions = [tuple(name if name in known else states.get(name, name) for name in names) for names in self.quaternions]
        return Rotations.of(self.states, quaternions)

    def counterparts(self) -> dict[str, list[str]]:
        """Return, for each of the ``inputs`` and ``outputs``, the name of the state that it commands or is; empty where there is none."""
        return {
            "inputs": [signal.commands for signal in self.inputs],
            "outputs": ["" if state is None else state.name for state in states_among(self.y_expr, self.x, self.states)],
        }

    def with_parameters(self, **values: float) -> Model:
        """
        Return this model with other nominal parameters.

        Raises:
            OcpError: A name is not a parameter of this model.
        """
        names = [signal.name for signal in self.parameters]
        for name in values:
            if name not in names:
                raise OcpError(f"model {self.name} has parameters {', '.join(names) or 'none'}, got {name}")
            given.number(f"parameter {name} of model {self.name}", values[name])
        return replace(self, p_nominal=tuple(values.get(n, v) for n, v in zip(names, self.p_nominal, strict=True)))


def quaternions_of(model: Model) -> tuple[tuple[str, str, str, str], ...]:
    """
    Return the quaternions of a model, checked; one alone may be given without a tuple around it.

    Raises:
        OcpError: One is not the names of four outputs, or four states, that are no angles.
    """
    listed: Any = model.quaternions
    if isinstance(listed, tuple | list) and listed and all(isinstance(name, str) for name in listed):
        listed = (listed,)
    vectors = [{signal.name for signal in signals if not signal.angle} for signals in (model.outputs, model.states)]
    for names in listed if isinstance(listed, tuple | list) else (listed,):
        four = set(filter(lambda name: isinstance(name, str), names)) if isinstance(names, tuple | list) else set()
        if len(four) != 4 or len(names) != 4 or not any(four <= plain for plain in vectors):
            told = "quaternions must be names of four outputs or of four states each, w, x, y, z, no angles"
            raise OcpError(f"model {model.name}: {told}, got {given.quoted(names)}")
    return tuple(tuple(names) for names in listed)


def small_angles(q: ca.SX, q_ref: ca.SX) -> ca.SX:
    """Return zero and the small angles from one attitude to another, quaternions w, x, y, z of any length and sign; shape ``(4, 1)``."""
    q_ref = q_ref + ca.vertcat(ca.sumsqr(q_ref) == 0, 0, 0, 0)  # none is given: as if it were 1
    (w, x, y, z), (w_r, x_r, y_r, z_r) = ca.vertsplit(q), ca.vertsplit(q_ref)
    real = w_r * w + x_r * x + y_r * y + z_r * z
    vector = ca.vertcat(w_r * x - x_r * w - y_r * z + z_r * y, w_r * y - y_r * w - z_r * x + x_r * z, w_r * z - z_r * w - x_r * y + y_r * x)
    return ca.vertcat(0, 2 * ca.if_else(real < 0, -1, 1) * vector / ca.sqrt(ca.sumsqr(q) * ca.sumsqr(q_ref)))


def depends_on(expr: ca.SX, symbol: ca.SX) -> bool:
    """Return whether an expression depends on a symbol; not if it cancels out, as in a mean rate ``(x + v - x) / dt``."""
    return not ca.jacobian(expr, symbol).is_zero()


def states_among(y_expr: ca.SX, x: ca.SX, states: Sequence[Signal]) -> list[Signal | None]:
    """Return for each output the state that it is, None for one that is something else; nothing where shapes do not fit."""
    if not (x.is_column() and y_expr.is_column()):
        return []
    named = {x_j.element_hash(): state for x_j, state in zip(ca.vertsplit(x), states, strict=False)}
    return [named.get(y_i.element_hash()) for y_i in ca.vertsplit(ca.densify(y_expr))]
