# SPDX-License-Identifier: Apache-2.0
r"""
The optimal control problem of one sample, frozen and validated.

Over stages of `dt` seconds, with the outputs :math:`y_i = y(x_i, u_{i-1}, p_i)` (`y_expr`), the
general constraints :math:`h(x, u, p)` (`h_expr`), the previous input :math:`u_{-1}`, and
inputs held after the control horizon, or over the stages of each of :math:`N_u` blocks,

.. math::

    \min \; & \sum_{i=1}^{N} \delta_i \|y_i - y_{ref,i}\|_Q^2
            + \sum_{i=1}^{N_u} \lambda_i \|u_{i-1} - u_{i-2}\|_R^2
            + \sum_{i=1}^{N_u} \|u_{i-1} - u_{ref,i-1}\|_{R_u}^2
            + \|y_N - y_{ref,N}\|_{Q_e}^2
            + \sum_{i=1}^{N} \left( z_i^T s_i + \tfrac12 s_i^T Z_i s_i \right) \\
    \text{s.t.} \; & x_{k+1} = \phi(x_k, u_k, p_k), \quad x_0 \text{ given}, \\
    & lbu \le u_k \le ubu, \quad lbdu \le u_k - u_{k-1} \le ubdu, \\
    & lbx - s_i \le x_i \le ubx + s_i, \quad
      lh - s_i \le h(x_i, u_{i-1}, p_i) \le uh + s_i, \quad s_i \ge 0 , \\
    & lbddu - s_k \le u_k - 2 u_{k-1} + u_{k-2} \le ubddu + s_k, \quad s_k \ge 0 , \\
    & lbx_e - s_e \le x_N \le ubx_e + s_e, \quad s_e \ge 0 .

This is the cost (4) of [Rosales]_ in full, with an additional terminal weight.
Bounds on states, on second differences of inputs and general constraints, each with its
own slacks, are softened by an exact penalty, so that no measurement makes the problem
infeasible. Outputs, constraints, bounds and slack weights have the names of acados
[Verschueren2022]_.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.errors import OcpError
from rti_mpc.model.expressions import column, from_text, to_text
from rti_mpc.model.integrator import TABLEAUS, steps
from rti_mpc.model.model import IRK, Model
from rti_mpc.signals import quantity

DISCRETE = "discrete"  # method of a problem whose model is in discrete time
PAIRS = (("lbu", "ubu"), ("lbdu", "ubdu"), ("lbx", "ubx"), ("lh", "uh"))  # bounds that may differ from stage to stage, both of them then
DEFAULT_SLACK_WEIGHT = 1e3  # L1 weight, in cost per unit of the state, and L2 weight, in cost per unit squared


@dataclass(frozen=True, eq=False, init=False)
class Ocp:
    r"""
    An optimal control problem. All arguments are checked, and all arrays are copies and read-only.

    Attributes:
        model: Dynamics and outputs.
        N: Horizon, in stages.
        N_u: Control horizon, ``1 <= N_u <= N``; `N` by default. The number of blocks, if these are given.
        blocks: Stages of each block, over which its input is held (move blocking); together `N`. Those of a control horizon are one stage long, but
            the last, which holds to the end. Increments, their weights `lambda_` and bounds, and `R_u` count once a block, at its first stage.
        dt: Duration of a stage, s.
        method: Integrator of a stage: ``"rk4"``, ``"irk"``, Radau IIA, for a stiff model, or ``"euler"``; the model's own by default. Any but
            ``"euler"`` becomes the model's, as do the two below, so that all that predict with it have the same integrator. ``"discrete"`` for a
            model in discrete time, whose period `dt` must be.
        Q: Output weight, shape ``(ny, ny)``, or given by its diagonal; cost / unit of the outputs squared.
        R: Increment weight, shape ``(nu, nu)``, or given by its diagonal; cost / unit of the inputs squared.
        delta: Penalty sequence on outputs, shape ``(N,)``, or given as a constant; or one for each output, shape ``(N, ny)``, so that weights differ
            from stage to stage: stage i weighs by :math:`D_i^{1/2} Q D_i^{1/2}`, which for a diagonal Q is :math:`D_i Q`, see `Q_at`.
        lambda_: Penalty sequence on increments, shape ``(N_u,)``, or given as a constant; or one for each input, shape ``(N_u, nu)``, which weighs by
            :math:`L_k^{1/2} R L_k^{1/2}`, see `R_at`.
        lbu: Lower bound on inputs, shape ``(nu,)``; none by default, as for the following. Bounds of inputs and increments may have a row per block,
            shape ``(N_u, nu)``, those of states a row per node, ``(N, nx)``, those of h ``(N, nh)``; an upper bound then has one if its lower one
            has, see `widest` and `tightest`.
        ubu: Upper bound on inputs, shape ``(nu,)``.
        lbdu: Lower bound on the increment of inputs from stage to stage, shape ``(nu,)``.
        ubdu: Upper bound on the increment of inputs, shape ``(nu,)``.
        lbx: Softened lower bound on states at nodes 1 to N, shape ``(nx,)``.
        ubx: Softened upper bound on states, shape ``(nx,)``.
        z: L1 weight of the slacks, shape ``(nx,)``, or given as a constant; cost / unit of the state. As the three other weights of slacks of states
            and of h it may have a row per node, ``(N, nx)``: the last one is that of the end of the horizon.
        Z: L2 weight of the slacks, shape ``(nx,)``, or given as a constant; cost / unit of the state squared.
        lbx_e: Softened lower bound on states at node N alone, besides `lbx`, shape ``(nx,)``: a terminal set. Its slacks have the weights `z`, `Z`
            of node N.
        ubx_e: Softened upper bound on states at node N alone, shape ``(nx,)``.
        Q_e: Terminal weight, added to ``delta_N Q``, shape ``(ny, ny)``, or given by its diagonal; none by default.
        R_u: Weights of inputs themselves, beside those of their increments, shape ``(nu,)``, or ``(N_u, nu)``; none by default; cost / unit of the
            inputs squared.
        u_ref: Inputs from which `R_u` counts, an expression in the model's p, shape ``(nu, 1)``, or given by numbers; those at rest by default.
        h_expr: General constraints h(x, u, p) in the model's symbols, shape ``(nh, 1)``; the model's by default.
        lh: Softened lower bound on h, shape ``(nh,)``.
        uh: Softened upper bound on h, shape ``(nh,)``.
        zh: L1 weight of the slacks of h, shape ``(nh,)``, or given as a constant.
        Zh: L2 weight of the slacks of h, shape ``(nh,)``, or given as a constant.
        lbddu: Softened lower bound on the second difference of inputs, the change of the increment from stage to stage (jerk, where an increment
            is an acceleration), from the last two inputs before the plan on, shape ``(nu,)``; in the unit of the input per stage squared, as
            increments are per stage. See `rti_mpc.rti.second_difference`.
        ubddu: Softened upper bound on the second difference of inputs, shape ``(nu,)``.
        zddu: L1 weight of the slacks of second differences, shape ``(nu,)``, or given as a constant.
        Zddu: L2 weight of the slacks of second differences, shape ``(nu,)``, or given as a constant.

    Raises:
        OcpError: An argument does not fit; the message names it, and what it must be. A rest input other than zero must be inside the bounds, and
            from any input inside the bounds of the first block, those of each following block must be reachable inside those of increments.
    """

    model: Model
    N: int
    N_u: int
    blocks: tuple[int, ...]
    dt: float
    method: str
    Q: Array
    R: Array
    delta: Array
    lambda_: Array
    lbu: Array
    ubu: Array
    lbdu: Array
    ubdu: Array
    lbx: Array
    ubx: Array
    z: Array
    Z: Array
    Q_e: Array
    h_expr: ca.SX
    lh: Array
    uh: Array
    zh: Array
    Zh: Array
    lbx_e: Array
    ubx_e: Array
    R_u: Array
    u_ref: ca.SX
    lbddu: Array
    ubddu: Array
    zddu: Array
    Zddu: Array

    def __init__(
        self,
        model: Model,
        *,
        N: int,
        dt: float,
        Q: ArrayLike,
        R: ArrayLike,
        N_u: int | None = None,
        blocks: Sequence[int] | None = None,
        method: str | None = None,
        sim_method_num_stages: int | None = None,
        sim_method_num_steps: int | None = None,
        delta: ArrayLike = 1.0,
        lambda_: ArrayLike = 1.0,
        lbu: ArrayLike = -np.inf,
        ubu: ArrayLike = np.inf,
        lbdu: ArrayLike = -np.inf,
        ubdu: ArrayLike = np.inf,
        lbx: ArrayLike = -np.inf,
        ubx: ArrayLike = np.inf,
        z: ArrayLike = DEFAULT_SLACK_WEIGHT,
        Z: ArrayLike = DEFAULT_SLACK_WEIGHT,
        Q_e: ArrayLike | None = None,
        h_expr: ca.SX | None = None,
        lh: ArrayLike = -np.inf,
        uh: ArrayLike = np.inf,
        zh: ArrayLike = DEFAULT_SLACK_WEIGHT,
        Zh: ArrayLike = DEFAULT_SLACK_WEIGHT,
        lbx_e: ArrayLike = -np.inf,
        ubx_e: ArrayLike = np.inf,
        R_u: ArrayLike = 0.0,
        u_ref: ca.SX | ArrayLike | None = None,
        lbddu: ArrayLike = -np.inf,
        ubddu: ArrayLike = np.inf,
        zddu: ArrayLike = DEFAULT_SLACK_WEIGHT,
        Zddu: ArrayLike = DEFAULT_SLACK_WEIGHT,
    ) -> None:
        given.instance("model", model, Model)
        if absent := [name for name in ("states", "inputs", "outputs") if not getattr(model, name)]:
            raise OcpError(f"model {model.name} must have {' and '.join(absent)} for a problem, got none")
        N = given.whole("N", N, 1)
        if blocks is None:
            N_u = N if N_u is None else given.whole("N_u", N_u, 1)
            if N_u > N:
                raise OcpError(f"N_u and N must satisfy 1 <= N_u <= N, got N_u = {N_u}, N = {N}")
            blocks = [1] * (N_u - 1) + [N - N_u + 1]
        try:
            blocks = stages_of_blocks(blocks, N)
            if N_u not in (None, len(blocks)):
                raise OcpError(f"N_u must be left out where blocks are given: it is their number, got N_u = {N_u}, blocks = {given.quoted(blocks)}")
        except OcpError as error:
            # `dataclasses.replace` gives both, and what has a row per stage or block.
            hint = (
                ""
                if N_u is None
                else "; in a copy of another problem blocks=None makes them anew from N and N_u, and lambda_ and delta must fit them"
            )
            raise OcpError(f"{error}{hint}") from None
        if not (np.isfinite(seconds := given.number("dt", dt)) and seconds > 0):
            raise OcpError(f"dt must be a positive number of seconds, got {dt}")
        model = integrated(model, method, sim_method_num_stages, sim_method_num_steps, seconds)
        method = DISCRETE if model.dt is not None else model.method if method is None else method
        h_expr = model.h_expr if h_expr is None else column("h_expr", h_expr)
        if isinstance(h_expr, ca.MX):
            raise OcpError(f"h_expr must be SX, of the model's x, u, p, or be given to the Model, got {given.quoted(h_expr)}")
        nh = h_expr.numel()
        free = [s for s in ca.symvar(h_expr) if not ca.depends_on(ca.vertcat(model.x, model.u, model.p), s)]
        if free or (nh and h_expr.shape != (nh, 1)):
            raise OcpError(f"h_expr must be a column of the model's x, u, p, got shape {h_expr.shape} and {free or 'nothing'} besides")
        inputs = column("u_ref", model.u_rest if u_ref is None else u_ref)
        if isinstance(inputs, ca.MX) or inputs.shape != (model.nu, 1) or [s for s in ca.symvar(inputs) if not ca.depends_on(model.p, s)]:
            raise OcpError(f"u_ref must be {model.nu} numbers, or SX of the model's p, in a column, got {given.quoted(inputs)}")
        if not all(inputs[j].is_regular() for j in range(model.nu) if inputs[j].is_constant()):
            raise OcpError(f"u_ref must be finite, got {given.quoted(inputs)}")
        fields: dict[str, Any] = {"model": model, "N": N, "N_u": len(blocks), "blocks": blocks, "dt": seconds, "method": method}
        fields |= {"h_expr": h_expr, "u_ref": inputs}
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        values = {"Q": Q, "R": R, "delta": delta, "lambda_": lambda_, "lbu": lbu, "ubu": ubu, "lbdu": lbdu, "ubdu": ubdu, "lbx": lbx, "ubx": ubx}
        values |= {"z": z, "Z": Z, "Q_e": np.zeros(model.ny) if Q_e is None else Q_e, "lh": lh, "uh": uh, "zh": zh, "Zh": Zh}
        values |= {"lbx_e": lbx_e, "ubx_e": ubx_e, "R_u": R_u, "lbddu": lbddu, "ubddu": ubddu, "zddu": zddu, "Zddu": Zddu}
        self._take(values)

    def __copy__(self) -> Ocp:
        """Return this problem: nothing in it changes, see `retuned`."""
        return self

    def __deepcopy__(self, memo: Any) -> Ocp:
        """As a copy."""
        return self

    def __getstate__(self) -> tuple[dict[str, Any], str]:
        """Return the fields for a pickle, expressions as text beside the model's symbols."""
        fields, model = dict(vars(self)), self.model
        own = {name: fields.pop(name) for name in ("h_expr", "u_ref")}
        return fields, to_text({"x": model.x, "u": model.u, "p": model.p} | own)

    def __setstate__(self, state: tuple[dict[str, Any], str]) -> None:
        """Take the fields of a pickle; expressions become those of its model's symbols."""
        fields, text = state
        model: Model = fields["model"]
        x, u, p, *own = from_text(("x", "u", "p", "h_expr", "u_ref"), text).values()
        h_expr, u_ref = ca.substitute(own, [x, u, p], [model.x, model.u, model.p])
        vars(self).update(fields | {"h_expr": h_expr, "u_ref": u_ref})
        for name in WEIGHTS_AND_BOUNDS:
            getattr(self, name).setflags(write=False)

    def retuned(self, **values: ArrayLike) -> Ocp:
        """
        Return this problem with other weights and bounds, by their names; no expression is built.

        Raises:
            OcpError: As at construction.
        """
        other = object.__new__(type(self))
        vars(other).update(vars(self))
        other._take(values)
        return other

    def checked(self, name: str, value: ArrayLike) -> Array:
        """
        Return a copy of a weight or bound in the shape that it has here, checked by itself.

        Raises:
            OcpError: The name is none, or the value wrong by itself, as at construction.
        """
        sizes = {"nx": self.model.nx, "nu": self.model.nu, "ny": self.model.ny, "nh": self.h_expr.numel(), "N": self.N, "N_u": self.N_u}
        check, size, *each = WEIGHTS_AND_BOUNDS[given.one_of("the name of a weight or bound", name, WEIGHTS_AND_BOUNDS)]
        shape = [sizes[one] for one in each]
        return by_stage(name, value, check, sizes[size], *shape) if shape else check(name, value, sizes[size])

    def check_compiled(self, name: str, value: Array) -> None:
        """
        Refuse a weight or bound that changes what the code of this problem was compiled for.

        Raises:
            OcpError: Its shape is another, it is finite elsewhere, or inputs are to have weights that had none.
        """
        mine = getattr(self, name)
        if value.shape != mine.shape:
            what = "whether it differs from stage to stage is part of the compiled code"
            raise OcpError(f"{name} must keep its shape {mine.shape}, got {value.shape}: {what}")
        if not np.array_equal(np.isfinite(value), np.isfinite(mine)):
            raise OcpError(f"{name} must be finite exactly where it was when compiled, got {value.tolist()}")
        if name == "R_u" and value.any() and not mine.any():
            raise OcpError(f"R_u must stay zero, as it was when compiled, got {value.tolist()}")

    def _take(self, values: Mapping[str, ArrayLike]) -> None:
        """Check and copy weights and bounds; only for an object that nobody reads yet."""
        for name, value in values.items():
            array = self.checked(name, value)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        for pair in PAIRS:
            bounds = getattr(self, pair[0]), getattr(self, pair[1])
            if bounds[0].ndim != bounds[1].ndim:
                for name, rows in zip(pair, (bound.copy("C") for bound in np.broadcast_arrays(*bounds)), strict=True):
                    rows.setflags(write=False)
                    object.__setattr__(self, name, rows)
        if wrong := where(self.lbu > self.ubu, self.lbu, self.ubu):
            raise OcpError(f"lbu must not lie above ubu, got {wrong}")
        for lower, upper in (("lbx", "ubx"), ("lh", "uh"), ("lbx_e", "ubx_e")):
            bounds = getattr(self, lower), getattr(self, upper)
            if wrong := where(bounds[0] >= bounds[1], *bounds):
                raise OcpError(f"{lower} must lie below {upper}, got {wrong}")
        if wrong := sign_fault(self):
            raise OcpError(wrong)
        if any(self.model.u_rest) and (wrong := rest_fault(self)):
            raise OcpError(wrong)
        if wrong := where((self.lbdu > 0) | (self.ubdu < 0), self.lbdu, self.ubdu):
            raise OcpError(f"lbdu <= 0 <= ubdu must hold, or no input could be kept, got {wrong}")
        if not np.all((self.lbddu < 0) & (self.ubddu > 0)):
            raise OcpError(f"lbddu < 0 < ubddu must hold, or no increment could be kept and changed, got {self.lbddu} and {self.ubddu}")
        if wrong := pace_fault(self):
            raise OcpError(wrong)

    def Q_at(self, k: int) -> Array:
        """Return the weight of outputs at node ``k + 1``, without the terminal weight, shape ``(ny, ny)``."""
        if self.delta.ndim == 1:
            return np.asarray(self.delta[k] * self.Q)
        root = np.sqrt(self.delta[k])
        return np.asarray(self.Q * np.outer(root, root))

    def R_at(self, k: int) -> Array:
        """Return the weight of the increments of block ``k``, shape ``(nu, nu)``."""
        if self.lambda_.ndim == 1:
            return np.asarray(self.lambda_[k] * self.R)
        root = np.sqrt(self.lambda_[k])
        return np.asarray(self.R * np.outer(root, root))

    def widest(self, name: str) -> Array:
        """Return a bound over all stages, the loosest of each signal, shape ``(n,)``: infinite where a stage has none; what a robot may ever do."""
        rows = np.atleast_2d(getattr(self, given.one_of("the name of a bound", name, BOUNDS)))
        return np.asarray((rows.min if name.startswith("l") else rows.max)(axis=0))

    def tightest(self, name: str) -> Array:
        """Return the tightest bound of each signal over all stages, shape ``(n,)``: infinite where no stage has one."""
        rows = np.atleast_2d(getattr(self, given.one_of("the name of a bound", name, BOUNDS)))
        return np.asarray((rows.max if name.startswith("l") else rows.min)(axis=0))

    @property
    def held(self) -> NDArray[np.int_]:
        """Row of the inputs that acts at each stage, shape ``(N,)``."""
        return np.repeat(np.arange(self.N_u), self.blocks)

    @property
    def starts(self) -> NDArray[np.int_]:
        """First stage of each block, shape ``(N_u,)``."""
        return np.cumsum((0, *self.blocks[:-1]))

    @property
    def soft(self) -> tuple[int, ...]:
        """Indices of the states with a bound, each of which has one slack per node."""
        return tuple(int(j) for j in np.flatnonzero(np.isfinite(self.tightest("lbx")) | np.isfinite(self.tightest("ubx"))))

    @property
    def soft_e(self) -> tuple[int, ...]:
        """Indices of the states with a bound at node N alone, each of which has one slack more."""
        return tuple(int(j) for j in np.flatnonzero(np.isfinite(self.lbx_e) | np.isfinite(self.ubx_e)))

    @property
    def soft_ddu(self) -> tuple[int, ...]:
        """Indices of the inputs with a bound on their second difference."""
        return tuple(int(j) for j in np.flatnonzero(np.isfinite(self.lbddu) | np.isfinite(self.ubddu)))

    @property
    def ng_path(self) -> int:
        """Number of softened bounds that act at every node; those of `soft_e` follow them."""
        return len(self.soft) + self.h_expr.numel()

    @property
    def ng(self) -> int:
        """Number of softened bounds."""
        return self.ng_path + len(self.soft_e)

    @property
    def lg(self) -> Array:
        """Softened lower bounds: of the states in `soft`, of `h_expr`, then of the states in `soft_e`; ``(ng,)``, or ``(N, ng)`` if any has rows."""
        return self.softened(self.lbx, self.lh, self.lbx_e)

    @property
    def ug(self) -> Array:
        """Softened upper bounds, as `lg`."""
        return self.softened(self.ubx, self.uh, self.ubx_e)

    def softened(self, of_states: Array, of_constraints: Array, of_end: Array) -> Array:
        """Return what the softened bounds have by these weights or bounds, in the order of `lg`, with a row per node if any has rows."""
        parts = [of_states[..., list(self.soft)], of_constraints, of_end[..., list(self.soft_e)]]
        if max(part.ndim for part in parts) == 1:
            return np.concatenate(parts)
        return np.hstack([np.broadcast_to(part, (self.N, part.shape[-1])) for part in parts])

    def phi(self) -> ca.Function:
        """One stage of the dynamics, ``phi(x, u, p) -> x_next``."""
        model = self.model
        return ca.Function("phi", [model.x, model.u, model.p], [self.stage()[0]], ["x", "u", "p"], ["x_next"])

    def stage(self, *, derivatives: bool = False) -> tuple[ca.SX, ...]:
        """Return the state after a stage, and its derivatives in x and u if they are asked for, as expressions of the model's symbols."""
        return steps(self.model, self.dt, self.method, derivatives=derivatives)[: 3 if derivatives else 1]


