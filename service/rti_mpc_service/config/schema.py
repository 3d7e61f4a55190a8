# SPDX-License-Identifier: Apache-2.0
"""
The tables of a robot's TOML file, each a frozen model whose fields say what they are and in which unit.

What a table leaves out here as None, the library decides: a default stands in
one place only.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, AllowInfNan, BaseModel, BeforeValidator, ConfigDict, Field

from rti_mpc.wire.keys import Keys


def interval(value: object) -> object:
    """Accept ``[lower, upper]`` only; infinite where there is no bound."""
    if not (isinstance(value, list | tuple) and len(value) == 2 and all(type(v) in (int, float) for v in value) and value[0] < value[1]):
        raise ValueError("must be [lower, upper], two numbers with lower < upper")
    return tuple(value)


def around_zero(value: tuple[float, float]) -> tuple[float, float]:
    """Accept an interval in which an input can be raised, kept and lowered."""
    if not value[0] < 0.0 < value[1]:
        raise ValueError("must hold lower < 0 < upper, or the input could not be kept, or not brought to rest")
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
Increment = Annotated[Interval, AfterValidator(around_zero)]
Weight = Annotated[float, Field(ge=0, le=1e15)]  # beyond it, numbers are no numbers any more
Positive = Annotated[float, Field(gt=0)]
Weights = Annotated[tuple[Weight, ...], BeforeValidator(sequence)]
Pair = Annotated[tuple[float, float], BeforeValidator(pair)]
Duration = Annotated[float, Field(ge=0, le=10)]
Period = Annotated[float, Field(ge=1e-4, le=10)]
Endpoint = Annotated[str, Field(pattern=r"^[a-z0-9_-]+/\S+$")]
Endpoints = Annotated[tuple[Endpoint, ...], Field(strict=False)]

ITERATION_KEYS = {"iterations", "tolerance"}  # keys of [solver] that are settings of `Rti`, not of OSQP
RAMP_LEAD_S = 0.025  # time from a state going stale to the end of its plan, in which the ramp is computed and sent


class Section(BaseModel):
    """A table of the file: frozen, nothing unknown, numbers finite, no text taken for a number."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class ModelSection(Section):
    """Which robot."""

    name: str = Field(description="a shipped model, or one of your own: module:function or file.py:function, found beside this file first")
    folder: Annotated[Path, Field(strict=False)] | None = Field(
        default=None, description="folder that your module or file is looked for in first; that of this file if left out"
    )
    parameters: dict[str, float] = Field(default={}, description="parameters that differ from the model's by name, each in its own unit")
    stop: Literal["rests", "coasts"] = Field(
        default="rests",
        description="what a stop does to the robot: it rests, which is checked; or it coasts or falls, its inputs at rest",
    )


class WeightSection(Section):
    """The cost (4) of [Rosales]_."""

    Q: dict[str, Weight] = Field(description="weight of each output by name, in cost / unit of the output squared")
    R: dict[str, Weight] = Field(description="weight of each input's increment by name, in cost / unit of the input squared")
    delta: Weights = Field(default=(1.0,), description="factor of Q, without unit: a constant, or one for each of the N stages")
    lambda_: Weights = Field(default=(1.0,), alias="lambda", description="factor of R, without unit: a constant, or one for each of the N_u stages")


class BoundSection(Section):
    """What inputs, states and constraints may be; a name left out has no bound."""

    inputs: dict[str, Interval] = Field(default={}, description="bounds of inputs by name, in the input's unit")
    increments: dict[str, Increment] = Field(default={}, description="bounds of an input's change from sample to sample by name, in its unit")
    states: dict[str, Interval] = Field(default={}, description="softened bounds of states by name, in the state's unit")
    constraints: dict[str, Interval] = Field(default={}, description="softened bounds of the model's constraints by name, in the constraint's unit")
    soft_weight: Weight | None = Field(
        default=None, description="L1 weight of a state or constraint outside its bounds, and of an obstacle entered, in cost / its unit"
    )
    soft_weight_L2: Weight | None = Field(default=None, description="L2 weight of the same, in cost / its unit squared")


class RegulatorSection(Section):
    """Where the linear-quadratic regulator is linearized; what is left out is as in the model's nominal state, mostly zero, or an input's rest."""

    states: dict[str, float] = Field(default={}, description="states by name, in the state's unit; a wheeled robot must be in motion")
    inputs: dict[str, float] = Field(default={}, description="inputs by name, in the input's unit")


class TerminalSection(Section):
    """A weight on the last outputs of the horizon beside their Q: given, or from a regulator."""

    Q: dict[str, Weight] | None = Field(default=None, description="weight of each output by name, in cost / unit of the output squared")
    lqr: RegulatorSection | None = Field(default=None, description="instead: what the model's regulator would pay from there on for ever")


