# SPDX-License-Identifier: Apache-2.0
r"""
The way to rest: inputs that bring a robot to a standstill, and the states along it.

Robots whose inputs command speeds need none: their inputs ramp to rest. For others a
law gives the next input from the state and the last input that acted, inside bounds
and slew limits. A model may give it (`Model.stop_expr`); otherwise it is derived. Near
the state lies a rest equilibrium, :math:`f(x_e, u_e, p) = 0`, found by Newton steps of
least length, in which what may rest anywhere, a position or a heading, does not move.
About it, with :math:`A, B` the dynamics over a row,

.. math::

    u = u_e - K (x - x_e), \qquad
    K = \arg\min \sum_{i=0}^{M} \| \dot x_i \|_W^2 + \rho \| u_i - u_e \|^2

is the regulator of the rates: a Riccati recursion over a finite horizon, from nothing
at its end, so that what cannot be controlled at rest, such as a car's heading, does no
harm. A second one, `K`, also weighs the deviation from the way: with it,
whoever plays the rows keeps a robot there that does not stay by itself,
:math:`u = u_{rest} - K (x - x_{rest})`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled, function
from rti_mpc.model.integrator import integrator, sensitivities
from rti_mpc.model.model import Model, depends_on
from rti_mpc.rotation import TURNS
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.riccati import cholesky, cholesky_solve
from rti_mpc.rti.tangent import tangent

NEWTON_STEPS = 8  # to an equilibrium
SETTLING_STEPS = 2  # to the equilibrium at the end of a way, which is near
DAMPING = 1e-9  # of these steps, relative to squared ranges, where the equilibria are more than the equations tell
INPUT_FREEDOM_FACTOR = 10.0  # by which inputs may move farther to an equilibrium than states, each measured by its range in operation
FINDING_PASSES = 8  # over a way that is found anew, before the last one: equilibria of an arm depend on where it comes to rest
FULL_PASSES = 3  # of these, each of which aims at where the one before has led
RELAXATION = 0.1, 1.0  # least and largest share of the way there that the others aim farther
FOUND_SHARE = 1e-3  # of its range in operation, within which a way leads to where it was aimed: there is no need of another pass
SMALLEST = 1e-300  # replaces a change of zero
FIRST_ROWS = 2  # whose reach depends on what was sent before
BLOCK_ROWS = 10  # that are compiled once and called again, as are steps of the regulator: compilers take long for what is long
FREE_SHARE = 0.01  # of its rate in operation by which a state moves where another one is anywhere in its range: then that one is free at rest
HOLD_S = 0.5  # a deviation from the way weighs as much as a rate that undoes it in this time
LEAN_S = 2.0  # the same for what is to give way where the state itself is held, too: a boat comes back sideways by leaning out of a current
DRIVEN_SHARE = 0.5  # of the range of a rate in operation: what inputs change by more of it within a period they drive, in discrete time
OPERATING_STATES = 20  # at which that is looked at
LIMITS = ("lbu", "ubu", "lbdu", "ubdu")


@dataclass(frozen=True, eq=False)
class StopLaw:
    """
    What the way to rest of a problem is made with, found once by `rti_mpc.rti.rest`.

    Attributes:
        rows: Rows of the way, M, as `whole` says.
        horizon: Rows that the regulator looks ahead.
        period_s: Duration of a row, s: whole periods of the controller.
        substeps: How many of them.
        input_weight: Weight of the inputs beside the rates, each measured by its range: rho.
        rates: How fast the states change in operation, shape ``(nx,)``, positive; weights are measured by it.
        scale_x: Range of the states in operation, shape ``(nx,)``, positive.
        scale_u: Range of the inputs, shape ``(nu,)``, positive.
        holds: Whether the robot stays at rest without feedback: then its commands carry no gain.
        disturbances: Largest magnitudes of the model's last parameters, shape ``(nd,)``, that move the robot while its inputs are at
            rest; empty if none do. In them, not every heading is one to rest in.
        alone: How fast the robot moves in the end if its states are not fed back, in words; empty if it holds.
        delay_s: Delay from a state to the input that answers it, s, for which it must come to rest.
    """

    rows: int
    horizon: int
    period_s: float
    substeps: int
    input_weight: float
    rates: Array
    scale_x: Array
    scale_u: Array
    holds: bool = False
    disturbances: Array = field(default_factory=lambda: np.zeros(0))
    alone: str = ""
    delay_s: float = 0.0


class WayToRest:
    """
    The way to rest from one state, in arrays that are owned and never move.

    Attributes:
        law: What it is made with.
        u: Inputs, shape ``(M, nu)``; the last row holds the robot where it has come to rest.
        x: States at the beginning of each row, shape ``(M, nx)``; the last one is an equilibrium.
        K: Gain that keeps the robot on the way, shape ``(nu, nx)``.
        x_e: Equilibrium aimed at, shape ``(nx,)``; `u_e`, the input there, shape ``(nu,)``.
        p: Parameters of the model, shape ``(np,)``; nominal unless written.
    """

    def __init__(self, ocp: Ocp, law: StopLaw, limits: Mapping[str, Array] | None = None, *, p: Array | None = None, compile: bool = True) -> None:
        """
        Build and compile it.

        Args:
            ocp: The problem.
            law: Its law.
            limits: Bounds and slew limits by the names in `LIMITS`, owned by the caller; those of the problem if left out.
            p: Parameters, owned by the caller; the model's nominal ones if left out.
            compile: Whether to machine code.
        """
        model = ocp.model
        nx, nu = model.nx, model.nu
        self.law = law
        self.p: Array = np.array(model.p_nominal) if p is None else p
        self.u, self.x = np.zeros((law.rows, nu)), np.zeros((law.rows, nx))
        self.K: Array = np.zeros((nu, nx))
        self.x_e, self.u_e = np.zeros(nx), np.array(model.u_rest)
        self._u_rest: Array = np.array(model.u_rest)
        limits = {name: ocp.widest(name) for name in LIMITS} if limits is None else limits
        self._limits = {name: limits[name] for name in LIMITS}
        self._start, self._near = np.zeros(nx), (np.zeros(nx), np.zeros(nu))
        self._reach = np.zeros((2, nu)), np.zeros((2, nu))
        self._u_prev, self._shift = np.zeros(nu), np.arange(law.rows)
        self._stop_K: Array = np.zeros((nu, nx))  # gain of the regulator of the rates
        self._follow_K: Array = np.zeros((nu, nx))
        self._follow = np.zeros((law.rows, nu)), np.zeros((law.rows, nx))  # rows that are followed now
        self._way = np.zeros((law.rows, nu)), np.zeros((law.rows, nx))  # rows of the last way that has begun
        self._end = np.zeros(nx), np.zeros(nu)
        functions = [aiming(model, law), rolling(model, law), to_equilibrium(model, law, SETTLING_STEPS)]
        if model.stop_expr is not None:
            functions.append(stopping(model, law))
        made = compiled(*functions) if compile else functions
        near = {"x": self._near[0], "u": self._near[1], "p": self.p}
        self._aim = bind(made[0], near, {"x_e": self.x_e, "u_e": self.u_e, "K_stop": self._stop_K, "K": self.K})
        start = {"x0": self._start, "u_prev": self._u_prev, "p": self.p, "lowest": self._reach[0], "highest": self._reach[1], **self._limits}
        rows = {"rows": self.u, "states": self.x}
        followed = {"u_way": self._follow[0], "x_way": self._follow[1], "K": self._follow_K}
        self._roll = bind(made[1], start | followed, rows)
        self._settle = bind(made[2], near, {"x_e": self._end[0], "u_e": self._end[1]})
        self._stop = bind(made[3], start, rows) if model.stop_expr is not None else self._roll

    def aim(self, x: Array, u: Array) -> bool:
        """
        Find the equilibrium near a state and an input, and the gains about it; off the path from state to command.

        Returns:
            Whether they are finite; otherwise the last ones are kept.
        """
        kept = [array.copy() for array in (self.x_e, self.u_e, self._stop_K, self.K)]
        self._near[0][:], self._near[1][:] = x, u
        self._aim()
        found = bool(np.isfinite(self._stop_K).all() and np.isfinite(self.K).all() and np.isfinite(self.x_e).all())
        if not found:
            for array, before in zip((self.x_e, self.u_e, self._stop_K, self.K), kept, strict=True):
                array[:] = before
        return found

    def begin(self, x: Array, u_prev: Array, reach: tuple[Array, Array] | None = None) -> bool:
        """
        Roll a new way out, about the equilibrium that was aimed at.

        Args:
            x: State where it begins, shape ``(nx,)``.
            u_prev: Last input that acts before it, shape ``(nu,)``.
            reach: Lowest and highest first two rows, each of shape ``(2, nu)``; what the slew limits allow if left out.

        Returns:
            Whether it is finite.
        """
        self._from(x, u_prev, reach)
        self._follow[0][:], self._follow[1][:], self._follow_K[:] = self.u_e, self.x_e, self._stop_K
        self._stop()
        self._near[0][:], self._near[1][:] = self.x[-1], self.u[-1]
        self._settle()
        self._finish(*self._end)
        self._way[0][:], self._way[1][:] = self.u, self.x
        return self.finite

    def follow(self, x: Array, u_prev: Array, elapsed: int, reach: tuple[Array, Array] | None = None) -> bool:
        """
        Follow the last way that has begun, some rows later, from where the robot has really come to.

        Args:
            x: State where it begins, shape ``(nx,)``.
            u_prev: Last input that acts before it, shape ``(nu,)``.
            elapsed: Rows that are over.
            reach: Lowest and highest first two rows.
        """
        left = np.minimum(self._shift + elapsed, len(self.u) - 1)
        u, x_way = self._way
        self._follow[0][:], self._follow[1][:], self._follow_K[:] = u[left], x_way[left], self.K
        self._from(x, u_prev, reach)
        self._roll()
        self._finish(x_way[-1], u[-1])
        return self.finite

    def planned(self, elapsed: int) -> Array:
        """Return the state in which the last way that has begun is some rows later, shape ``(nx,)``."""
        x: Array = self._way[1][min(elapsed, len(self.x) - 1)]
        return x

    def hold(self, u_prev: Array, reach: tuple[Array, Array] | None = None) -> None:
        """Go to the input at the equilibrium that was aimed at last, as fast as the limits allow: for want of a finite way."""
        self._from(self.x_e, u_prev, reach)
        lower, upper = self._reach[0][0], self._reach[1][0]
        for i in range(len(self.u)):
            row = np.minimum(np.maximum(self.u_e, self._limits["lbu"]), self._limits["ubu"])
            self.u[i], self.x[i] = np.minimum(np.maximum(row, lower), upper), self.x_e
            lower, upper = self.u[i] + self._limits["lbdu"], self.u[i] + self._limits["ubdu"]
            if i == 0:
                lower, upper = np.maximum(lower, self._reach[0][1]), np.minimum(upper, self._reach[1][1])
        self._way[0][:], self._way[1][:] = self.u, self.x

    def find(self, x: Array, u_prev: Array, reach: tuple[Array, Array] | None = None) -> bool:
        """
        Roll a way out from a state nothing is known of before; as `begin`, aimed at the state itself, then at where that leads.

        Aimed at its own end, a way is a fixed point. Aimed at where the last one led, an arm that is nearly stretched may end on either side of
        it in turn for ever, hence the relaxation of Aitken, for vectors as in [Irons1969]_. If none is found, the aim counts whose way ends
        nearest to it.
        """
        self.aim(x, self._u_rest)
        share, before, least, nearest = 1.0, np.zeros(len(x) + len(u_prev)), np.inf, (x, self._u_rest)
        for k in range(FINDING_PASSES):
            if not self.begin(x, u_prev, reach):
                break
            off = np.concatenate([(self.x[-1] - self.x_e) / self.law.scale_x, (self.u[-1] - self.u_e) / self.law.scale_u])
            if (size := float(np.abs(off).max())) <= FOUND_SHARE:
                return True
            if size < least:
                least, nearest = size, (self.x_e.copy(), self.u_e.copy())
            if k >= FULL_PASSES:
                change = off - before
                share = min(max(-share * float(before @ change) / max(float(change @ change), SMALLEST), RELAXATION[0]), RELAXATION[1])
            before = off
            self.aim(self.x_e + share * (self.x[-1] - self.x_e), self.u_e + share * (self.u[-1] - self.u_e))
        self.aim(*nearest)
        return self.begin(x, u_prev, reach)

    @property
    def finite(self) -> bool:
        """Whether the way is."""
        return bool(np.isfinite(self.x).all() and np.isfinite(self.u).all())

    def _from(self, x: Array, u_prev: Array, reach: tuple[Array, Array] | None) -> None:
        self._start[:], self._u_prev[:] = x, u_prev
        if reach is None:
            lowest, highest = self._reach
            lowest[0], highest[0] = u_prev + self._limits["lbdu"], u_prev + self._limits["ubdu"]
            lowest[1], highest[1] = lowest[0] + self._limits["lbdu"], highest[0] + self._limits["ubdu"]
        else:
            self._reach[0][:], self._reach[1][:] = reach

    def _finish(self, x_end: Array, u_end: Array) -> None:
        """Let the way end in an equilibrium."""
        limits, before = self._limits, self.u[-2]
        u = np.minimum(np.maximum(u_end, limits["lbu"]), limits["ubu"])
        self.x[-1], self.u[-1] = x_end, np.minimum(np.maximum(u, before + limits["lbdu"]), before + limits["ubdu"])


def to_equilibrium(model: Model, law: StopLaw, steps: int) -> ca.Function:
    """Build ``(x, u, p) -> (x_e, u_e)``: Newton steps of least length to a state and an input at which the model rests."""
    z, space = ca.vertcat(model.x, model.u), tangent(model)
    size = ca.DM(np.concatenate([space.measured(law.scale_x), INPUT_FREEDOM_FACTOR * law.scale_u]))
    f = space.inverse @ model.rate_expr / ca.DM(space.measured(law.rates))
    J = ca.densify(ca.jacobian(f, z) @ ca.diagcat(space.basis, ca.SX.eye(model.nu)) @ ca.diag(size))
    step = size * (J.T @ cholesky_solve(cholesky(J @ J.T + DAMPING * ca.SX.eye(f.numel())), f))
    closer = z - ca.vertcat(space.basis @ step[: f.numel()], step[f.numel() :])
    for places in map(list, model.rotations("states").quaternions):
        closer[places] /= ca.norm_2(closer[places])
    nearer = ca.Function("nearer", [z, model.p], [ca.cse(ca.densify(closer))])
    x, u, p = ca.MX.sym("x", model.nx), ca.MX.sym("u", model.nu), ca.MX.sym("p", model.np_)
    at = ca.vertcat(x, u)
    for _ in range(steps):
        at = nearer(at, p)
    turns = np.array([TURNS[signal.unit] if signal.angle else np.inf for signal in (*model.states, *model.inputs)])
    at -= ca.DM(np.where(np.isfinite(turns), turns, 0.0)) * ca.floor((at - ca.vertcat(x, u)) / ca.DM(turns) + 0.5)
    return function("equilibrium", {"x": x, "u": u, "p": p}, {"x_e": at[: model.nx], "u_e": at[model.nx :]})


def aiming(model: Model, law: StopLaw) -> ca.Function:
    """Build ``(x, u, p) -> (x_e, u_e, K_stop, K)``: the equilibrium near a state and an input, and the gains about it."""
    x, u, p = ca.MX.sym("x", model.nx), ca.MX.sym("u", model.nu), ca.MX.sym("p", model.np_)
    x_e, u_e = to_equilibrium(model, law, NEWTON_STEPS)(x, u, p)
    K_stop, K = regulators(model, law)(x_e, u_e, p)
    return function("aiming", {"x": x, "u": u, "p": p}, {"x_e": x_e, "u_e": u_e, "K_stop": ca.densify(K_stop.T), "K": ca.densify(K.T)})


def regulators(model: Model, law: StopLaw) -> ca.Function:
    """Build ``(x_e, u_e, p) -> (K_stop, K)``: gains of the regulator of the rates, and of the one that holds the state, too."""
    nx, nu = model.nx, model.nu
    _, A_x, B_x, _ = sensitivities(model, law.period_s, substeps=law.substeps)
    space = tangent(model)
    nt, scale, fastest = len(space.states), space.measured(law.scale_x), space.measured(law.rates)
    A, B = space.inverse @ A_x @ space.basis, space.inverse @ B_x
    driven = driven_by_inputs(model, law)
    left = [i for i, j in enumerate(space.states) if not driven[j]]  # the others are for the inputs to choose
    C = ca.densify(ca.jacobian((space.inverse @ initial_rates(model))[left, 0] / ca.DM(fastest[left]), model.x) @ space.basis)
    moving, found = C.T @ C, ca.SX(nt, nt)
    if law.disturbances.size:
        found = unfree(C @ ca.diag(ca.DM(scale)), scale, fastest)
    seen = ca.sum1((C @ ca.diag(ca.DM(scale))) ** 2).T  # by the regulator of the rates: what it slows down is not to be held as well
    away = ca.diag(ca.densify(FREE_SHARE**2 / (FREE_SHARE**2 + seen)) / ca.DM((HOLD_S * fastest) ** 2))
    weights = moving + found, moving + (HOLD_S / LEAN_S) ** 2 * found + away
    linear = ca.Function("linear", [model.x, model.u, model.p], [ca.densify(expr) for expr in (A, B, space.inverse, *weights)])

    S, Q, As, Bs = (ca.SX.sym(name, *shape) for name, shape in (("S", (nt, nt)), ("Q", (nt, nt)), ("A", (nt, nt)), ("B", (nt, nu))))
    A_s, B_s = (symbol * ca.DM(expr.sparsity(), 1.0) for symbol, expr in ((As, A), (Bs, B)))
    SA, SB = S @ A_s, S @ B_s
    K = cholesky_solve(cholesky(B_s.T @ SB + ca.diag(ca.DM(law.input_weight * law.scale_u**-2.0))), SB.T @ A_s)
    before = Q + A_s.T @ SA - (SB.T @ A_s).T @ K
    recursion = ca.Function("recursion", [S, Q, As, Bs], ca.cse([ca.densify((before + before.T) / 2), ca.densify(K)]))

    x, u, p = ca.MX.sym("x", nx), ca.MX.sym("u", nu), ca.MX.sym("p", model.np_)
    A_e, B_e, inverse, *costs = linear(x, u, p)
    to_go, cost, A_k, B_k = (ca.MX.sym(name, *shape) for name, shape in (("S", (nt, nt)), ("Q", (nt, nt)), ("A", (nt, nt)), ("B", (nt, nu))))
    earlier, gain = to_go, ca.MX(nu, nt)
    for _ in range(BLOCK_ROWS):
        earlier, gain = recursion(earlier, cost, A_k, B_k)
    block = ca.Function("recursions", [to_go, cost, A_k, B_k], [earlier, gain])
    gains = []
    for cost in costs:
        to_go = cost
        for _ in range(-(-law.horizon // BLOCK_ROWS)):
            to_go, gain = block(to_go, cost, A_e, B_e)
        gains.append(gain @ inverse if nt < nx else gain)
    return ca.Function("regulators", [x, u, p], gains)


def initial_rates(model: Model) -> ca.SX:
    """
    Return the rates of the states at once, shape ``(nx, 1)``: in discrete time estimated from two periods.

    Over a period inputs change a position, too, by way of its speed. The mean rate would not tell one from the other.
    """
    if model.dt is None:
        return model.rate_expr
    after = ca.Function("after", [model.x, model.u, model.p], [model.disc_dyn_expr])
    return (4 * model.disc_dyn_expr - after(model.disc_dyn_expr, model.u, model.p) - 3 * model.x) / (2 * model.dt)


def driven_by_inputs(model: Model, law: StopLaw) -> list[bool]:
    """
    Return which rates inputs change by themselves.

    In discrete time driven are those that the inputs change by most of their range in operation: the estimate of `initial_rates` leaves a rest.
    """
    rates = initial_rates(model)
    if model.dt is None:
        return [depends_on(rate, model.u) for rate in ca.vertsplit(rates)]
    B = ca.Function("B", [model.x, model.u, model.p], [ca.densify(ca.jacobian(rates, model.u))])
    rng, middle = np.random.default_rng(1), np.array(model.x_nominal or np.zeros(model.nx))
    states = middle + law.scale_x * rng.uniform(-1.0, 1.0, size=(OPERATING_STATES, model.nx))
    shares = np.array([np.abs(np.array(B(x, model.u_rest, model.p_nominal))) @ law.scale_u for x in states]) / law.rates
    return [bool(share > DRIVEN_SHARE) for share in np.nan_to_num(shares).max(axis=0)]


def unfree(C: ca.SX, scale: Array, rates: Array) -> ca.SX:
    """
    Build the weight of a deviation from the equilibrium in what the rates depend on, and may so not be as it likes at rest.

    In a current that is weak, a boat's rates hardly depend on its heading, and yet it comes to rest in one heading only.
    """
    free = ca.densify(C.T @ cholesky_solve(cholesky(ca.densify(C @ C.T) + FREE_SHARE**2 * ca.SX.eye(C.shape[0])), C))  # a projector, softly
    away = free @ ca.diag(ca.DM(1.0 / scale))
    return away.T @ ca.diag(ca.DM((scale / (HOLD_S * rates)) ** 2)) @ away


def rolling(model: Model, law: StopLaw) -> ca.Function:
    """Build ``(x0, u_prev, p, lowest, highest, *LIMITS, u_way, x_way, K) -> (rows, states)``: rows of a way followed; columns are rows."""
    u_way, x_way = ca.SX.sym("u_way", model.nu), ca.SX.sym("x_way", model.nx)
    K = ca.SX.sym("K", model.nx, model.nu)  # its columns are rows of the array
    wanted = u_way - K.T @ (model.x - x_way)
    return rolled_out("rolling", model, law, wanted, {"u_way": u_way, "x_way": x_way}, {"K": K})


def stopping(model: Model, law: StopLaw) -> ca.Function:
    """Build ``(x0, u_prev, p, lowest, highest, *LIMITS) -> (rows, states)``: rows by the law that a model gives."""
    assert model.stop_expr is not None
    return rolled_out("stopping", model, law, model.stop_expr, {}, {})


def rolled_out(name: str, model: Model, law: StopLaw, wanted: ca.SX, along: dict[str, ca.SX], fixed: dict[str, ca.SX]) -> ca.Function:
    """Roll a law out, inside bounds and slew limits: of the state, the last input, what each row has of its own, and what all have."""
    nu, limits = model.nu, {limit: ca.SX.sym(limit, model.nu) for limit in LIMITS}
    lowest, highest = ca.SX.sym("lowest", nu), ca.SX.sym("highest", nu)
    u = ca.fmin(ca.fmax(ca.fmin(ca.fmax(wanted, limits["lbu"]), limits["ubu"]), lowest), highest)
    x_next = integrator(model, substeps=law.substeps)(model.x, u, model.p, law.period_s)
    common = {"p": model.p, **limits, **fixed}
    row_in = {"x": model.x, "u": model.u, "lowest": lowest, "highest": highest, **along, **common}
    row = function("row", row_in, dict(zip(("x_next", "u_now"), ca.cse([ca.densify(x_next), ca.densify(u)]), strict=True)))

    def roll(x: ca.MX, before: ca.MX, shared: dict[str, ca.MX], own: dict[str, ca.MX], rows: range) -> tuple[ca.MX, ca.MX, list[ca.MX], list[ca.MX]]:
        """Roll some rows out; the first two keep what is lowest and highest there."""
        inputs, states = [], []
        for i in rows:
            low, high = before + shared["lbdu"], before + shared["ubdu"]
            if "lowest" in shared:
                low, high = (
                    (ca.fmax(low, shared["lowest"][:, 1]), ca.fmin(high, shared["highest"][:, 1]))
                    if i
                    else (
                        shared["lowest"][:, 0],
                        shared["highest"][:, 0],
                    )
                )
            after = row(
                x=x,
                u=before,
                lowest=low,
                highest=high,
                **{key: value[:, i] for key, value in own.items()},
                **{key: value for key, value in shared.items() if key not in ("lowest", "highest")},
            )
            states.append(x)
            x, before = after["x_next"], after["u_now"]
            inputs.append(before)
        return x, before, inputs, states

    def symbols(rows: int) -> tuple[ca.MX, ca.MX, dict[str, ca.MX], dict[str, ca.MX]]:
        shared = {key: ca.MX.sym(key, *symbol.shape) for key, symbol in common.items()}
        return ca.MX.sym("x0", model.nx), ca.MX.sym("u_prev", nu), shared, {key: ca.MX.sym(key, e.numel(), rows) for key, e in along.items()}

    x, before, shared, own = symbols(BLOCK_ROWS)
    x_end, u_end, inputs, states = roll(x, before, shared, own, range(BLOCK_ROWS))
    ends = {"x_end": x_end, "u_end": u_end, "rows": ca.horzcat(*inputs), "states": ca.horzcat(*states)}
    block = function("block", {"x0": x, "u_prev": before, **shared, **own}, ends)

    x, before, shared, own = symbols(law.rows)
    reach = {"lowest": ca.MX.sym("lowest", nu, 2), "highest": ca.MX.sym("highest", nu, 2)}
    whole_in = {"x0": x, "u_prev": before, **shared, **reach, **own}
    x, before, inputs, states = roll(x, before, shared | reach, own, range(FIRST_ROWS))
    for start in range(FIRST_ROWS, law.rows, BLOCK_ROWS):
        after = block(x0=x, u_prev=before, **shared, **{key: value[:, start : start + BLOCK_ROWS] for key, value in own.items()})
        x, before = after["x_end"], after["u_end"]
        inputs.append(after["rows"])
        states.append(after["states"])
    return function(name, whole_in, {"rows": ca.horzcat(*inputs), "states": ca.horzcat(*states)})


def whole(rows: int) -> int:
    """Return how many rows a way has that needs some: those that are rolled out one by one, and whole blocks."""
    return FIRST_ROWS + BLOCK_ROWS * max(1, -(-(rows - FIRST_ROWS) // BLOCK_ROWS))
