# SPDX-License-Identifier: Apache-2.0
"""
Builders of the parts of a robot's processes from its configuration.

Each function imports the modules that it needs when it is called, so that a guard or a
viewer loads neither CasADi nor a solver.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from rti_mpc.errors import ConfigError
from rti_mpc_service.config.assignments import assigned_numbers
from rti_mpc_service.config.refusal import unknown_signal
from rti_mpc_service.config.schema import ITERATION_KEYS, OWN_KEYS, Config

if TYPE_CHECKING:
    from rti_mpc.array import Array
    from rti_mpc.contract.limits import Limits
    from rti_mpc.control.controller import Controller
    from rti_mpc.control.observer import Observer
    from rti_mpc.model.model import Model, Signal
    from rti_mpc.rti.ocp import Ocp
    from rti_mpc.rti.qp.osqp import SolverSettings
    from rti_mpc.rti.rti import Rti
    from rti_mpc.rti.way_to_rest import StopLaw
    from rti_mpc.wire.bus import BusSettings
    from rti_mpc.wire.info import Label
    from rti_mpc_service.config.signals_file import Signals


def build_model(config: Config) -> Model:
    """Return the controller's model."""
    from rti_mpc.model.find import find_model
    from rti_mpc.rti.ocp import integrated

    model, ocp = find_model(config.model.name, config.model.folder), config.ocp
    model = integrated(model, ocp.integrator, ocp.sim_method_num_stages, ocp.sim_method_num_steps, ocp.dt_s)
    return model.with_parameters(**config.model.parameters)


def build_signals(config: Config) -> Signals:
    """Return the signals of the model, for those who load none."""
    from rti_mpc_service.config.signals_file import Signals

    return Signals.of(config.model.name, build_model(config))


def build_ocp(config: Config) -> Ocp:
    """Return the optimal control problem; its model has the obstacles and, last, the disturbances among its parameters."""
    from rti_mpc.model.disturbance import with_disturbances
    from rti_mpc.model.obstacle import with_obstacles
    from rti_mpc.rti.ocp import Ocp

    own = build_model(config)
    discs = [(*obstacle.centre_m, obstacle.radius_m + obstacle.margin_m) for obstacle in config.ocp.obstacles]
    model = with_disturbances(with_obstacles(own, discs), config.observer.disturbances)
    limits, terminal = config.ocp.bounds, config.ocp.terminal
    outside = {signal.name: (0.0, math.inf) for signal in model.constraints[len(own.constraints) :]}
    stages = config.ocp.stages
    bounded = bounded_constraints(config, model)
    lh, uh = by_stage(limits.constraints | outside, stages.constraints, bounded, config.ocp.N)
    problem = Ocp(
        model,
        N=config.ocp.N,
        N_u=config.ocp.N_u,
        blocks=config.ocp.blocks,
        dt=config.ocp.dt_s,
        method="euler" if config.ocp.integrator == "euler" else None,
        u_ref=[config.ocp.weights.u_ref.get(input.name, rest) for input, rest in zip(model.inputs, model.u_rest, strict=True)],
        Q_e=None if terminal.Q is None else [terminal.Q[output.name] for output in model.outputs],
        h_expr=model.h_expr[[i for i, name in enumerate(names(model.constraints)) if name in bounded], 0],
        lh=lh,
        uh=uh,
        **weights_and_bounds(config, model),
    )
    return problem if terminal.lqr is None else problem.retuned(Q_e=regulator_weight(config, problem))


def retuned(config: Config, problem: Ocp) -> Ocp:
    """Return a problem with the weights and bounds of another configuration; everything else is kept and not built again."""
    other = problem.retuned(**weights_and_bounds(config, problem.model))
    return other if config.ocp.terminal.lqr is None else other.retuned(Q_e=regulator_weight(config, other))