def integrated(model: Model, method: str | None, stages: int | None, steps: int | None, dt: float) -> Model:
    """
    Return a model with another integrator, None for its own.

    Raises:
        OcpError: The integrator is unknown, or the model is one in discrete time and has none, or another period.
    """
    own = {"sim_method_num_stages": stages, "sim_method_num_steps": steps, "method": None if method == "euler" else method}
    changes: dict[str, Any] = {name: value for name, value in own.items() if value is not None}
    if method is not None:
        given.one_of("method", method, (*TABLEAUS, IRK))
    if model.dt is not None:
        if changes or method is not None:
            raise OcpError(f"model {model.name} is in discrete time: integrator, stages and steps must be left out, got {method or changes}")
        if not np.isclose(model.dt, dt, rtol=1e-9, atol=0.0):
            raise OcpError(f"dt must be the period of model {model.name}, which is in discrete time, {model.dt:g} s, got {dt:g}")
    return replace(model, **changes) if changes else model


def stages_of_blocks(blocks: Sequence[int], N: int) -> tuple[int, ...]:
    """
    Return the lengths of blocks as they are kept.

    Raises:
        OcpError: One is no whole number of at least 1, or they do not fill the horizon.
    """
    if not isinstance(blocks, Sequence | np.ndarray) or isinstance(blocks, str) or not len(blocks):
        raise OcpError(f"blocks must be a list of the stages of each block, got {given.quoted(blocks)}")
    lengths = tuple(given.whole("each of blocks", length, 1) for length in blocks)
    if sum(lengths) != N:
        raise OcpError(f"blocks must have N = {N} stages together, got {sum(lengths)} in {list(lengths)}")
    return lengths


