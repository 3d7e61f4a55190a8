# SPDX-License-Identifier: Apache-2.0
"""
Schema of a robot's TOML file: one frozen model per table, with meaning and unit of every key.

Keys that are None when left out have their default in the library, so that each
default is written in one place only.
"""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, AllowInfNan, BaseModel, BeforeValidator, ConfigDict, Field

from rti_mpc.wire.keys import NAMES, PATTERNS, Keys


def interval(value: object) -> object:
    """Accept ``[lower, upper]`` only; infinite where there is no bound."""
    if not (isinstance(value, list | tuple) and len(value) == 2 and all(type(v) in (int, float) for v in value) and value[0] < value[1]):
        raise ValueError("must be [lower, upper], two numbers with lower < upper")
    return tuple(value)


def input_interval(value: object) -> object:
    """Accept ``[lower, upper]``, or ``[value, value]`` for an input that is fixed."""
    fixed = (
        isinstance(value, list | tuple) and len(value) == 2 and type(value[0]) in (int, float) and abs(value[0]) < math.inf and value[0] == value[1]
    )
    return tuple(value) if fixed else interval(value)  # type: ignore[arg-type]


def around_zero(value: tuple[float, float]) -> tuple[float, float]:
    """Accept an interval with zero inside it: limits of an increment."""
    if not value[0] < 0.0 < value[1]:
        raise ValueError("must hold lower < 0 < upper, or the input could not be kept, or not brought to rest")
    return value


def within_zero(value: tuple[float, float]) -> tuple[float, float]:
    """Accept an interval with zero inside it: limits of a second difference."""
    if not value[0] < 0.0 < value[1]:
        raise ValueError("must hold lower < 0 < upper, or no increment could be kept and changed")
    return value


def pair(value: object) -> object:
    """Accept ``[x, y]`` only."""
    if not (isinstance(value, list | tuple) and len(value) == 2 and all(type(v) in (int, float) for v in value)):
        raise ValueError("must be [x, y], two numbers")
    return tuple(value)


def sequence(value: object) -> object:
    """Accept a constant for a sequence of length one."""
    return tuple(value) if isinstance(value, list | tuple) else (value,)


Bound = Annotated[float, AllowInfNan(True)]
Interval = Annotated[tuple[Bound, Bound], BeforeValidator(interval)]
InputInterval = Annotated[tuple[Bound, Bound], BeforeValidator(input_interval)]
Increment = Annotated[Interval, AfterValidator(around_zero)]
SecondDifference = Annotated[Interval, AfterValidator(within_zero)]
Weight = Annotated[float, Field(ge=0, le=1e15)]  # limited so that sums with terms of order 1 keep their digits
Positive = Annotated[float, Field(gt=0)]
Weights = Annotated[tuple[Weight, ...], BeforeValidator(sequence, json_schema_input_type=Weight | tuple[Weight, ...])]
Pair = Annotated[tuple[float, float], BeforeValidator(pair)]
Duration = Annotated[float, Field(ge=0, le=10)]
Period = Annotated[float, Field(ge=1e-4, le=10)]
Endpoint = Annotated[str, Field(pattern=r"^[a-z0-9_-]+/\S+$")]
Endpoints = Annotated[tuple[Endpoint, ...], Field(strict=False)]

ITERATION_KEYS = {"iterations", "tolerance", "build"}  # keys of [solver] that are settings of `Rti`, not of OSQP
OWN_KEYS = ITERATION_KEYS | {"name", "second_opinion"}  # all keys of [solver] that are no settings of OSQP
RAMP_LEAD_S = 0.025  # time left between a state becoming stale and the end of its plan, to compute and send the ramp


class Section(BaseModel):
    """A table of the file: frozen, unknown keys refused, numbers finite, no conversion of text to numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class ModelSection(Section):
    """The robot's model."""

    name: str = Field(description="a shipped model, or one of your own: module:function or file.py:function, found beside this file first")
    folder: Annotated[Path, Field(strict=False)] | None = Field(
        default=None, description="folder in which your module or file is looked for first; the folder of this file if left out"
    )
    parameters: dict[str, float] = Field(default={}, description="parameters that differ from the model's, by name, each in its own unit")
    stop: Literal["rests", "coasts"] = Field(
        default="rests",
        description="effect of a stop: rests if it brings the robot to rest, which is checked; coasts if it may coast or fall then",
    )