def weights_and_bounds(config: Config, model: Model) -> dict[str, Any]:
    """Return the weights and bounds that may change at run time, by their names in `Ocp`."""
    from rti_mpc.rti.ocp import DEFAULT_SLACK_WEIGHT

    weights, limits, stages, N, N_u = config.ocp.weights, config.ocp.bounds, config.ocp.stages, config.ocp.N, config.N_u
    z, Z = (DEFAULT_SLACK_WEIGHT if weight is None else weight for weight in (limits.soft_weight, limits.soft_weight_L2))
    lbu, ubu = by_stage(limits.inputs, stages.inputs, names(model.inputs), N_u)
    lbdu, ubdu = by_stage(limits.increments, stages.increments, names(model.inputs), N_u)
    lbx, ubx = by_stage(limits.states, stages.states, names(model.states), N)
    lbddu, ubddu = bounds(limits.second_differences, names(model.inputs))
    lbx_e, ubx_e = bounds(limits.terminal, names(model.states))
    constraints = bounded_constraints(config, model)
    return {
        "Q": [weights.Q[output.name] for output in model.outputs],
        "R": [weights.R[input.name] for input in model.inputs],
        "R_u": by_block(weights.R_u, stages.R_u, names(model.inputs), N_u),
        "delta": factors(as_sequence(weights.delta, N), stages.delta, names(model.outputs)),
        "lambda_": factors(as_sequence(weights.lambda_, N_u), stages.lambda_, names(model.inputs)),
        "lbu": lbu,
        "ubu": ubu,
        "lbdu": lbdu,
        "ubdu": ubdu,
        "lbx": lbx,
        "ubx": ubx,
        "z": slack_weights(z, stages.soft_weight, names(model.states), N),
        "Z": slack_weights(Z, stages.soft_weight_L2, names(model.states), N),
        "zh": slack_weights(z, stages.soft_weight, constraints, N),
        "Zh": slack_weights(Z, stages.soft_weight_L2, constraints, N),
        "lbx_e": lbx_e,
        "ubx_e": ubx_e,
        "lbddu": lbddu,
        "ubddu": ubddu,
        "zddu": z,
        "Zddu": Z,
    }


def bounded_constraints(config: Config, model: Model) -> list[str]:
    """Return the names of the general constraints with bounds: those that the file bounds, and the obstacles, which come last."""
    named, own = {**config.ocp.bounds.constraints, **config.ocp.stages.constraints}, len(model.constraints) - len(config.ocp.obstacles)
    return [signal.name for i, signal in enumerate(model.constraints) if i >= own or signal.name in named]


def regulator_weight(config: Config, problem: Ocp) -> Array:
    """Return the terminal weight that the problem's own weights lead to, in the motion that `ocp.terminal.lqr` says."""
    from rti_mpc.rti.nominal import nominal_state
    from rti_mpc.rti.terminal import lqr_weight

    model, motion = problem.model, config.ocp.terminal.lqr
    assert motion is not None
    x = [motion.states.get(state.name, nominal) for state, nominal in zip(model.states, nominal_state(problem), strict=True)]
    u = [motion.inputs.get(input.name, rest) for input, rest in zip(model.inputs, model.u_rest, strict=True)]
    return lqr_weight(problem, np.array(x), np.array(u))


def stage_parameters(config: Config, t_s: Array) -> Array:
    """
    Return the stage parameters of a reference: positions of moving obstacles.

    Args:
        config: The robot's configuration, with its obstacles.
        t_s: Times of its rows from its start on, shape ``(M,)``, in s.

    Returns:
        Rows, shape ``(M, np)``: the model's own parameters, then x, y and radius of each obstacle; ``(M, 0)``, all nominal, if none moves.
    """
    if not any(any(obstacle.velocity_m_s) for obstacle in config.ocp.obstacles):
        return np.empty((len(t_s), 0))
    columns = [np.full(len(t_s), value) for value in build_model(config).p_nominal]
    for obstacle in config.ocp.obstacles:
        columns += [centre + speed * t_s for centre, speed in zip(obstacle.centre_m, obstacle.velocity_m_s, strict=True)]
        columns.append(np.full(len(t_s), obstacle.radius_m + obstacle.margin_m))
    return np.column_stack(columns)