class ObstacleSection(Section):
    """A disc that the robot's position keeps out of, at the price of `soft_weight`."""

    centre_m: Pair = Field(description="its centre [x, y], in m")
    radius_m: Positive = Field(description="its radius, in m")
    margin_m: Weight = Field(default=0.0, description="kept from it, in m: the robot's own radius, and what it cuts short between two samples")
    velocity_m_s: Pair = Field(default=(0.0, 0.0), description="[x, y] in m/s, at which `rti-mpc reference` moves it from the reference's start on")


class OcpSection(Section):
    """The optimal control problem of one sample."""

    N: int = Field(ge=1, le=1000, description="horizon, in stages")
    N_u: int | None = Field(default=None, ge=1, description="control horizon, in stages; N if left out")
    dt_s: Period = Field(description="duration of a stage and period of the controller, in seconds")
    integrator: Literal["rk4", "euler"] = Field(default="rk4", description="integrator of a stage")
    formulation: Literal["auto", "simultaneous", "sequential"] = Field(default="auto", description="of the QP; auto takes the faster one")
    weights: WeightSection = Field(description="the cost")
    bounds: BoundSection = Field(default=BoundSection(), description="bounds of inputs, increments, states and constraints")
    terminal: TerminalSection = Field(default=TerminalSection(), description="weight on the end of the horizon; none if left out")
    obstacles: Annotated[tuple[ObstacleSection, ...], Field(strict=False)] = Field(default=(), description="discs to keep out of; none if left out")


class SolverSection(Section):
    """The QP solver, iterations a sample, and OSQP's settings; what is left out is as `Rti` and `SolverSettings` have it."""

    name: str = Field(default="riccati", description="riccati, with osqp behind it; osqp; or another one's name in qpsolvers, such as daqp")
    eps: float | None = Field(default=None, ge=1e-12, le=1e-1, description="absolute and relative tolerance on the residuals, without unit")
    max_iter: int | None = Field(default=None, ge=1, le=1_000_000, description="iterations at most; the iterate is then taken as it is")
    rho: float | None = Field(default=None, ge=1e-6, le=1e6, description="step size of ADMM, without unit")
    check_termination: int | None = Field(default=None, ge=1, le=1000, description="iterations between two looks at the residuals")
    iterations: int | None = Field(default=None, ge=1, le=100, description="QPs a sample at most: 1 is the plain real-time iteration, many are SQP")
    tolerance: float | None = Field(default=None, ge=0, le=2, description="step from which another follows, in shares of half an input's range")


class TimingSection(Section):
    """Delays and timeouts, in the robot's time."""

    delay_s: Duration | Literal["measured"] = Field(default=0.0, description="delay from a state to the act of its command, in seconds, or measured")
    stale_s: Period | None = Field(
        default=None, description="age from which a state is not used, in seconds; max(2.5 dt_s, 0.05) up to valid_s - 0.025 if left out"
    )
    valid_s: float = Field(default=0.25, gt=0, le=0.3, description="how long after a state its command may act, in seconds")


class DisturbanceSection(Section):
    """What is known of one disturbance."""

    drift: Positive = Field(description="random walk, in the input's unit, or the state's / s, each / sqrt(s): larger follows faster, and noisier")
    limit: Positive = Field(description="largest magnitude of the estimate, in the input's unit, or the state's / s")


class ObserverSection(Section):
    """An estimator of disturbances and of unmeasured states; what is left out is as `ObserverSettings` has it."""

    disturbances: dict[str, DisturbanceSection] = Field(
        default={}, description="by the name of an input, or of a state whose derivative is disturbed"
    )
    measured: Annotated[tuple[str, ...], Field(strict=False)] = Field(default=(), description="states that are measured; all if left out")
    noise: dict[str, Positive] = Field(default={}, description="standard deviation of measured states by name, in the state's unit")
    process: dict[str, Weight] = Field(default={}, description="random walk of states beside the model by name, in the state's unit / sqrt(s)")


class GuardSection(Section):
    """
    The guard, a process of its own between controller and robot.

    It loads no model: bounds and slew limits are those of ``ocp.bounds``, whose
    ``inputs`` must then name every input, in the model's order.
    """

    enabled: bool = Field(default=False, description="whether the robot takes what the guard passes on, not what the controller commands")
    tick_s: float = Field(default=0.01, ge=1e-3, le=0.01, description="between two looks at the clock, in seconds of the wall")
    u_rest: dict[str, float] = Field(default={}, description="inputs at which the robot stands by name, in the input's unit; zero if left out")
    states: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        default=(), description="the model's states in its order, for ways to rest that need feedback; none of those pass if left out"
    )
    angles: Annotated[tuple[str, ...], Field(strict=False)] = Field(default=(), description="those of the states that are angles")


class DebugSection(Section):
    """What is never wanted on a robot at work."""

    inject: bool = Field(default=False, description="whether requests may let samples fail, to see what the controller then does")


class ParamsSection(Section):
    """What `rti-mpc params` may do."""

    live: bool = Field(default=False, description="whether requests may change weights, and tighten bounds, while the controller runs")