class WeightSection(Section):
    """The cost (4) of [Rosales]_."""

    Q: dict[str, Weight] = Field(description="weight of each output, by name, in cost / unit of the output squared")
    R: dict[str, Weight] = Field(description="weight of the increment of each input, by name, in cost / unit of the input squared")
    R_u: dict[str, Weight] = Field(
        default={}, description="weight of inputs themselves, by name, in cost / unit of the input squared, beside that of their increments"
    )
    u_ref: dict[str, float] = Field(default={}, description="inputs from which R_u counts, by name, in the input's unit; that at rest if left out")
    delta: Weights = Field(default=(1.0,), description="factor of Q, without unit: one number, or a list of N, one per stage")
    lambda_: Weights = Field(
        default=(1.0,), alias="lambda", description="factor of R, without unit: one number, or a list of N_u, one per stage or block"
    )


class BoundSection(Section):
    """Bounds [lower, upper] of inputs, increments, second differences, states and constraints; a name left out has no bound."""

    inputs: dict[str, InputInterval] = Field(default={}, description="bounds of inputs, by name, in the input's unit; equal ones fix the input")
    increments: dict[str, Increment] = Field(
        default={}, description="bounds of the change of an input from one sample to the next, by name, in the input's unit"
    )
    second_differences: dict[str, SecondDifference] = Field(
        default={},
        description="softened bounds of the change of an increment from one sample to the next (jerk), by name, in the input's unit",
    )
    states: dict[str, Interval] = Field(default={}, description="softened bounds of states, by name, in the state's unit")
    terminal: dict[str, Interval] = Field(
        default={}, description="softened bounds of states at the end of the horizon alone, a terminal set, by name, in the state's unit"
    )
    constraints: dict[str, Interval] = Field(default={}, description="softened bounds of the model's constraints, by name, in the constraint's unit")
    soft_weight: Weight | None = Field(
        default=None, description="L1 weight on the violation of a softened bound or an obstacle, in cost / unit of what is bounded"
    )
    soft_weight_L2: Weight | None = Field(default=None, description="L2 weight on the same, in cost / that unit squared")


class StagesSection(Section):
    """What differs from stage to stage, lists by name: one entry per stage, for inputs and increments per block of held inputs."""

    delta: dict[str, Annotated[tuple[Weight, ...], Field(strict=False)]] = Field(
        default={}, description="factors of an output's weight, besides weights.delta, a list of N by name, without unit"
    )
    lambda_: dict[str, Annotated[tuple[Weight, ...], Field(strict=False)]] = Field(
        default={},
        alias="lambda",
        description="factors of the weight of an input's increments, besides weights.lambda, a list of N_u by name, without unit",
    )
    R_u: dict[str, Annotated[tuple[Weight, ...], Field(strict=False)]] = Field(
        default={},
        description="weights of an input itself in each block, instead of weights.R_u, a list of N_u by name, in cost / unit of the input squared",
    )
    inputs: dict[str, Annotated[tuple[InputInterval, ...], Field(strict=False)]] = Field(
        default={}, description="bounds of inputs in each block, inside bounds.inputs, in the input's unit"
    )
    increments: dict[str, Annotated[tuple[Increment, ...], Field(strict=False)]] = Field(
        default={}, description="bounds of the change of an input at the start of each block, inside bounds.increments, in the input's unit"
    )
    states: dict[str, Annotated[tuple[Interval, ...], Field(strict=False)]] = Field(
        default={}, description="softened bounds of states at nodes 1 to N, inside bounds.states, in the state's unit"
    )
    constraints: dict[str, Annotated[tuple[Interval, ...], Field(strict=False)]] = Field(
        default={}, description="softened bounds of the model's constraints at nodes 1 to N, inside bounds.constraints, in the constraint's unit"
    )
    soft_weight: dict[str, Annotated[tuple[Weight, ...], Field(strict=False)]] = Field(
        default={},
        description="L1 weights on the violation of bounds of a state or constraint at nodes 1 to N, the last one for a terminal bound, too, "
        "instead of bounds.soft_weight, in cost / unit of what is bounded",
    )
    soft_weight_L2: dict[str, Annotated[tuple[Weight, ...], Field(strict=False)]] = Field(
        default={}, description="L2 weights on the same, instead of bounds.soft_weight_L2, in cost / that unit squared"
    )