def build_rti(config: Config, say: Callable[[str], object] = lambda _: None) -> Rti:
    """Return the real-time iteration, compiled; `say` takes a line if that takes its time and no terminal shows it."""
    from rti_mpc import codegen
    from rti_mpc.rti.rti import Rti
    from rti_mpc_service.compiling import compilation_shown
    from rti_mpc_service.injection import FaultyRti

    codegen.while_compiling = partial(compilation_shown, say=say)
    cls = FaultyRti if config.debug.inject else Rti
    settings = solver_settings(config)
    return cls(build_ocp(config), settings, formulation=config.ocp.formulation, solver=config.solver.name, **iterations(config))


def build_controller(config: Config, rti: Rti, stop_law: StopLaw | None) -> Controller:
    """Return the controller, whose epoch its leadership sets; a replay builds the same one."""
    from rti_mpc.control.controller import Controller, Timing

    return Controller(
        rti,
        Timing(config.delay_s, config.stale_s, config.timing.valid_s),
        config_hash=config.config_hash,
        observer=build_observer(config),
        stop_law=stop_law,
        second_opinion=config.solver.second_opinion,
    )


def build_observer(config: Config) -> Observer | None:
    """Return the observer, compiled, if there is anything to estimate."""
    from rti_mpc.control.observer import Disturbance, Observer, ObserverSettings

    if not (config.observer.disturbances or config.observer.measured):
        return None
    disturbances = {name: Disturbance(of.drift, of.limit) for name, of in config.observer.disturbances.items()}
    settings = ObserverSettings(disturbances, config.observer.measured, config.observer.noise, config.observer.process)
    return Observer(build_model(config), settings)


def disturbances_at_rest(config: Config) -> Array:
    """Return the largest magnitudes of the disturbances that go on while the robot stands, shape ``(nd,)``; empty if none do."""
    return np.array([of.limit for of in config.observer.disturbances.values()] if config.observer.at_rest else [])


def robot_settings(config: Config) -> dict[str, Any]:
    """Return the arguments of `rti_mpc_sim.settings.RobotSettings`; the slew limits are those of the increments."""
    from rti_mpc.contract.approach import Increments
    from rti_mpc.rti.nominal import nominal_state

    model, sim = build_model(config).with_parameters(**config.sim.parameters), config.sim
    lbdu, ubdu = bounds(config.ocp.bounds.increments, names(model.inputs))
    increments = Increments(np.array(lbdu), np.array(ubdu), round(1e9 * config.ocp.dt_s))
    lbu, ubu = bounds(config.ocp.bounds.inputs, names(model.inputs))
    return {
        "state_period_s": config.ocp.dt_s,
        **sim.model_dump(exclude_none=True, exclude={"parameters", "approaches"}),
        "model": model,
        "x0": [sim.x0.get(state.name, float(nominal)) for state, nominal in zip(model.states, nominal_state(build_ocp(config)), strict=True)],
        "noise_std": [sim.noise_std.get(state.name, 0.0) for state in model.states],
        "lbu": lbu,
        "ubu": ubu,
        "slew": [min(-lower, upper) / config.ocp.dt_s for lower, upper in zip(lbdu, ubdu, strict=True)],
        "increments": increments if sim.approaches else None,
    }


def operating_rates(config: Config) -> Array:
    """Return how fast each state of the simulated robot changes in operation, shape ``(nx,)``, per s."""
    from rti_mpc.rti.rest import TRIED_STATES, rates_of_operation, starts_of

    ocp = build_ocp(config)
    return rates_of_operation(ocp.model, starts_of(ocp, TRIED_STATES, np.empty(0)))


def guard_limits(config: Config, signals: Signals) -> Limits:
    """Return the limits of the guard, of a model with these signals; no model is loaded."""
    from rti_mpc.contract.limits import Limits
    from rti_mpc.control.grid import MAX_DELAY_PERIODS
    from rti_mpc.rotation import Rotations

    inputs = names(signals.inputs)
    lbu, ubu = bounds(config.ocp.bounds.inputs, inputs)
    lbdu, ubdu = bounds(config.ocp.bounds.increments, inputs)
    return Limits(
        u_rest=np.array(signals.u_rest),
        lbu=np.array(lbu),
        ubu=np.array(ubu),
        lbdu=np.array(lbdu),
        ubdu=np.array(ubdu),
        dt_s=config.ocp.dt_s,
        delay_s=MAX_DELAY_PERIODS * config.ocp.dt_s if config.delay_s is None else config.delay_s,
        rotations=Rotations.of(signals.states, signals.quaternions),
        stale_s=config.timing.valid_s,  # of commands, too: a ramp answers a state that is stale
    )