def rest_fault(ocp: Ocp) -> str:
    """
    Return why a robot could not be brought to its rest input inside the bounds, empty if it can.

    A problem whose rest input is zero may exclude it; a controller that must stop a robot may not.
    """
    bounds = [ocp.tightest(name) for name in ("lbu", "ubu", "lbdu", "ubdu")]
    for signal, rest, *limits in zip(ocp.model.inputs, ocp.model.u_rest, *bounds, strict=True):
        lower, upper, falling, rising = map(float, limits)
        if not lower <= rest <= upper:
            at = quantity(rest, signal.unit, "g")
            return f"the bounds of input {signal.name} must hold its rest, {at}, or it could not be stopped, got {[lower, upper]}"
        if not falling < 0.0 < rising:
            return f"the increments of input {signal.name} must hold lower < 0 < upper, or it could not be stopped, got {[falling, rising]}"
    return ""


def sign_fault(ocp: Ocp) -> str:
    """Return which bounds of a quaternion a state breaks that is the same attitude with the other sign; empty if none."""
    for j in itertools.chain(*ocp.model.rotations("states").quaternions):
        for lower, upper in (("lbx", "ubx"), ("lbx_e", "ubx_e")):
            bounds = np.atleast_2d(np.column_stack([getattr(ocp, name)[..., j] for name in (lower, upper)]))
            for least, most in bounds.tolist():
                if least != -most:
                    of = "terminal bounds" if lower == "lbx_e" else "bounds"
                    right = min(abs(least), abs(most))
                    return (
                        f"{of} of state {ocp.model.states[j].name} of a quaternion must be as far from 0 on both sides, such as "
                        f"[{-right:g}, {right:g}], since q and -q are one attitude, got [{least:g}, {most:g}]"
                    )
    return ""