class RegulatorSection(Section):
    """Point at which the linear-quadratic regulator is linearized; left out: the model's nominal state, mostly zero, and the inputs at rest."""

    states: dict[str, float] = Field(default={}, description="states, by name, in the state's unit; a wheeled robot must be in motion")
    inputs: dict[str, float] = Field(default={}, description="inputs, by name, in the input's unit")


class TerminalSection(Section):
    """A terminal weight on the outputs, added to their Q: given, or from a regulator."""

    Q: dict[str, Weight] | None = Field(default=None, description="weight of each output, by name, in cost / unit of the output squared")
    lqr: RegulatorSection | None = Field(
        default=None, description="instead of Q: the infinite-horizon cost of the linear-quadratic regulator about this point"
    )


class ObstacleSection(Section):
    """A disc that the robot's position stays out of; entering it costs `soft_weight`."""

    centre_m: Pair = Field(description="centre of the disc [x, y], in m")
    radius_m: Positive = Field(description="radius of the disc, in m")
    margin_m: Weight = Field(
        default=0.0, description="distance kept from the disc, in m: the robot's radius, and how far it cuts in between two samples"
    )
    velocity_m_s: Pair = Field(
        default=(0.0, 0.0), description="velocity [x, y], in m/s, with which `rti-mpc reference` moves the disc from the start of the reference on"
    )


class OcpSection(Section):
    """The optimal control problem of one sample."""

    N: int = Field(ge=1, le=1000, description="horizon, in stages")
    N_u: int | None = Field(default=None, ge=1, description="control horizon, in stages; N if left out")
    blocks: tuple[Annotated[int, Field(ge=1)], ...] | None = Field(
        default=None,
        strict=False,
        min_length=1,
        description="stages of each block over which inputs are held, together N, instead of N_u; one a stage if left out",
    )
    dt_s: Period = Field(description="duration of a stage and period of the controller, in seconds")
    integrator: Literal["rk4", "euler", "irk"] | None = Field(
        default=None,
        description="integrator of a stage: rk4; irk, implicit (Radau IIA), for stiff models; or euler; the model's own, mostly rk4, if left out",
    )
    sim_method_num_stages: int | None = Field(default=None, ge=1, le=3, description="stages of irk: 1, 2 or 3, of order 1, 3 or 5; 2 if left out")
    sim_method_num_steps: int | None = Field(
        default=None, ge=1, le=1000, description="steps into which the integrator divides a stage; the model's, mostly 1, if left out"
    )
    formulation: Literal["auto", "simultaneous", "sequential"] = Field(default="auto", description="formulation of the QP; auto takes the faster one")
    weights: WeightSection = Field(description="weights of the cost")
    bounds: BoundSection = Field(default=BoundSection(), description="bounds of inputs, increments, states and constraints")
    terminal: TerminalSection = Field(default=TerminalSection(), description="terminal weight; none if left out")
    stages: StagesSection = Field(default=StagesSection(), description="what differs from stage to stage; nothing if left out")
    obstacles: Annotated[tuple[ObstacleSection, ...], Field(strict=False)] = Field(default=(), description="discs to stay out of; none if left out")


class SolverSection(Section):
    """The QP solver, iterations per sample, and OSQP's settings; defaults are those of `Rti` and `SolverSettings`."""

    name: str = Field(
        default="riccati", description="riccati, with osqp as its backup; osqp; or the name of another solver in qpsolvers, such as daqp"
    )
    eps: float | None = Field(default=None, ge=1e-12, le=1e-1, description="OSQP: absolute and relative tolerance on the residuals, without unit")
    max_iter: int | None = Field(default=None, ge=1, le=1_000_000, description="OSQP: most iterations; the last iterate is then taken as it is")
    rho: float | None = Field(default=None, ge=1e-6, le=1e6, description="OSQP: step size of ADMM, without unit")
    check_termination: int | None = Field(default=None, ge=1, le=1000, description="OSQP: iterations between two checks of the residuals")
    iterations: int | None = Field(default=None, ge=1, le=100, description="most QPs per sample: 1 is the plain real-time iteration, many are SQP")
    tolerance: float | None = Field(
        default=None, ge=0, le=2, description="change of the inputs above which a further QP follows, as a share of half their range"
    )
    build: Literal["portable", "native"] = Field(
        default="portable", description="code of the solver for any processor of this kind, or, faster, for this very one"
    )
    second_opinion: int = Field(
        default=1, ge=0, le=1_000_000, description="every how many samples osqp solves the QP of another solver, too, in the slack; 0: never"
    )


