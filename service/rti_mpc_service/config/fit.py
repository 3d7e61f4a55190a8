# SPDX-License-Identifier: Apache-2.0
"""Checks of a configuration beyond each table's own: its keys against each other, its names against the model, and its solver."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from rti_mpc.errors import ConfigError, OcpError
from rti_mpc_service.config.build import build_ocp, disturbances_at_rest
from rti_mpc_service.config.refusal import quoted, unknown_name
from rti_mpc_service.config.schema import OWN_KEYS, RAMP_LEAD_S, Config, RegulatorSection

if TYPE_CHECKING:
    from rti_mpc.model.model import Model, Signal
    from rti_mpc.rti.ocp import Ocp
    from rti_mpc.rti.way_to_rest import StopLaw

COMPLETE_TABLES = ("ocp.weights.Q", "ocp.weights.R", "ocp.terminal.Q")  # that must have every name
STAGE_TABLES = {  # of ocp.stages by field: what its names are, and what its lists have an entry for
    "delta": ("output", "stage"),
    "lambda_": ("input", "block"),
    "R_u": ("input", "block"),
    "inputs": ("input", "block"),
    "increments": ("input", "block"),
    "states": ("state", "stage"),
    "constraints": ("constraint", "stage"),
    "soft_weight": ("state or constraint", "stage"),
    "soft_weight_L2": ("state or constraint", "stage"),
}
TRANSIT_S = 0.02  # in which a command is computed and has arrived, on a busy host too
P = ParamSpec("P")
T = TypeVar("T")


def check_tree(config: Config) -> None:
    """
    Check keys against each other and against the file system.

    Raises:
        ConfigError: A key does not fit the others.
    """
    ocp, terminal = config.ocp, config.ocp.terminal
    if terminal.Q is not None and terminal.lqr is not None:
        raise ConfigError("ocp.terminal must have Q or lqr, not both")
    if config.observer.at_rest and not config.observer.disturbances:
        raise ConfigError("observer.at_rest says what observer.disturbances do while the robot stands, and there are none")
    if ocp.blocks is not None and ocp.N_u is not None:
        raise ConfigError("ocp must have N_u or blocks, not both")
    if ocp.blocks is not None and sum(ocp.blocks) != ocp.N:
        raise ConfigError(f"ocp.blocks must have ocp.N = {ocp.N} stages together, got {sum(ocp.blocks)} in {quoted(list(ocp.blocks))}")
    if config.N_u > ocp.N:
        raise ConfigError(f"ocp.N_u must be at most ocp.N = {ocp.N}, got {ocp.N_u}")
    of_lambda = "stage" if ocp.blocks is None else "block"
    for key, values, length, each in (("delta", ocp.weights.delta, ocp.N, "stage"), ("lambda", ocp.weights.lambda_, config.N_u, of_lambda)):
        if len(values) not in (1, length):
            raise ConfigError(f"ocp.weights.{key} must be a number or a list of {length}, one per {each}, got {quoted(list(values))}")
    for field, (_, each) in STAGE_TABLES.items():
        length = ocp.N if each == "stage" else config.N_u
        for name, listed in getattr(ocp.stages, field).items():
            if len(listed) != length:
                of = "block of inputs" if length != ocp.N else "stage"
                raise ConfigError(f"ocp.stages.{field.rstrip('_')}.{name} must be a list of {length}, one per {of}, got {len(listed)}")
    if twice := sorted(ocp.stages.R_u.keys() & ocp.weights.R_u.keys()):
        raise ConfigError(f"ocp.stages.R_u has the weights of {twice[0]} in each block, which ocp.weights.R_u must leave out")
    bounded = {*ocp.bounds.states, *ocp.bounds.terminal, *ocp.bounds.constraints, *ocp.stages.states, *ocp.stages.constraints}
    for key in ("soft_weight", "soft_weight_L2"):
        if unbounded := sorted(getattr(ocp.stages, key).keys() - bounded):
            name = unbounded[0]
            raise ConfigError(f"ocp.stages.{key}.{name} must be left out, or {name} bounded: it has no softened bound in ocp.bounds or ocp.stages")
    if config.bus.config is not None and not config.bus.config.is_file():
        raise ConfigError(f"bus.config must be a file, got {config.bus.config}")
    check_times(config)
    if config.guard.enabled:
        for name in ocp.weights.R:
            if name not in ocp.bounds.inputs:
                raise ConfigError(f"ocp.bounds.inputs must bound every input where a guard is enabled, {name} is missing")


def check_times(config: Config) -> None:
    """
    Check that a state becomes stale neither after the end of its plan nor before the next one comes.

    Raises:
        ConfigError: One of two times would have to be shorter than the other.
    """
    timing, sim, dt_s = config.timing, config.sim, config.ocp.dt_s
    longest_s = round(max(timing.valid_s - RAMP_LEAD_S, dt_s), 9)
    if config.stale_s > longest_s:
        raise ConfigError(
            f"timing.stale_s must be at most {longest_s:g} s, {RAMP_LEAD_S:g} s less than timing.valid_s = {timing.valid_s:g} s, so that the ramp "
            f"of a robot whose states are stale arrives before its last plan ends, got {config.stale_s:g} s: lower it, or leave it out"
        )
    if sim.state_period_s is not None and sim.state_period_s > config.stale_s:
        which = "timing.stale_s" if timing.stale_s else "timing.stale_s, left out,"
        raise ConfigError(
            f"sim.state_period_s must be at most {which} = {config.stale_s:g} s, or each state is stale before the next one comes, "
            f"got {sim.state_period_s:g} s"
        )
    if sim.state_period_s is None and dt_s > config.stale_s:
        raise ConfigError(
            f"timing.stale_s must be at least {dt_s:g} s, the time between two states, which is ocp.dt_s where sim.state_period_s is left out, "
            f"got {config.stale_s:g} s: raise it, or say in sim.state_period_s how much more often states come"
        )


def check_model(config: Config) -> Ocp:
    """
    Check the configuration against the model, and return the problem.

    Raises:
        ConfigError: A key does not fit the model.
        OcpError: The problem is ill-posed in some other way.
    """
    from rti_mpc.model.find import find_model
    from rti_mpc.model.obstacle import with_obstacles
    from rti_mpc.rti.nominal import check_stiffness, nominal_state

    model = named("model.name", find_model, config.model.name, config.model.folder)
    check_names(config, model)
    check_solver(config)
    stages = config.ocp.sim_method_num_stages
    if stages is not None and (config.ocp.integrator or model.method) != "irk":
        raise ConfigError(f'ocp.sim_method_num_stages must be left out, or ocp.integrator be "irk": other integrators have their own, got {stages}')
    named("ocp.obstacles", with_obstacles, model, [(0.0, 0.0, 1.0) for _ in config.ocp.obstacles])
    ocp = build_ocp(config)
    check_rest(ocp)
    named("ocp.dt_s", check_stiffness, ocp, named("model.name", nominal_state, ocp))
    return ocp


def named(key: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """
    Return what a call of the library returns.

    Raises:
        ConfigError: It refuses; the message begins with the key that is to blame.
    """
    try:
        return call(*args, **kwargs)
    except OcpError as error:
        raise ConfigError(f"{key}: {error}") from error


def check_rest(ocp: Ocp) -> None:
    """
    Check that every input can be brought to its rest.

    Raises:
        ConfigError: The bounds of an input exclude its rest.
    """
    from rti_mpc.rti.ocp import rest_fault

    if wrong := rest_fault(ocp):
        raise ConfigError(f"ocp.bounds: {wrong}")


def check_period(config: Config) -> None:
    """
    Check that each command lasts until the next one has come, where commands are sent.

    Raises:
        ConfigError: The robot would go to rest between any two of them.
    """
    if config.ocp.N < 2:
        raise ConfigError(
            f"ocp.N must be at least 2 for a robot on the bus: a plan of one stage lasts for ocp.dt_s = {config.ocp.dt_s:g} s, "
            "and the robot would go to rest before the next one comes, got 1"
        )
    longest_s = round(config.timing.valid_s - TRANSIT_S, 9)
    if config.ocp.dt_s > longest_s:
        raise ConfigError(
            f"ocp.dt_s must be at most {longest_s:.3g} s for a robot on the bus: a command acts for timing.valid_s = {config.timing.valid_s:g} s "
            f"after its state, and the robot would go to rest before the next one comes, got {config.ocp.dt_s:g} s: shorten it, with a larger N "
            "or blocks for the same horizon, or raise timing.valid_s, to at most 0.3 s"
        )
    if config.sim.sensor_delay_s is None or config.delay_s is None:
        return
    period_s = max(config.ocp.dt_s, config.sim.state_period_s or 0.0)
    latest_s = round(config.timing.valid_s + config.delay_s - period_s - TRANSIT_S, 9)
    if config.sim.sensor_delay_s > latest_s:
        raise ConfigError(
            f"sim.sensor_delay_s must be at most {latest_s:.3g} s: a command acts until timing.valid_s + timing.delay_s = "
            f"{config.timing.valid_s + config.delay_s:g} s after its state was measured, and the next one comes {period_s:g} s later, "
            f"got {config.sim.sensor_delay_s:g} s: raise timing.delay_s, which is to cover it, or set it to measured"
        )


def check_stop(config: Config) -> StopLaw | None:
    """
    Check that a stop brings the robot to rest, unless its file says that it coasts.

    Returns:
        What its way to rest is made with; None for a robot whose inputs ramp to rest.

    Raises:
        ConfigError: The robot does not come to rest from where it operates; the text says from where, and what still moves.
    """
    from rti_mpc.rti.kept_law import find_kept_stop_law

    if config.model.stop == "coasts":
        return None
    try:
        return find_kept_stop_law(build_ocp(config), disturbances_at_rest(config), config.delay_s or 0.0)
    except OcpError as error:
        raise ConfigError(unstopped(config, error)) from error


def unstopped(config: Config, seen: object) -> str:
    """Say that a stop does not bring the robot to rest, what was seen of it, and what to do."""
    sooner = f"lower timing.delay_s, which is {config.delay_s:g} s, " if config.delay_s else ""
    calmer = "lower limits in observer.disturbances to what its inputs can balance, " if config.observer.at_rest else ""
    return (
        f"model.name: a stop must bring {config.model.name} to rest: {seen}; {sooner}{calmer}bound in ocp.bounds.states where it operates, "
        f'let the model say how it stops (stop_expr), or say that it is let go by stop = "coasts" in [model]'
    )


def check_names(config: Config, model: Model) -> None:
    """
    Check that names are those of the model.

    Raises:
        ConfigError: One is not, or one is missing.
    """
    ocp, sim, observer, terminal = config.ocp, config.sim, config.observer, config.ocp.terminal
    regulator = terminal.lqr or RegulatorSection()
    tables: tuple[tuple[str, Mapping[str, object], str, tuple[Signal, ...]], ...] = (
        ("model.parameters", config.model.parameters, "parameter", model.parameters),
        ("ocp.weights.Q", ocp.weights.Q, "output", model.outputs),
        ("ocp.weights.R", ocp.weights.R, "input", model.inputs),
        ("ocp.weights.R_u", ocp.weights.R_u, "input", model.inputs),
        ("ocp.weights.u_ref", ocp.weights.u_ref, "input", model.inputs),
        ("ocp.bounds.inputs", ocp.bounds.inputs, "input", model.inputs),
        ("ocp.bounds.increments", ocp.bounds.increments, "input", model.inputs),
        ("ocp.bounds.second_differences", ocp.bounds.second_differences, "input", model.inputs),
        ("ocp.bounds.states", ocp.bounds.states, "state", model.states),
        ("ocp.bounds.terminal", ocp.bounds.terminal, "state", model.states),
        ("ocp.bounds.constraints", ocp.bounds.constraints, "constraint", model.constraints),
        *((f"ocp.stages.{key.rstrip('_')}", getattr(ocp.stages, key), kind, signals_of(model, kind)) for key, (kind, _) in STAGE_TABLES.items()),
        *((("ocp.terminal.Q", terminal.Q, "output", model.outputs),) if terminal.Q is not None else ()),
        ("ocp.terminal.lqr.states", regulator.states, "state", model.states),
        ("ocp.terminal.lqr.inputs", regulator.inputs, "input", model.inputs),
        ("observer.disturbances", observer.disturbances, "input or state", signals_of(model, "input or state")),
        ("observer.measured", dict.fromkeys(observer.measured), "state", model.states),
        ("observer.noise", observer.noise, "state", model.states),
        ("observer.process", observer.process, "state", model.states),
        ("sim.x0", sim.x0, "state", model.states),
        ("sim.noise_std", sim.noise_std, "state", model.states),
        ("sim.parameters", sim.parameters, "parameter", model.parameters),
    )
    for key, table, kind, signals in tables:
        if wrong := unknown_name(key, table, kind, signals, complete=key in COMPLETE_TABLES):
            raise ConfigError(wrong)


def signals_of(model: Model, kind: str) -> tuple[Signal, ...]:
    """Return the signals of a kind, such as ``"state"``, or of either of two, ``"state or constraint"``."""
    return tuple(signal for each in kind.split(" or ") for signal in getattr(model, f"{each}s"))


def check_solver(config: Config) -> None:
    """
    Check that the QP solver is installed, and that the given settings are its own.

    Raises:
        ConfigError: It is not installed, or a setting belongs to another solver.
    """
    if "name" not in config.solver.model_fields_set:
        return
    from rti_mpc.rti.qp.qpsolvers import check_name  # a robot or a viewer has no use for solvers
    from rti_mpc.rti.rti import BUILT_IN_SOLVERS

    if config.solver.name in BUILT_IN_SOLVERS:
        return
    named("solver.name", check_name, config.solver.name)
    if foreign := config.solver.model_dump(exclude_none=True, exclude=OWN_KEYS):
        key, got = next(iter(foreign.items()))
        raise ConfigError(f"solver.{key} is a setting of osqp, it must be left out for solver.name = {config.solver.name!r}, got {got}")