def where(wrong: NDArray[np.bool_], lower: Array, upper: Array) -> str:
    """Write the bounds that are wrong, those of the first row where there are several; empty if none are."""
    if not np.any(wrong):
        return ""
    if wrong.ndim == 1:
        return f"{lower} and {upper}"
    k = int(np.argmax(wrong.any(axis=1)))
    return f"{lower[k]} and {upper[k]} in row {k}"


def pace_fault(ocp: Ocp) -> str:
    """Return which inputs could not keep the bounds of all blocks from anywhere in those of the first, inside their increments; empty if all can."""
    if ocp.lbu.ndim == 1:
        return ""
    falling, rising = (np.broadcast_to(bound, ocp.lbu.shape) for bound in (ocp.lbdu, ocp.ubdu))
    low, high = ocp.lbu[-1], ocp.ubu[-1]
    for k in reversed(range(ocp.N_u - 1)):  # those from which the bounds after block k can be kept
        low, high = np.maximum(ocp.lbu[k], low - rising[k + 1]), np.minimum(ocp.ubu[k], high - falling[k + 1])
    for j, signal in enumerate(ocp.model.inputs):
        if low[j] > ocp.lbu[0, j] or high[j] < ocp.ubu[0, j]:
            first, able = (f"[{least[j]:g}, {most[j]:g}]" for least, most in ((ocp.lbu[0], ocp.ubu[0]), (low, high)))
            told = f"from anywhere in those of the first, {first}, inside its increments"
            return f"bounds of input {signal.name} must be reached in every block {told}, got bounds that can be reached from {able} alone"
    return ""