class BusSection(Section):
    """The Zenoh session of each process; what is left out is as `BusSettings` has it, and the command line overrides it."""

    mode: Literal["peer", "client"] | None = Field(default=None, description="peer, or client of a router")
    listen: Endpoints | None = Field(default=None, description="endpoints the robot listens on, such as tcp/127.0.0.1:7447; connect's if left out")
    connect: Endpoints | None = Field(default=None, description="endpoints the others connect to, such as tcp/127.0.0.1:7447")
    config: Annotated[Path, Field(strict=False)] | None = Field(default=None, description="Zenoh's own JSON5 file, beside this one")


class RealtimeSection(Section):
    """What the controller asks of the operating system; each is attempted, reported, and not required."""

    priority: int | None = Field(
        default=None, ge=1, le=99, description="of the controller among SCHED_FIFO's, 1 to 99; the usual scheduler if left out"
    )
    cores: tuple[Annotated[int, Field(ge=0)], ...] = Field(
        default=(), strict=False, description="to run the controller on, by number; any if left out"
    )
    lock_memory: bool = Field(default=False, description="whether the controller's memory may not be swapped out")


class SimSection(Section):
    """The simulated robot, which may differ from the controller's model; what is left out is as `RobotSettings` has it."""

    x0: dict[str, float] = Field(
        default={}, description="initial state by name, in the state's unit; the model's nominal one, mostly zero, if left out"
    )
    parameters: dict[str, float] = Field(default={}, description="parameters of the plant that differ from [model]'s by name, each in its own unit")
    state_period_s: Period | None = Field(default=None, description="period of the states, in seconds of the robot; dt_s if left out")
    substeps: int | None = Field(default=None, ge=1, le=1000, description="RK4 steps in each period of the states")
    noise_std: dict[str, Weight] = Field(default={}, description="standard deviation of measured states by name, in the state's unit")
    sensor_delay_s: Duration | None = Field(default=None, description="from measuring a state to sending it, in seconds of the robot")
    dropout: float | None = Field(default=None, ge=0, lt=1, description="share of states lost on the way, without unit")
    actuator_delay_s: Duration | None = Field(default=None, description="from a command being due to the input moving, in seconds of the robot")
    actuator_lag_s: Duration | None = Field(default=None, description="time constant of the inputs, in seconds of the robot")
    reports_inputs: bool | None = Field(default=None, description="whether states tell which inputs act; true if left out")
    approaches: bool = Field(default=True, description="whether the robot itself approaches a command inside the slew limits, from what really acts")
    seed: int | None = Field(default=None, ge=0, description="seed of noise and dropout")


class Config(Section):
    """Everything physical about one robot."""

    robot: str = Field(pattern=r"^[A-Za-z0-9_.-]+$", description="the robot's name in keys: letters, digits, _ . -")
    prefix: str = Field(default="rti_mpc", pattern=r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$", description="what all keys begin with")
    model: ModelSection = Field(description="which robot")
    ocp: OcpSection = Field(description="the optimal control problem")
    solver: SolverSection = Field(default=SolverSection(), description="the QP solver's settings")
    timing: TimingSection = Field(default=TimingSection(), description="delays and timeouts")
    observer: ObserverSection = Field(default=ObserverSection(), description="estimator of disturbances and of unmeasured states; none if left out")
    guard: GuardSection = Field(default=GuardSection(), description="the guard between controller and robot")
    debug: DebugSection = Field(default=DebugSection(), description="failures on request")
    params: ParamsSection = Field(default=ParamsSection(), description="what may change while the controller runs")
    bus: BusSection = Field(default=BusSection(), description="the Zenoh session")
    realtime: RealtimeSection = Field(default=RealtimeSection(), description="what the controller asks of the operating system")
    sim: SimSection = Field(default=SimSection(), description="the simulated robot")

    @property
    def N_u(self) -> int:
        """Control horizon, in stages."""
        return self.ocp.N_u or self.ocp.N

    @property
    def stale_s(self) -> float:
        """Age from which a state is not used, s of the robot; early enough that the ramp is there before the last plan ends."""
        return self.timing.stale_s or min(max(2.5 * self.ocp.dt_s, 0.05), max(self.timing.valid_s - RAMP_LEAD_S, self.ocp.dt_s))

    @property
    def delay_s(self) -> float | None:
        """Delay from a state to the act of its command, s of the robot; None: measured."""
        return None if self.timing.delay_s == "measured" else self.timing.delay_s

    @property
    def config_hash(self) -> int:
        """64 bits of everything that decides a command: not of the bus, the guard, the scheduler, the simulation, failures on request or folders."""
        content = self.model_dump(mode="json", exclude={**dict.fromkeys(("bus", "debug", "guard", "realtime", "sim"), True), "model": {"folder"}})
        return int.from_bytes(hashlib.sha256(json.dumps(content, sort_keys=True).encode()).digest()[:8], "little")

    def keys(self) -> Keys:
        """Return the keys of this robot."""
        return Keys(self.prefix, self.robot)
