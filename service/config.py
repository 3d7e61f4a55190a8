# SPDX-License-Identifier: Apache-2.0
"""
The configuration of one robot: a TOML file, read once into a frozen tree.

Everything is checked here, so that nothing behind this door checks again: the
tree by itself (`service.schema`), then its names against the model, then the
whole by building the `Ocp`. Each refusal is one line (`service.refusal`).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field, ValidationError

from rti_mpc.errors import ConfigError, OcpError
from rti_mpc.text_file import read_text_file
from service import toml
from service.refusal import explain, quoted, unknown_name
from service.schema import (
    BusSection,
    DebugSection,
    GuardSection,
    ModelSection,
    ObserverSection,
    OcpSection,
    ParamsSection,
    RealtimeSection,
    Section,
    SimSection,
    SolverSection,
    TimingSection,
)

if TYPE_CHECKING:
    from rti_mpc.array import Array
    from rti_mpc.guard import Limits
    from rti_mpc.model import Model, Signal
    from rti_mpc.observer import Observer
    from rti_mpc.ocp import Ocp
    from rti_mpc.rti import Rti
    from rti_mpc.solver import SolverSettings
    from rti_mpc.wire.bus import BusSettings
    from rti_mpc.wire.keys import Keys


ITERATIONS = {"iterations", "tolerance"}  # what of the solver's section is not OSQP's
RAMP_LEAD_S = 0.025  # from a state going stale to the end of its plan: in it the ramp is made, and reaches the robot


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
        """64 bits of everything that decides a command: not of the bus, the guard, the scheduler, the simulation or failures on request."""
        content = self.model_dump(mode="json", exclude={"bus", "debug", "guard", "realtime", "sim"})
        return int.from_bytes(hashlib.sha256(json.dumps(content, sort_keys=True).encode()).digest()[:8], "little")

    def build_model(self) -> Model:
        """Return the controller's model."""
        from rti_mpc.model import find_model

        return find_model(self.model.name).with_parameters(**self.model.parameters)

    def build_ocp(self) -> Ocp:
        """Return the optimal control problem; its model has the obstacles and, last, the disturbances among its parameters."""
        from rti_mpc.disturbance import with_disturbances
        from rti_mpc.obstacle import with_obstacles
        from rti_mpc.ocp import Ocp

        own = self.build_model()
        discs = [(*obstacle.centre_m, obstacle.radius_m + obstacle.margin_m) for obstacle in self.ocp.obstacles]
        model = with_disturbances(with_obstacles(own, discs), self.observer.disturbances)
        limits, terminal = self.ocp.bounds, self.ocp.terminal
        outside = {signal.name: (0.0, math.inf) for signal in model.constraints[len(own.constraints) :]}
        bounded = [i for i, signal in enumerate(model.constraints) if signal.name in (limits.constraints | outside)]
        lh, uh = bounds(limits.constraints | outside, names(model.constraints[i] for i in bounded))
        problem = Ocp(
            model,
            N=self.ocp.N,
            N_u=self.N_u,
            dt=self.ocp.dt_s,
            method=self.ocp.integrator,
            Q_e=None if terminal.Q is None else [terminal.Q[output.name] for output in model.outputs],
            h_expr=model.h_expr[bounded, 0],
            lh=lh,
            uh=uh,
            **self.weights_and_bounds(model),
        )
        return problem if terminal.lqr is None else problem.retuned(Q_e=self.lqr_weight(problem))

    def retuned(self, problem: Ocp) -> Ocp:
        """Return a problem that was built of another configuration with the weights and bounds of this one; all else is kept, not built again."""
        other = problem.retuned(**self.weights_and_bounds(problem.model))
        return other if self.ocp.terminal.lqr is None else other.retuned(Q_e=self.lqr_weight(other))

    def weights_and_bounds(self, model: Model) -> dict[str, Any]:
        """Return those of the problem that may change while it is solved, as `Ocp` names them."""
        from rti_mpc.ocp import SOFT_WEIGHT

        weights, limits = self.ocp.weights, self.ocp.bounds
        z, Z = (SOFT_WEIGHT if weight is None else weight for weight in (limits.soft_weight, limits.soft_weight_L2))
        lbu, ubu = bounds(limits.inputs, names(model.inputs))
        lbdu, ubdu = bounds(limits.increments, names(model.inputs))
        lbx, ubx = bounds(limits.states, names(model.states))
        return {
            "Q": [weights.Q[output.name] for output in model.outputs],
            "R": [weights.R[input.name] for input in model.inputs],
            "delta": spread(weights.delta, self.ocp.N),
            "lambda_": spread(weights.lambda_, self.N_u),
            "lbu": lbu,
            "ubu": ubu,
            "lbdu": lbdu,
            "ubdu": ubdu,
            "lbx": lbx,
            "ubx": ubx,
            "z": z,
            "Z": Z,
            "zh": z,
            "Zh": Z,
        }

    def lqr_weight(self, problem: Ocp) -> Array:
        """Return the terminal weight that the problem's own weights lead to, in the motion that `ocp.terminal.lqr` says."""
        from rti_mpc.terminal import lqr_weight

        model, motion = problem.model, self.ocp.terminal.lqr
        assert motion is not None
        x = [motion.states.get(state.name, 0.0) for state in model.states]
        u = [motion.inputs.get(input.name, rest) for input, rest in zip(model.inputs, model.u_rest, strict=True)]
        return lqr_weight(problem, np.array(x), np.array(u))

    def stage_parameters(self, t_s: Array) -> Array:
        """
        Return what a reference carries of moving obstacles.

        Args:
            t_s: Times of its rows from its start on, shape ``(M,)``, in s.

        Returns:
            Rows, shape ``(M, np)``: the model's own parameters, then x, y and radius of each obstacle; ``(M, 0)``, all nominal, if none moves.
        """
        if not any(any(obstacle.velocity_m_s) for obstacle in self.ocp.obstacles):
            return np.empty((len(t_s), 0))
        columns = [np.full(len(t_s), value) for value in self.build_model().p_nominal]
        for obstacle in self.ocp.obstacles:
            columns += [centre + speed * t_s for centre, speed in zip(obstacle.centre_m, obstacle.velocity_m_s, strict=True)]
            columns.append(np.full(len(t_s), obstacle.radius_m + obstacle.margin_m))
        return np.column_stack(columns)

    def build_rti(self) -> Rti:
        """Return the real-time iteration, compiled."""
        from rti_mpc.rti import Rti
        from service.injection import FaultyRti

        cls = FaultyRti if self.debug.inject else Rti
        settings = self.solver_settings()
        return cls(self.build_ocp(), settings, formulation=self.ocp.formulation, solver=self.solver.name, **self.iterations())

    def build_observer(self) -> Observer | None:
        """Return the observer, compiled, if there is anything to estimate."""
        from rti_mpc.observer import Disturbance, Observer, ObserverSettings

        if not (self.observer.disturbances or self.observer.measured):
            return None
        disturbances = {name: Disturbance(of.drift, of.limit) for name, of in self.observer.disturbances.items()}
        settings = ObserverSettings(disturbances, self.observer.measured, self.observer.noise, self.observer.process)
        return Observer(self.build_model(), settings)

    def robot_settings(self) -> dict[str, Any]:
        """Return what `sim.settings.RobotSettings` is made from; the slew limits are those of the increments."""
        import numpy as np

        from rti_mpc.approach import Increments

        model, sim = self.build_model().with_parameters(**self.sim.parameters), self.sim
        lbdu, ubdu = bounds(self.ocp.bounds.increments, names(model.inputs))
        increments = Increments(np.array(lbdu), np.array(ubdu), round(1e9 * self.ocp.dt_s))
        lbu, ubu = bounds(self.ocp.bounds.inputs, names(model.inputs))
        return {
            "state_period_s": self.ocp.dt_s,
            **sim.model_dump(exclude_none=True, exclude={"parameters", "approaches"}),
            "model": model,
            "x0": [sim.x0.get(state.name, 0.0) for state in model.states],
            "noise_std": [sim.noise_std.get(state.name, 0.0) for state in model.states],
            "lbu": lbu,
            "ubu": ubu,
            "slew": [min(-lower, upper) / self.ocp.dt_s for lower, upper in zip(lbdu, ubdu, strict=True)],
            "increments": increments if sim.approaches else None,
        }

    def guard_limits(self) -> Limits:
        """Return what the guard lets pass; its configuration is enough, no model is loaded."""
        import numpy as np

        from rti_mpc.grid import MOST
        from rti_mpc.guard import Limits

        inputs = tuple(self.ocp.bounds.inputs)
        lbu, ubu = bounds(self.ocp.bounds.inputs, inputs)
        lbdu, ubdu = bounds(self.ocp.bounds.increments, inputs)
        return Limits(
            u_rest=np.array([self.guard.u_rest.get(name, 0.0) for name in inputs]),
            lbu=np.array(lbu),
            ubu=np.array(ubu),
            lbdu=np.array(lbdu),
            ubdu=np.array(ubdu),
            dt_s=self.ocp.dt_s,
            delay_s=MOST * self.ocp.dt_s if self.delay_s is None else self.delay_s,
            stale_s=self.timing.valid_s,  # of commands, too: a ramp answers a state that is stale
        )

    def with_initial_state(self, assignments: Sequence[str]) -> Config:
        """
        Return this configuration with other initial states of the simulated robot.

        Args:
            assignments: Each ``name=value``, in the state's unit.

        Raises:
            ConfigError: An assignment is none, or the model has no such state.
        """
        try:
            given = {name: float(value) for name, _, value in (assignment.partition("=") for assignment in assignments)}
        except ValueError as error:
            raise ConfigError(f"--x0 must be NAME=VALUE, got {' '.join(assignments)}") from error
        if wrong := unknown_name("sim.x0", given, "state", self.build_model().states, complete=False):
            raise ConfigError(wrong)
        return self.model_copy(update={"sim": self.sim.model_copy(update={"x0": {**self.sim.x0, **given}})})

    def solver_settings(self) -> SolverSettings | None:
        """Return the settings of OSQP, None if none are given."""
        from rti_mpc.solver import SolverSettings

        given = self.solver.model_dump(exclude_none=True, exclude=ITERATIONS | {"name"})
        return SolverSettings(**given) if given else None

    def iterations(self) -> dict[str, Any]:
        """Return the limits of the iterations a sample, as `Rti` names them, that are given."""
        return self.solver.model_dump(exclude_none=True, include=ITERATIONS)

    def keys(self) -> Keys:
        """Return the keys of this robot."""
        from rti_mpc.wire.keys import Keys

        return Keys(self.prefix, self.robot)

    def bus_settings(self) -> BusSettings:
        """Return how a process other than the robot joins the bus: it connects, and listens on a free port."""
        from rti_mpc.wire.bus import BusSettings

        return BusSettings(**self.bus.model_dump(exclude_none=True, exclude={"listen"}))