def weights(name: str, value: ArrayLike, length: int) -> Array:
    """Return finite weights >= 0 of shape ``(length,)``, given so or as a constant."""
    array = vector(name, value, length)
    if not np.all(np.isfinite(array)) or np.any(array < 0):
        raise OcpError(f"{name} must be finite and not negative, got {array.tolist()}")
    return array


def by_stage(name: str, value: ArrayLike, check: Callable[[str, ArrayLike, int], Array], length: int, stages: int, size: int) -> Array:
    """Return a copy of weights or bounds of shape ``(stages, size)``, or, where they are no rows, of shape ``(length,)``, as `check` does."""
    array = given.numbers(name, value)
    if array.ndim < 2 or (hasattr(value, "full") and array.shape == (length, 1)):
        return check(name, value, length)
    if array.shape != (stages, size):
        raise OcpError(f"{name} must be a number or have shape ({length},), or ({stages}, {size}), a row per stage, got shape {array.shape}")
    return check(name, array.ravel(), stages * size).reshape(stages, size)


def weight_matrix(name: str, value: ArrayLike, size: int) -> Array:
    """Return a finite symmetric positive semidefinite matrix, given so or by its diagonal."""
    array = given.numbers(name, value)
    if array.shape == (size,) or (size == 1 and array.shape == ()) or (hasattr(value, "full") and array.shape == (size, 1)):
        array = np.diag(array.reshape(size))
    if array.shape != (size, size):
        raise OcpError(f"{name} must have shape ({size}, {size}) or be its diagonal ({size},), got shape {array.shape}")
    if (
        not np.all(np.isfinite(array))
        or not np.array_equal(array, array.T)
        or np.linalg.eigvalsh(array).min(initial=0.0) < -1e-12 * np.abs(array).max()
    ):
        raise OcpError(f"{name} must be finite, symmetric and positive semidefinite, got {array.tolist()}")
    return array.copy()