class TimingSection(Section):
    """Delays and timeouts, in the robot's time."""

    delay_s: Duration | Literal["measured"] = Field(default=0.0, description="delay from a state until its command acts, in seconds; or measured")
    stale_s: Period | None = Field(
        default=None, description="age from which a state is no longer used, in seconds; if left out max(2.5 dt_s, 0.05), at most valid_s - 0.025"
    )
    valid_s: float = Field(default=0.25, gt=0, le=0.3, description="time after a state for which its command may act, in seconds")


class DisturbanceSection(Section):
    """Assumptions about one disturbance."""

    drift: Positive = Field(
        description="intensity of its random walk, in (input's unit) / sqrt(s) or (state's unit / s) / sqrt(s); larger: faster, with more noise"
    )
    limit: Positive = Field(description="largest magnitude of the estimate, in the input's unit, or the state's / s")


class ObserverSection(Section):
    """An estimator of disturbances and of unmeasured states; defaults are those of `ObserverSettings`."""

    disturbances: dict[str, DisturbanceSection] = Field(
        default={}, description="disturbances to estimate, by name of the input, or of the state whose derivative they are added to"
    )
    at_rest: bool = Field(
        default=False,
        description="whether disturbances go on while the robot stands, as wind and current do, slip and friction do not: a stop then balances them",
    )
    measured: Annotated[tuple[str, ...], Field(strict=False)] = Field(default=(), description="states that are measured; all if left out")
    noise: dict[str, Positive] = Field(
        default={}, description="standard deviation of the measurement noise of states, by name, in the state's unit; of others 1e-3 of their scale"
    )
    process: dict[str, Weight] = Field(
        default={}, description="intensity of the process noise of states, by name, in the state's unit / sqrt(s); of others 1e-3 of their scale"
    )


class GuardSection(Section):
    """
    The guard, a separate process between controller and robot.

    It loads no model: bounds and slew limits are those of ``ocp.bounds``, whose
    ``inputs`` must then name every input. Order, angles and inputs at rest are in the
    file of signals that `rti-mpc check` writes beside this one, to be copied with it.
    """

    enabled: bool = Field(default=False, description="whether the robot obeys the guard (key actuation) instead of the controller (key command)")
    tick_s: float = Field(default=0.01, ge=1e-3, le=0.01, description="time between two checks of the clock, in seconds of wall time")


class DebugSection(Section):
    """Failures on request, for tests; not for a robot in use."""

    inject: bool = Field(default=False, description="whether requests may make samples fail, to test how the controller responds")


class ParamsSection(Section):
    """Parameters that `rti-mpc params` may change."""

    live: bool = Field(default=False, description="whether requests may change weights, and tighten bounds, while the controller runs")


class BusSection(Section):
    """The Zenoh session of each process; defaults are those of `BusSettings`, and the command line overrides it."""

    mode: Literal["peer", "client"] | None = Field(default=None, description="Zenoh mode: peer, or client of a router")
    listen: Endpoints | None = Field(
        default=None, description="endpoints on which the robot listens, such as tcp/127.0.0.1:7447; those of connect if left out"
    )
    connect: Endpoints | None = Field(default=None, description="endpoints to which the other processes connect, such as tcp/127.0.0.1:7447")
    config: Annotated[Path, Field(strict=False)] | None = Field(
        default=None, description="Zenoh configuration file, JSON5, looked for beside this file"
    )
    tls: Annotated[Path, Field(strict=False)] | None = Field(
        default=None, description="folder with authority and certificates that `rti-mpc certs` has issued to this host, looked for beside this file"
    )


class RealtimeSection(Section):
    """Scheduling of the controller by the operating system; each setting is attempted, reported, and not required."""

    priority: int | None = Field(
        default=None, ge=1, le=99, description="SCHED_FIFO priority of the controller, 1 to 99; the default scheduler if left out"
    )
    cores: tuple[Annotated[int, Field(ge=0)], ...] = Field(
        default=(), strict=False, description="numbers of the cores on which the controller runs; any core if left out"
    )
    lock_memory: bool = Field(default=False, description="whether the controller's memory is locked, so that it is never swapped out")
    rehearse: bool = Field(
        default=True,
        description="whether each sample is rehearsed shortly before its state is due, so that it finds warm caches; commands stay the same",
    )