def spread(values: tuple[float, ...], length: int) -> tuple[float, ...]:
    """Return a sequence, or the constant that a single value stands for."""
    return values if len(values) == length else values * length


def bounds(table: Mapping[str, tuple[float, float]], names: Iterable[str]) -> tuple[list[float], list[float]]:
    """Return lower and upper bounds in the order of the names."""
    pairs = [table.get(name, (-math.inf, math.inf)) for name in names]
    return [lower for lower, _ in pairs], [upper for _, upper in pairs]


def names(signals: Iterable[Signal]) -> list[str]:
    """Return the names of signals."""
    return [signal.name for signal in signals]


def load(path: Path, *, with_model: bool = True) -> Config:
    """
    Read, check and freeze a robot's configuration.

    Args:
        path: TOML file.
        with_model: Whether to check it against the model, too, which loads CasADi.

    Raises:
        ConfigError: One line: the file, the key, what must hold, what was got.
    """
    content = read_text_file(path, "TOML")
    try:
        config = Config.model_validate(toml.read(content))
        if config.bus.config is not None:
            config = config.model_copy(update={"bus": config.bus.model_copy(update={"config": path.parent / config.bus.config})})
        check_tree(config)
        if with_model:
            from service.fit import check_model

            check_model(config)
    except ValidationError as error:
        raise ConfigError(f"{path}: {explain(error, Config)}") from error
    except (ConfigError, OcpError) as error:
        raise ConfigError(f"{path}: {error}") from error
    return config