def with_initial_state(config: Config, assignments: Sequence[str]) -> Config:
    """
    Return a configuration with other initial states of the simulated robot.

    Args:
        config: The robot's configuration.
        assignments: Each ``name=value``, in the state's unit.

    Raises:
        ConfigError: An assignment is not valid, or the model has no such state.
    """
    given = assigned_numbers("--x0 must be NAME=VALUE, the value a finite number in the state's unit", assignments)
    states = build_model(config).states
    if unknown := given.keys() - {state.name for state in states}:
        name = min(unknown, key=list(given).index)
        raise ConfigError(f"--x0 {name} is {unknown_signal(name, 'state', states)}, got {given[name]:g}")
    return config.model_copy(update={"sim": config.sim.model_copy(update={"x0": {**config.sim.x0, **given}})})


def solver_settings(config: Config) -> SolverSettings | None:
    """Return the settings of OSQP, None if none are given."""
    from rti_mpc.rti.qp.osqp import SolverSettings

    given = config.solver.model_dump(exclude_none=True, exclude=OWN_KEYS)
    return SolverSettings(**given) if given else None


def iterations(config: Config) -> dict[str, Any]:
    """Return the given limits of the iterations per sample, by their names in `Rti`."""
    return config.solver.model_dump(exclude_none=True, include=ITERATION_KEYS)


def bus_settings(config: Config) -> BusSettings:
    """Return the bus settings of a process other than the robot, which connects and listens on a free port."""
    from rti_mpc.wire.bus import BusSettings

    return BusSettings(**config.bus.model_dump(exclude_none=True, exclude={"listen", "tls"}))


def as_sequence(values: tuple[float, ...], length: int) -> tuple[float, ...]:
    """Return a sequence of `length` values; a single value is repeated."""
    return values if len(values) == length else values * length


def bounds(table: Mapping[str, tuple[float, float]], names: Iterable[str]) -> tuple[list[float], list[float]]:
    """Return lower and upper bounds in the order of the names."""
    pairs = [table.get(name, (-math.inf, math.inf)) for name in names]
    return [lower for lower, _ in pairs], [upper for _, upper in pairs]


def by_stage(
    table: Mapping[str, tuple[float, float]], stages: Mapping[str, Sequence[tuple[float, float]]], names: Sequence[str], count: int
) -> tuple[Any, Any]:
    """Return lower and upper bounds as `bounds`, or, where some differ from stage to stage, with a row for each: the narrower of both."""
    lower, upper = bounds(table, names)
    if not stages:
        return lower, upper
    rows = [[stages.get(name, [(-math.inf, math.inf)] * count)[k] for name in names] for k in range(count)]
    return [np.maximum(lower, [low for low, _ in row]) for row in rows], [np.minimum(upper, [high for _, high in row]) for row in rows]


def factors(sequence: tuple[float, ...], stages: Mapping[str, Sequence[float]], names: Sequence[str]) -> Any:
    """Return factors of weights, one per stage, or, where some differ by signal, a row per stage."""
    return [[factor * stages[name][k] if name in stages else factor for name in names] for k, factor in enumerate(sequence)] if stages else sequence


def slack_weights(weight: float, stages: Mapping[str, Sequence[float]], names: Sequence[str], count: int) -> Any:
    """Return the weights of slacks in the order of the names, or, where some differ from stage to stage, a row per stage."""
    return by_block(dict.fromkeys(names, weight), {name: stages[name] for name in names if name in stages}, names, count)


def by_block(weights: Mapping[str, float], stages: Mapping[str, Sequence[float]], names: Sequence[str], count: int) -> Any:
    """Return weights in the order of the names, 0 for one left out, or, where some differ from block to block, a row per block."""
    if not stages:
        return [weights.get(name, 0.0) for name in names]
    return [[stages[name][k] if name in stages else weights.get(name, 0.0) for name in names] for k in range(count)]


def names(signals: Iterable[Signal | Label]) -> list[str]:
    """Return the names of signals."""
    return [signal.name for signal in signals]
