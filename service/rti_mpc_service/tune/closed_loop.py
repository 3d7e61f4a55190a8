# SPDX-License-Identifier: Apache-2.0
"""Closed loop of a controller and a simulated robot in lockstep: no clock, no network, the same result at every run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, Reference, State
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.errors import ConfigError, OcpError
from rti_mpc.reference.trajectory import Heading
from rti_mpc.rti.ocp import WEIGHTS_AND_BOUNDS, Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc.si import ones
from rti_mpc_service.config.build import (
    build_model,
    build_observer,
    build_ocp,
    iterations,
    retuned,
    robot_settings,
    solver_settings,
    stage_parameters,
)
from rti_mpc_service.config.schema import Config
from rti_mpc_service.rig.scenario import configured
from rti_mpc_service.rig.summary import TRANSIENT_S
from rti_mpc_service.scenario import Scenario, find_scenario
from rti_mpc_service.tune.recorded import is_recording, recorded
from rti_mpc_service.tune.recorded_robot import RecordedRobot, read
from rti_mpc_service.tune.varied import with_values

DEFAULT_SEED = 1  # of noise and dropout, as of `rti_mpc_sim.settings.RobotSettings`


class Body(Protocol):
    """The simulated robot, advanced by its caller."""

    now_ns: int
    x: Array

    def tick(self) -> State:
        """Advance to the next state."""
        ...

    def accept(self, command: Command) -> str:
        """Receive a command."""
        ...


MakeBody = Callable[[dict[str, Any]], Body]  # from the arguments of `rti_mpc_sim.settings.RobotSettings`


@dataclass(frozen=True)
class Course:
    """
    A scenario by its options, as on the command line; see `rti_mpc_service.scenario.find_scenario`.

    Attributes:
        name: A scenario, a CSV file or a recording; None: the robot's own.
        heading: Of a path.
        duration_s: How long it is followed.
        speed_m_s: Along waypoints.
        smooth_m: Path that waypoints are averaged over.
        seed: Added to the seed of noise and dropout.
        part: Of a recording, begin and end as fractions of what was followed without a break.
    """

    name: str | None = None
    heading: Heading | None = None
    duration_s: float | None = None
    speed_m_s: float = 0.25
    smooth_m: float | None = None
    seed: int = 0
    part: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Driven:
    r"""
    One drive, after its transient.

    Attributes:
        error: :math:`\sqrt{\overline{e^T Q e} / q}` of the true outputs' distance e from the reference, with the Q of the robot's file, and
            q its weight of the first weighted output; in the unit of that output.
        effort: Root of the mean of the squared increments of the commands, each relative to half the range of its input, summed over the inputs.
        outputs: Root mean square error of each output, in its unit.
        fallbacks: Samples without a plan of their own, the transient included.
    """

    error: float
    effort: float
    outputs: tuple[float, ...]
    fallbacks: int

    @property
    def finite(self) -> bool:
        """Whether the robot stayed where its model is finite."""
        return bool(np.isfinite([self.error, self.effort]).all())


def laid_out(config: Config, course: Course, heard: Mapping[str, RecordedRobot] | None = None) -> tuple[Config, Scenario]:
    """
    Return the robot at the start of a course, and the scenario.

    Args:
        config: The robot's configuration.
        course: The course.
        heard: Recordings that have been read, by name.

    Raises:
        ConfigError: There is no such scenario.
    """
    if course.name is None or not is_recording(course.name):
        return config, find_scenario(config, course.name, course.heading, course.duration_s, course.speed_m_s, course.smooth_m)
    if course.heading is not None:
        raise ConfigError(f"--heading is of paths in the plane, it must be left out for {course.name}, got {course.heading}")
    known = (heard or {}).get(course.name) or read(course.name, config.robot, build_model(config), config.ocp.dt_s)
    return recorded(config, known, course.part, course.duration_s)


class ClosedLoop:
    """
    A robot on one scenario, driven with any values of the keys that a study varies.

    Args:
        config: The robot's configuration, whose Q judges the error whatever is tried.
        course: The scenario.
        make_body: Maker of the simulated robot.
        laid: What `laid_out` has made of the course, if it has.

    Raises:
        ConfigError: There is no such scenario, or no output is weighted.
    """

    def __init__(self, config: Config, course: Course, make_body: MakeBody, laid: tuple[Config, Scenario] | None = None) -> None:
        config, self.scenario = laid or laid_out(config, course)
        placed = configured(config, self.scenario)
        seed = DEFAULT_SEED if placed.sim.seed is None else placed.sim.seed
        sim = placed.sim.model_copy(update={"seed": seed + course.seed})
        self.config = placed.model_copy(update={"sim": sim})
        self._make_body = make_body
        self._problems: dict[int, Ocp] = {}  # by horizon: each is built and compiled once
        ocp = self._problem(self.config)
        self.model = ocp.model
        self._settings = robot_settings(self.config)
        self._Q = np.diag(ocp.Q)
        if not self._Q.any():
            raise ConfigError(f"ocp.weights.Q must weight an output that {self.scenario.title} leads, got none above 0")
        half = 0.5 * (ocp.widest("ubu") - ocp.widest("lbu"))
        self._range = np.where(np.isfinite(half) & (half > 0.0), half, ones(ocp.model.inputs))

    def _problem(self, config: Config) -> Ocp:
        if (ocp := self._problems.get(config.ocp.N)) is None:
            ocp = self._problems[config.ocp.N] = build_ocp(config)
        return ocp

    def drive(self, values: Mapping[str, float]) -> Driven:
        """Drive the scenario with other values of some keys."""
        config = with_values(self.config, values)
        ocp = self._problem(config)
        rti = Rti(
            ocp,
            solver_settings(config),
            formulation=config.ocp.formulation,
            solver=config.solver.name,
            **iterations(config),
        )
        wanted = retuned(config, ocp)
        rti.retune({name: getattr(wanted, name) for name in WEIGHTS_AND_BOUNDS})
        timing = Timing(config.delay_s, config.stale_s, config.timing.valid_s)
        controller = Controller(rti, timing, observer=build_observer(config))
        body = self._make_body(self._settings)
        rows = self.scenario.y(body.x.copy())
        t, x, u = self._follow(controller, body, rows)
        return self._judge(t, x, u, rows, controller.ladder.fallbacks)

    def _follow(self, controller: Controller, body: Body, rows: Array) -> tuple[Array, Array, Array]:
        """Close the loop; return times and true states at every state of the robot, and the input of every command with its time first."""
        scenario = self.scenario
        p = stage_parameters(self.config, np.float64(scenario.period_s) * np.arange(len(rows)))
        controller.receive_reference(Reference(1, 1, 0, round(1e9 * scenario.period_s), scenario.end, rows, p))
        t: list[float] = []
        x: list[Array] = []
        u: list[Array] = []
        while body.now_ns < round(1e9 * scenario.duration_s):
            state = body.tick()
            t.append(1e-9 * body.now_ns)
            x.append(body.x.copy())
            command = controller.receive_state(state, body.now_ns) or controller.tick(body.now_ns)
            if command is not None:
                u.append(np.concatenate([[t[-1]], command.u[0]]))
                body.accept(command)
                controller.commit(command)
                controller.prepare()
        return np.array(t), np.array(x), np.array(u)

    def _judge(self, t: Array, x: Array, u: Array, rows: Array, fallbacks: int) -> Driven:
        """Return error and effort after the transient."""
        transient_s = min(TRANSIENT_S, self.scenario.duration_s / 2)
        after = t >= transient_s
        t, x = t[after], x[after]
        p = np.tile(np.array(self.model.p_nominal)[:, None], len(t))
        y = np.array(self.model.h().map(len(t))(x.T, p)).T.reshape(len(t), self.model.ny)
        rows_s = self.scenario.period_s * np.arange(len(rows))
        wanted: Array = np.column_stack([np.interp(t, rows_s, column) for column in rows.T])
        e = self.model.rotations("outputs").difference(y, wanted)
        squares = (e**2).mean(axis=0)
        unit = self._Q[self._Q > 0.0][0]
        increments = np.diff(u[u[:, 0] >= transient_s, 1:], axis=0) / self._range
        return Driven(
            error=float(np.sqrt(self._Q @ squares / unit)),
            effort=float(np.sqrt((increments**2).sum(axis=1).mean())) if len(increments) else float("nan"),
            outputs=tuple(map(float, np.sqrt(squares))),
            fallbacks=fallbacks,
        )


def attempted(loop: ClosedLoop, values: Mapping[str, float]) -> Driven | None:
    """Drive a scenario; return None where these values lead to no problem, or to no finite end."""
    try:
        outcome = loop.drive(values)
    except OcpError:
        return None
    return outcome if outcome.finite else None