def check_tree(config: Config) -> None:
    """
    Check what only the whole or the file system knows.

    Raises:
        ConfigError: A key does not fit the others.
    """
    ocp, terminal = config.ocp, config.ocp.terminal
    if terminal.Q is not None and terminal.lqr is not None:
        raise ConfigError("ocp.terminal must have Q or lqr, not both")
    if config.N_u > ocp.N:
        raise ConfigError(f"ocp.N_u must be at most ocp.N = {ocp.N}, got {ocp.N_u}")
    for key, values, length in (("delta", ocp.weights.delta, ocp.N), ("lambda", ocp.weights.lambda_, config.N_u)):
        if len(values) not in (1, length):
            raise ConfigError(f"ocp.weights.{key} must be a number or a list of {length}, one a stage, got {quoted(list(values))}")
    if config.bus.config is not None and not config.bus.config.is_file():
        raise ConfigError(f"bus.config must be a file, got {config.bus.config}")
    if config.guard.enabled:
        for name in ocp.weights.R:
            if name not in ocp.bounds.inputs:
                raise ConfigError(f"ocp.bounds.inputs must bound every input where a guard is enabled, {name} is missing")
        for name, (lower, upper) in ocp.bounds.inputs.items():
            if not lower <= (rest := config.guard.u_rest.get(name, 0.0)) <= upper:
                raise ConfigError(f"ocp.bounds.inputs.{name} must hold the input's rest, guard.u_rest = {rest:g}, got {[lower, upper]}")
