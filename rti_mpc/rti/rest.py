# SPDX-License-Identifier: Apache-2.0
r"""
Rest of a robot: how it comes to a standstill, how long that takes, and whether it stays there.

The inputs at rest stop a robot that is driven by speeds. One that is driven by
accelerations coasts on, one that is driven by torques falls: those need a way to
rest (`rti_mpc.rti.way_to_rest`). Which of them a model is, its own equations tell.
From states of operation

.. math::

    \dot x = f(x, u_{rest}, p)

is integrated for a while; then every state must stand still, compared with how fast
it changes in operation. And the robot must stay wherever it has stopped: a state
whose derivative does not depend on itself, such as a position, a heading or a joint
angle, is displaced, and nothing may begin to move.

At the end of a way to rest a robot holds without feedback, or it drifts, or it is
unstable (`RestClass`). The eigenvalues there tell, and roll-outs of a plant that
answers its inputs by a little more or less, a little late.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from itertools import compress
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import at_points
from rti_mpc.errors import OcpError
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import Model, depends_on
from rti_mpc.rti.nominal import nominal_state
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.operation import corners, derivative, range_of_inputs, range_of_states, regular, states_of_operation
from rti_mpc.rti.way_to_rest import StopLaw, WayToRest, whole
from rti_mpc.si import ones
from rti_mpc.signals import quantity

SETTLING_S = 10.0  # after its inputs have come to rest a robot must stand still
DRIVEN_S = 2.0  # for which inputs at their bounds drive the robot, to see which states it gets into
STILL_SHARE = 0.01  # a state stands still that changes more slowly than this share of its fastest rate in operation
STILL_RATE = 1e-9  # the same of a state that does not change in operation, in its SI unit / s
COUNTED_STILL_SHARE = 1e-3  # the same, where the rows that a way needs are counted: in operation it may need more than in the states tried
FALLING_SHARE = 0.1  # a robot falls, and does not only drift, if without feedback a state changes faster than this share of that rate
MAX_DRIFT_GROWTH_PER_S = 0.05  # real part of an eigenvalue at rest up to which a robot drifts, and is not unstable
SEEDED_STATES = 6  # from which the inputs are brought to rest, beside those that inputs at their bounds lead to
TRIED_STATES = 24  # of operation, from which a way is to lead to rest
JUDGED_STATES = 100  # the same, of the law that is taken: a sharp one may not bear the corners that were not tried
FIRST_TRIED_STATES = 4  # of these, tried before the others: most laws that are too slow are so from the corners
MAX_LINEARIZED_STATES = 50  # at rest, whose eigenvalues are computed
WAY_DURATIONS_S = (1.0, 2.0, 5.0, 10.0, 20.0)  # tried in this order until one is long enough
MAX_WAY_ROWS = 200
MAX_HORIZON_ROWS = 100  # that the regulator looks ahead
ROWS_FACTOR = 1.5  # a way has so many times the rows that the states tried need
INPUT_WEIGHTS = (0.01, 0.1, 1.0, 10.0)  # relative to the weight of the rates; the one with the soonest rest is taken
DELAY_S = 0.01  # from a state to the input that answers it, when a way is played, beside the robot's own delay
INPUT_MISMATCH_SHARE = 0.02  # by which the plant answers its inputs more, or less, than its model
STANDING_S = 5.0  # for which the last row is then played
UNDISTURBED: Array = np.zeros(0)

Motion = Callable[[Array, Array, float], Array]


def motion_at_rest(ocp: Ocp) -> str:
    """
    Return how a robot moves although its inputs are at rest, empty if it comes to rest and stays there.

    Args:
        ocp: Its model, and the bounds inside which it is operated.
    """
    model, rng, attitudes = ocp.model, np.random.default_rng(1), ocp.model.rotations("states")
    u_rest: Array = np.array(model.u_rest)
    move, rate, is_regular = motion(model), derivative(model), regular(ocp)
    inputs = list(corners(*range_of_inputs(ocp), rng))
    start = np.clip(nominal_state(ocp), ocp.widest("lbx"), ocp.widest("ubx"))
    lowest, highest = range_of_states(ocp, start)
    states = [np.clip(move(start, u, DRIVEN_S), ocp.widest("lbx"), ocp.widest("ubx")) for u in inputs]
    states += [rng.uniform(lowest, highest) for _ in range(SEEDED_STATES)]
    states = [start, *(x for x in map(attitudes.completed, states) if is_regular(x, u_rest))]
    rates = np.abs([rate(x, u) for x in states for u in (*inputs, u_rest)])
    fastest = np.max(rates, axis=0, where=np.isfinite(rates), initial=0.0)
    still = np.where(fastest > 0.0, STILL_SHARE * fastest, STILL_RATE * ones(model.states))
    positions = [j for j in range(model.nx) if not depends_on(model.rate_expr[j], model.x[j])]
    ends = [move(x, u_rest, SETTLING_S) for x in states]
    for settled in ends:
        if moving := moves(model, rate(settled, u_rest), still):
            return f"{SETTLING_S:g} s after its inputs have come to rest {moving}"
    for settled in ends:
        for j in positions:
            aside = settled.copy()
            aside[j] += 0.5 * (highest[j] - lowest[j]) * rng.choice((-0.5, 0.5))
            attitudes.normalize(aside)
            if moving := moves(model, rate(aside, u_rest), still):
                return f"where it stands at {model.states[j].name} = {quantity(aside[j], model.states[j].unit)}, its inputs at rest, {moving}"
    return ""


def moves(model: Model, rates: Array, still: Array) -> str:
    """Return which state moves fastest, compared with what is still, each of shape ``(nx,)``; empty if none does."""
    j = int(np.argmax(np.abs(np.where(np.isnan(rates), np.inf, rates)) / still))
    signal = model.states[j]
    if np.isnan(rates[j]):
        return f"{signal.name} has come to where the model is not finite"
    return "" if abs(rates[j]) <= still[j] else f"{signal.name} changes by {quantity(rates[j], signal.unit)} per second"


def motion(model: Model) -> Motion:
    """Build the state, shape ``(nx,)``, to which an input, shape ``(nu,)``, leads in a time in s; NaN where the model has none."""
    if model.dt is not None:
        after = ca.Function("after", [model.x, model.u, model.p], [ca.densify(model.disc_dyn_expr)])

        def sampled(x: Array, u: Array, span_s: float) -> Array:
            for _ in range(math.ceil(span_s / period_s - 1e-9)):
                x = np.array(after(x, u, model.p_nominal)).ravel()
            return x

        period_s = model.dt
        return sampled

    one = ones(model.states)  # states are integrated in SI units, for the tolerance of the integrator is absolute, too
    z = ca.SX.sym("z", model.nx)
    t = ca.SX.sym("t")  # as a parameter: of time 1, one integrator serves all
    dae = {"x": z, "p": ca.vertcat(model.u, model.p, t), "ode": t * ca.substitute(model.rate_expr, model.x, one * z) / one}
    integrate = ca.integrator("motion", "cvodes", dae, 0.0, 1.0, {"show_eval_warnings": False, "disable_internal_warnings": True})

    def move(x: Array, u: Array, span_s: float) -> Array:
        try:
            return np.asarray(one * np.array(integrate(x0=x / one, p=[*u, *model.p_nominal, span_s])["xf"]).ravel())
        except RuntimeError:  # it diverges
            return np.full(len(x), np.nan)

    return move


class RestClass(Enum):
    """What a robot does at the end of its way to rest, its inputs held."""

    HOLDS = "holds without feedback"
    DRIFTS = "drifts without feedback"
    UNSTABLE = "falls without feedback"


@dataclass(frozen=True, eq=False)
class Rest:
    """
    How a robot comes to rest from its states of operation.

    Attributes:
        kind: What it does there, its inputs held.
        growth: Largest real part of the eigenvalues at rest, 1/s.
        time_s: Longest time to rest.
        moved: Largest change of each state on the way, shape ``(nx,)``; zero for a state that is the same wherever the robot rests.
        states: How many states of operation were tried.
        alone: How fast it moves in the end if its states are not fed back, in words; empty if it holds.
    """

    kind: RestClass
    growth: float
    time_s: float
    moved: Array
    states: int
    alone: str = ""


class Starts(NamedTuple):
    """
    States of operation from which a robot is stopped.

    Attributes:
        x: States, shape ``(n, nx)``.
        u: Inputs that act there, shape ``(n, nu)``.
        p: Parameters of the model, shape ``(n, np)``: what disturbs it differs.
    """

    x: Array
    u: Array
    p: Array


class Ways(NamedTuple):
    """
    Ways to rest of many states.

    Attributes:
        u: Inputs, shape ``(n, M, nu)``.
        x: States, shape ``(n, M, nx)``.
        K: Gains, shape ``(n, nu, nx)``.
        period_s: Duration of a row, s.
    """

    u: Array
    x: Array
    K: Array
    period_s: float


def starts_of(ocp: Ocp, count: int, disturbances: Array) -> Starts:
    """Return states of operation, the corners first; disturbed by all that is given, up or down, there, and by seeded shares of it elsewhere."""
    model = ocp.model
    p = np.tile(np.array(model.p_nominal), (count, 1))
    rng, nd, few = np.random.default_rng(2), len(disturbances), count // 4
    shares = np.concatenate([rng.choice((-1.0, 1.0), size=(few, nd)), rng.uniform(-1.0, 1.0, size=(count - few, nd))])
    p[:, model.np_ - nd :] = disturbances * shares
    return Starts(*states_of_operation(ocp, count), p)


def find_stop_law(ocp: Ocp, disturbances: Array = UNDISTURBED, delay_s: float = 0.0) -> StopLaw | None:
    """
    Return what the way to rest of a problem is made with, None for a robot whose inputs need but ramp to rest.

    Args:
        ocp: The problem.
        disturbances: Largest magnitudes of the last parameters of its model, shape ``(nd,)``: of what moves the robot also while
            its inputs are at rest, as a current does, and is to be balanced then.
        delay_s: From a state to the input that answers it, s: a gain that is too large for it sways.

    Raises:
        OcpError: It does not come to rest from where it operates, or does not stay there; the message says from where.
    """
    if not disturbances.size and ocp.model.stop_expr is None and not motion_at_rest(ocp):
        return None
    failure = None
    for law in shaped(ocp, disturbances, delay_s):
        try:
            rest = assess(ocp, law, JUDGED_STATES, compile=False)
        except OcpError as error:
            failure = failure or error
        else:
            return replace(law, holds=rest.kind is RestClass.HOLDS, alone=rest.alone)
    assert failure is not None
    raise failure


def assess(ocp: Ocp, law: StopLaw | None, count: int, *, compile: bool = True) -> Rest:
    """
    Bring a robot to rest from many states of operation, and see what it does there.

    Args:
        ocp: Its problem: model, and the bounds inside which it is operated.
        law: What its way to rest is made with; None: its inputs ramp to rest.
        count: States of operation that are tried, corners of the bounds included.
        compile: Whether its ways are made by machine code.

    Raises:
        OcpError: It does not come to rest from one of them, or does not stay there.
    """
    model, starts = ocp.model, starts_of(ocp, count, UNDISTURBED if law is None else law.disturbances)
    X = starts.x
    rates = rates_of_operation(model, starts)
    ways = ramps(ocp, starts) if law is None else ways_to_rest(ocp, law, starts, compile=compile)
    moving = np.abs(rates_along(model, ways, starts)) > STILL_SHARE * rates
    if law is not None and moving[:, -1].any():  # `motion_at_rest` has judged a ramp, by an integrator for stiff models, too
        raise OcpError(unrested(model, starts, moving[:, -1], ways))
    time_s = ways.period_s * float((moving.any(axis=2) * np.arange(1, moving.shape[1] + 1)).max())
    ends = ways.x[:, -1]
    with np.errstate(invalid="ignore"):
        free = np.ptp(ends, axis=0) > STILL_SHARE * np.ptp(X, axis=0)
        moved = np.where(free, np.abs(ends - X).max(axis=0), 0.0)
    A = ca.Function("A", [model.x, model.u, model.p], [ca.densify(ca.jacobian(model.rate_expr, model.x))])
    at_rest = zip(ends[:MAX_LINEARIZED_STATES], ways.u[:MAX_LINEARIZED_STATES, -1], starts.p[:MAX_LINEARIZED_STATES], strict=True)
    jacobians = [np.array(A(*where)) for where in at_rest]
    growth = max((growth_of(np.linalg.eigvals(J), model.dt) for J in jacobians if np.isfinite(J).all()), default=0.0)
    if law is None:
        return Rest(RestClass.HOLDS, growth, time_s, moved, count)

    alone = in_the_end(ocp, law, ways, starts, feedback=0.0) / rates
    if not law.disturbances.size and growth <= MAX_DRIFT_GROWTH_PER_S and alone.max() <= STILL_SHARE:
        return Rest(RestClass.HOLDS, growth, time_s, moved, count)
    kept = in_the_end(ocp, law, ways, starts, feedback=1.0) <= STILL_SHARE * rates
    if not kept.all():
        raise OcpError(unkept(model, starts, ~kept, ways, law.delay_s))
    falls = growth > MAX_DRIFT_GROWTH_PER_S or alone.max() > FALLING_SHARE
    return Rest(RestClass.UNSTABLE if falls else RestClass.DRIFTS, growth, time_s, moved, count, unaided(model, law, rates, alone.max(axis=0)))


def growth_of(eigenvalues: np.ndarray[Any, Any], period_s: float | None) -> float:
    """Return the rate at which the fastest motion grows, 1/s, from eigenvalues of the rates: in discrete time, of the mean ones over a period."""
    if period_s is None:
        return float(eigenvalues.real.max())
    return float(np.log(np.abs(1.0 + period_s * eigenvalues).max(initial=1e-300)) / period_s)


def shaped(ocp: Ocp, disturbances: Array, delay_s: float = 0.0) -> list[StopLaw]:
    """
    Find rows of the way to rest and weights of its regulator: with the first of them seeded states of operation are at rest soonest, and stay there.

    Raises:
        OcpError: From one of them no way leads to rest, or it does not stay there.
    """
    model, starts = ocp.model, starts_of(ocp, TRIED_STATES, disturbances)
    rates = rates_of_operation(model, starts)
    scale_x, scale_u = (
        np.where((half := 0.5 * np.ptp(values, axis=0)) > 0.0, half, ones(signals))
        for values, signals in zip(starts[:2], (model.states, model.inputs), strict=True)
    )
    wrong = ""
    for duration_s, still in (*((duration_s, COUNTED_STILL_SHARE) for duration_s in WAY_DURATIONS_S), (WAY_DURATIONS_S[-1], STILL_SHARE)):
        substeps = max(1, math.ceil(duration_s / (MAX_WAY_ROWS * ocp.dt)))
        rows = whole(math.ceil(duration_s / (substeps * ocp.dt)))
        found = []
        for weight in INPUT_WEIGHTS:
            horizon, period_s = min(rows, MAX_HORIZON_ROWS), substeps * ocp.dt
            law = StopLaw(rows, horizon, period_s, substeps, weight, rates, scale_x, scale_u, disturbances=disturbances, delay_s=delay_s)
            for count in (FIRST_TRIED_STATES, TRIED_STATES):
                few = Starts(*(part[:count] for part in starts))
                ways = ways_to_rest(ocp, law, few, compile=False)
                moving = np.abs(rates_along(model, ways, few)) > still * rates
                if moving[:, -1].any():
                    break
            if moving[:, -1].any():
                wrong = unrested(model, starts, moving[:, -1], ways)
            elif not (kept := in_the_end(ocp, law, ways, starts, feedback=1.0) <= STILL_SHARE * rates).all():
                wrong = unkept(model, starts, ~kept, ways, delay_s)
            else:
                needed = int((moving.any(axis=2) * np.arange(1, rows)).max()) + 1
                found.append(replace(law, rows=min(rows, whole(math.ceil(ROWS_FACTOR * needed) + 1))))
        if found:
            return sorted(found, key=lambda law: law.rows)
    raise OcpError(wrong)


def ways_to_rest(ocp: Ocp, law: StopLaw, starts: Starts, *, compile: bool) -> Ways:
    """Return the ways to rest from states of operation."""
    way = WayToRest(ocp, law, compile=compile)
    found = []
    for x, u, p in zip(*starts, strict=True):
        way.p[:] = p
        way.find(x, u)
        found.append((way.u.copy(), way.x.copy(), way.K.copy()))
    u, x, K = (np.array(part) for part in zip(*found, strict=True))
    return Ways(u, x, K, law.period_s)


def ramps(ocp: Ocp, starts: Starts) -> Ways:
    """Return how states follow inputs that ramp to rest."""
    model, (X, U, P) = ocp.model, starts
    rest, rows = np.array(model.u_rest), max(2, math.ceil(SETTLING_S / ocp.dt))
    phi = integrator(model, substeps=4 if model.dt is None else 1)
    falling, rising = ocp.widest("lbdu"), ocp.widest("ubdu")
    u, states, inputs, x = U, [], [], X
    for _ in range(rows):
        u = u + np.clip(rest - u, falling, rising)
        states.append(x)
        inputs.append(u)
        x = at_points(phi, x, u, P, np.full(len(x), ocp.dt))
    return Ways(np.stack(inputs, axis=1), np.stack(states, axis=1), np.zeros((len(X), model.nu, model.nx)), ocp.dt)


def played(ocp: Ocp, law: StopLaw, ways: Ways, starts: Starts, feedback: float, answer: float) -> tuple[Array, Array]:
    """
    Play ways to rest on a plant that answers its inputs more or less than its model, and late; the last row for a while.

    Args:
        ocp: The problem.
        law: What the ways are made with.
        ways: The ways.
        starts: Where they begin.
        feedback: Share of the gain that is applied.
        answer: Factor of the inputs.

    Returns:
        States at the beginning of each row and in the end, shape ``(n, rows + 1, nx)``, and what the plant then answers, shape ``(n, nu)``.
    """
    model, U = ocp.model, starts.u
    lbu, ubu, lbdu, ubdu = (ocp.widest(name) for name in ("lbu", "ubu", "lbdu", "ubdu"))
    phi = integrator(model, substeps=law.substeps)
    rows_late, late_s = divmod(DELAY_S + law.delay_s, law.period_s)
    x, before = ways.x[:, 0], U
    past, states = [U] * (int(rows_late) + 2), [x]
    for i in range(law.rows + math.ceil(STANDING_S / law.period_s)):
        row = min(i, law.rows - 1)
        u = ways.u[:, row] - feedback * np.einsum("nij,nj->ni", ways.K, x - ways.x[:, row])
        u = np.clip(np.clip(u, lbu, ubu), before + lbdu, before + ubdu)
        before, past = u, [*past[1:], u]
        for acting, span_s in ((past[0], late_s), (past[1], law.period_s - late_s)):
            x = at_points(phi, x, answer * acting, starts.p, np.full(len(x), span_s))
        states.append(x)
    return np.stack(states, axis=1), answer * before


def in_the_end(ocp: Ocp, law: StopLaw, ways: Ways, starts: Starts, feedback: float) -> Array:
    """Return how fast each state changes after each way, shape ``(n, nx)``: the faster of two plants that answer more, and less, than their model."""
    ends = [played(ocp, law, ways, starts, feedback, 1.0 + mismatch) for mismatch in (INPUT_MISMATCH_SHARE, -INPUT_MISMATCH_SHARE)]
    return np.asarray(np.abs([rates_at(ocp.model, x[:, -1], u, starts.p) for x, u in ends]).max(axis=0))


def standing_s(ocp: Ocp, law: StopLaw, place: Callable[[Array], Array], speed: float) -> float:
    """
    Return how long after the beginning of its way to rest a robot stands, in s: at least as long as the way, at most `STANDING_S` longer.

    Rows that act late lead a robot off its way where it brakes with all that its inputs can do. Its gain then leads it back, also after the
    last row.

    Args:
        ocp: Its problem.
        law: What its way to rest is made with.
        place: Gives what is to stand from states, shape ``(n, nx)`` to ``(n, k)``.
        speed: Below which it stands, in its unit per s.
    """
    starts = starts_of(ocp, TRIED_STATES, law.disturbances)
    states, _ = played(ocp, law, ways_to_rest(ocp, law, starts, compile=False), starts, 0.0 if law.holds else 1.0, 1.0)
    places = place(states.reshape(-1, ocp.model.nx)).reshape(*states.shape[:2], -1)
    moves = np.linalg.norm(np.diff(places, axis=1), axis=2).max(axis=0) >= speed * law.period_s
    return law.period_s * max(law.rows, int((moves * np.arange(1, len(moves) + 1)).max()))


def rates_of_operation(model: Model, starts: Starts) -> Array:
    """Return the fastest that each state changes in operation, shape ``(nx,)``, positive: one SI unit / s of a state that does not."""
    rates = np.abs(rates_at(model, *starts))
    rates = rates.max(axis=0, where=np.isfinite(rates), initial=0.0)
    return np.where(rates > 0.0, rates, ones(model.states))


def rates_along(model: Model, ways: Ways, starts: Starts) -> Array:
    """Return the rates of the states along ways, shape ``(n, M - 1, nx)``; the last row is at rest by its making."""
    x, u = ways.x[:, :-1], ways.u[:, :-1]
    p = np.repeat(starts.p, x.shape[1], axis=0)
    return rates_at(model, x.reshape(-1, model.nx), u.reshape(-1, model.nu), p).reshape(x.shape)


def rates_at(model: Model, X: Array, U: Array, P: Array) -> Array:
    """Return the rates of the states, shape ``(n, nx)``; infinite where there are none."""
    f = ca.Function("f", [model.x, model.u, model.p], [ca.densify(model.rate_expr)])
    rates = at_points(f, X, U, P)
    return np.where(np.isfinite(rates), rates, np.inf)


def unaided(model: Model, law: StopLaw, rates: Array, shares: Array) -> str:
    """Say how fast a robot moves after its way to rest, from the fastest rates of its states there as shares of those in operation."""
    j = int(np.argmax(shares))
    signal, rate = model.states[j], shares[j] * rates[j]
    how = f"changes by up to {quantity(rate, signal.unit)} per second" if np.isfinite(rate) else "is beyond every bound"
    return f"{law.rows * law.period_s + STANDING_S:.3g} s after a stop {signal.name} {how}"


def unrested(model: Model, starts: Starts, moving: np.ndarray[Any, Any], ways: Ways) -> str:
    """Say of the first state that does not come to rest, whose moving states are marked, which and how."""
    i = int(np.flatnonzero(moving.any(axis=1))[0])
    disturbed = starts.p[i] != np.array(model.p_nominal)
    values = *zip(model.states, starts.x[i], strict=True), *zip(compress(model.parameters, disturbed), starts.p[i][disturbed], strict=True)
    where = ", ".join(f"{signal.name} = {quantity(value, signal.unit)}" for signal, value in values)
    names = ", ".join(signal.name for signal, moves in zip(model.states, moving[i], strict=True) if moves)
    return f"{ways.period_s * ways.x.shape[1]:.3g} s after a stop at {where} it still moves: {names}"


def unkept(model: Model, starts: Starts, moving: np.ndarray[Any, Any], ways: Ways, delay_s: float) -> str:
    """Say the same of a way that is played, and where it ends."""
    mismatch = f"if its inputs do {100 * INPUT_MISMATCH_SHARE:g} % more or less than modelled, {DELAY_S + delay_s:g} s late"
    return f"{unrested(model, starts, moving, ways)}, {mismatch}"