class ReferenceSection(Section):
    """What the robot follows where the command line names nothing else."""

    scenario: str | None = Field(
        default=None,
        description="name of a scenario, as in --scenario, or a CSV file, looked for beside this file; "
        "eight for a robot in the plane, and sines for any other, if left out",
    )
    duration_s: Positive | None = Field(default=None, description="how long it is followed, in seconds; the scenario's own time if left out")


class SimSection(Section):
    """The simulated robot, which may differ from the controller's model; defaults are those of `RobotSettings`."""

    x0: dict[str, float] = Field(
        default={}, description="initial state, by name, in the state's unit; the model's nominal state, mostly zero, if left out"
    )
    parameters: dict[str, float] = Field(default={}, description="parameters of the plant that differ from [model]'s, by name, each in its own unit")
    state_period_s: Period | None = Field(default=None, description="time between two states, in seconds of the robot; dt_s if left out")
    substeps: int | None = Field(default=None, ge=1, le=1000, description="steps of the model's integrator between two states")
    noise_std: dict[str, Weight] = Field(default={}, description="standard deviation of the noise of measured states, by name, in the state's unit")
    sensor_delay_s: Duration | None = Field(default=None, description="delay from measuring a state to sending it, in seconds of the robot")
    dropout: float | None = Field(default=None, ge=0, lt=1, description="share of states that are lost, without unit")
    actuator_delay_s: Duration | None = Field(default=None, description="delay of the actuators, in seconds of the robot")
    actuator_lag_s: Duration | None = Field(default=None, description="time constant of the actuators, in seconds of the robot")
    reports_inputs: bool | None = Field(default=None, description="whether states report the acting inputs; true if left out")
    approaches: bool = Field(
        default=True, description="whether the robot itself keeps to the slew limits while it approaches a command from the inputs that act"
    )
    seed: int | None = Field(default=None, ge=0, description="seed of noise and dropout")


class Config(Section):
    """Configuration of one robot."""

    robot: str = Field(pattern=PATTERNS["robot"], description=f"the robot's name in keys: {NAMES['robot']}")
    prefix: str = Field(default="rti_mpc", pattern=PATTERNS["prefix"], description=f"first part of all keys: {NAMES['prefix']}")
    model: ModelSection = Field(description="the robot's model")
    ocp: OcpSection = Field(description="the optimal control problem")
    solver: SolverSection = Field(default=SolverSection(), description="the QP solver and its settings")
    timing: TimingSection = Field(default=TimingSection(), description="delays and timeouts")
    observer: ObserverSection = Field(default=ObserverSection(), description="estimator of disturbances and of unmeasured states; none if left out")
    guard: GuardSection = Field(default=GuardSection(), description="the guard between controller and robot")
    debug: DebugSection = Field(default=DebugSection(), description="failures on request, for tests")
    params: ParamsSection = Field(default=ParamsSection(), description="changes while the controller runs")
    bus: BusSection = Field(default=BusSection(), description="the Zenoh session")
    realtime: RealtimeSection = Field(default=RealtimeSection(), description="scheduling of the controller by the operating system")
    reference: ReferenceSection = Field(default=ReferenceSection(), description="what the robot follows")
    sim: SimSection = Field(default=SimSection(), description="the simulated robot")

    @property
    def N_u(self) -> int:
        """Control horizon, in stages, or the number of blocks."""
        return len(self.ocp.blocks) if self.ocp.blocks else self.ocp.N_u or self.ocp.N

    @property
    def stale_s(self) -> float:
        """Age from which a state is no longer used, s of the robot; early enough for the ramp to arrive before the last plan ends."""
        return self.timing.stale_s or min(max(2.5 * self.ocp.dt_s, 0.05), max(self.timing.valid_s - RAMP_LEAD_S, self.ocp.dt_s))

    @property
    def delay_s(self) -> float | None:
        """Delay from a state until its command acts, s of the robot; None: measured."""
        return None if self.timing.delay_s == "measured" else self.timing.delay_s

    @property
    def config_hash(self) -> int:
        """Hash, 64 bits, of all keys on which commands depend: not bus, guard, reference, scheduling, simulation, failures on request and folders."""
        others = ("bus", "debug", "guard", "realtime", "reference", "sim")
        content = self.model_dump(mode="json", exclude={**dict.fromkeys(others, True), "model": {"folder"}})
        return int.from_bytes(hashlib.sha256(json.dumps(content, sort_keys=True).encode()).digest()[:8], "little")

    def keys(self) -> Keys:
        """Return the keys of this robot."""
        return Keys(self.prefix, self.robot)