def bound(name: str, value: ArrayLike, length: int) -> Array:
    """Return bounds of shape ``(length,)``, given so or as a constant; infinite where there is none."""
    array = vector(name, value, length)
    if np.any(np.isnan(array)):
        raise OcpError(f"{name} must not be NaN, got {array.tolist()}")
    impossible = np.inf if name.startswith("l") else -np.inf
    if np.any(array == impossible):
        raise OcpError(
            f"{name} must lie {'below inf' if impossible > 0 else 'above -inf'}, {-impossible:g} where there is no bound, got {array.tolist()}"
        )
    return array


def vector(name: str, value: ArrayLike, length: int) -> Array:
    """Return a copy of shape ``(length,)`` of an array or a constant."""
    array = given.numbers(name, value)
    if hasattr(value, "full") and array.shape == (length, 1):  # a column of CasADi's
        array = array[:, 0]
    if array.shape not in ((), (length,)):
        raise OcpError(f"{name} must be a number or have shape ({length},), got shape {array.shape}")
    return np.array(np.broadcast_to(array, (length,)))


# Weights and bounds by the attributes of the Ocp, with the function that checks and copies each, the name of its length, and, where it may
# differ from stage to stage, the names of its rows' number and length. They may change between samples.
WEIGHTS_AND_BOUNDS: dict[str, tuple[Any, ...]] = {
    "Q": (weight_matrix, "ny"),
    "R": (weight_matrix, "nu"),
    "delta": (weights, "N", "N", "ny"),
    "lambda_": (weights, "N_u", "N_u", "nu"),
    "lbu": (bound, "nu", "N_u", "nu"),
    "ubu": (bound, "nu", "N_u", "nu"),
    "lbdu": (bound, "nu", "N_u", "nu"),
    "ubdu": (bound, "nu", "N_u", "nu"),
    "lbx": (bound, "nx", "N", "nx"),
    "ubx": (bound, "nx", "N", "nx"),
    "z": (weights, "nx", "N", "nx"),
    "Z": (weights, "nx", "N", "nx"),
    "Q_e": (weight_matrix, "ny"),
    "lh": (bound, "nh", "N", "nh"),
    "uh": (bound, "nh", "N", "nh"),
    "zh": (weights, "nh", "N", "nh"),
    "Zh": (weights, "nh", "N", "nh"),
    "lbx_e": (bound, "nx"),
    "ubx_e": (bound, "nx"),
    "R_u": (weights, "nu", "N_u", "nu"),
    "lbddu": (bound, "nu"),
    "ubddu": (bound, "nu"),
    "zddu": (weights, "nu"),
    "Zddu": (weights, "nu"),
}

BOUNDS = (*itertools.chain(*PAIRS), "lbx_e", "ubx_e", "lbddu", "ubddu", "lg", "ug")  # by name; the last two are the softened ones of all kinds

# Those that compiled functions have as arguments, in this order; those of second differences are among lh, uh, zh and Zh there.
ARGUMENTS = tuple(name for name in WEIGHTS_AND_BOUNDS if name not in ("lbddu", "ubddu", "zddu", "Zddu"))
