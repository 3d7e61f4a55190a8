# SPDX-License-Identifier: Apache-2.0
"""
Scenario of a robot: what its reference is, for any model.

A robot whose outputs are position and heading follows a path in the plane; what a path
says of each is found by roles. Any other robot follows references of its outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.contract.message import End
from rti_mpc.errors import ConfigError
from rti_mpc.reference.manoeuvres import MANOEUVRES, fitting, manoeuvre
from rti_mpc.reference.outputs import OUTPUT_SCENARIOS, REACH, OutputReference, names_outputs, recorded
from rti_mpc.reference.trajectory import SCENARIOS, Heading, Trajectory, find_trajectory, followed_roles, rows
from rti_mpc.si import ones
from rti_mpc.signals import in_plane, place
from rti_mpc.wire.layout import most_rows
from rti_mpc_service.config.build import bounds, build_model, stage_parameters
from rti_mpc_service.config.schema import Config

if TYPE_CHECKING:
    from rti_mpc.model.model import Model
    from rti_mpc.reference.path import Path as SmoothPath

ROW_PERIOD_S = 0.05  # between rows at most; the receiver interpolates, on the eight within 0.02 mm
PERIOD_HORIZONS = 4  # horizons that a sine lasts at least, for robots that take longer than others
MIN_PERIOD_S = 10.0


@dataclass(frozen=True)
class Scenario:
    """
    What a robot is to follow.

    Attributes:
        name: As on the command line, or of a file.
        nx: Number of states of the robot.
        y: Of the robot's first state, shape ``(nx,)``, the rows of its reference, ``(M, ny)``.
        period_s: Time between rows.
        duration_s: How long it is followed.
        end: What to do after its last row.
        path: The path in the plane, if it is one.
        heading: What the reference says of it; None where no output is a heading.
        pieces: Pieces of a path that says nothing of time, for a robot that follows one; empty for all else.
    """

    name: str
    nx: int
    y: Callable[[Array], Array]
    period_s: float
    duration_s: float
    end: End
    path: Trajectory | None = None
    heading: Heading | None = None
    pieces: tuple[SmoothPath, ...] = ()

    @property
    def pose0(self) -> tuple[float, float, float] | None:
        """Where a simulated robot is to start, in m and rad: where its path does, in the plane; None if it follows none."""
        if not self.pieces:
            return None if self.path is None else self.path.pose0
        start = np.array(0.0)
        (x, y), (along_x, along_y) = self.pieces[0].position(start), self.pieces[0].tangent(start)
        return float(x), float(y), float(np.arctan2(along_y, along_x))

    @property
    def title(self) -> str:
        """Name, and what is said of the heading."""
        return self.name if self.heading is None else f"{self.name}, heading {self.heading}"

    @property
    def note(self) -> str:
        """What was done to the waypoints of a path; empty if nothing was."""
        return "" if self.path is None else self.path.note


def find_scenario(
    config: Config,
    name: str | None = None,
    heading: Heading | None = None,
    duration_s: float | None = None,
    speed_m_s: float = 0.25,
    smooth_m: float | None = None,
) -> Scenario:
    """
    Find what a robot follows.

    Args:
        config: The robot's configuration.
        name: A scenario or a CSV file; None: that of the configuration, or else the eight for a robot in the plane, sines for any other.
        heading: Of a path; None: consistent.
        duration_s: How long it is followed; None: the time in the configuration, or else the scenario's own.
        speed_m_s: Along waypoints.
        smooth_m: Path that waypoints are averaged over, see `rti_mpc.reference.trajectory.waypoints`.

    Raises:
        ConfigError: There is no such scenario, it says nothing of an output, it is too long for a message, or a file is wrong.
        OcpError: No consistent heading repeats on a closed path.
    """
    model = build_model(config)
    if name is None or name == config.reference.scenario:
        name, duration_s = config.reference.scenario, duration_s or config.reference.duration_s
    if name is None:
        name = "eight" if in_plane(model.outputs) else "sines"
    timed = (*OUTPUT_SCENARIOS, *MANOEUVRES)
    if name not in (*SCENARIOS, *timed) and Path(name).suffix.lower() != ".csv":
        known = (*SCENARIOS, *OUTPUT_SCENARIOS, *fitting(model.outputs))
        told = f"a scenario must be one of {', '.join(known)} or a FILE.csv of waypoints or of outputs over time"
        raise ConfigError(f"{told}, got {name!r}{given.nearest(name, known)}")
    if name not in SCENARIOS and (name in timed or not in_plane(model.outputs) or names_outputs(Path(name), model.outputs)):
        if heading is not None:
            raise ConfigError(f"--heading is of paths in the plane, it must be left out for {name}, got {heading}")
        return of_outputs(config, model, name, duration_s)
    trajectory = find_trajectory(name, speed_m_s, smooth_m=smooth_m)
    trajectory = trajectory if duration_s is None else trajectory.lasting(duration_s)
    check_duration(config, model, trajectory.duration_s, ROW_PERIOD_S)
    return of_path(model, trajectory, heading or "consistent")


def check_duration(config: Config, model: Model, duration_s: float, period_s: float) -> None:
    """
    Check that a reference fits into a message, before its rows are made.

    Raises:
        ConfigError: It does not.
    """
    np_ = stage_parameters(config, np.zeros(1)).shape[1]
    longest_s = period_s * (most_rows(model.ny, np_) - 1)
    if duration_s > longest_s:
        rows = f"a reference with rows of {model.ny} outputs and {np_} parameters every {period_s:g} s"
        raise ConfigError(f"{rows} must last at most {int(longest_s)} s, to fit into a message, got {duration_s:g} s: give it a shorter --duration")


def of_path(model: Model, trajectory: Trajectory, heading: Heading) -> Scenario:
    """Return a path in the plane as a scenario of a model."""
    roles = followed_roles(model.name, model.outputs)
    turns = "heading" in roles
    y = rows(trajectory, ROW_PERIOD_S, heading, offset_ahead(model) if turns and heading == "consistent" else None, roles=roles)
    return Scenario(
        trajectory.name,
        model.nx,
        lambda x: y,
        ROW_PERIOD_S,
        trajectory.duration_s,
        trajectory.end,
        path=trajectory,
        heading=heading if turns else None,
    )


def offset_ahead(model: Model) -> float | None:
    """
    Return how far a model's position is ahead of its axle, in m; None: on it.

    Raises:
        ConfigError: It is behind it, where no heading follows a path exactly.
    """
    if (i := place(model.parameters, "axle_offset")) is None:
        return None
    if (offset := model.p_nominal[i]) < 0.0:
        raise ConfigError(
            f"model {model.name}: {model.parameters[i].name}, the axle offset, must be at least 0 for a consistent heading, got {offset}: "
            "choose --heading tangent"
        )
    return offset or None


def of_outputs(config: Config, model: Model, name: str, duration_s: float | None) -> Scenario:
    """Return references of outputs as a scenario of a model."""
    reference: OutputReference
    rotations = model.rotations("outputs")
    if name in OUTPUT_SCENARIOS:
        lower, upper = bounds(config.ocp.bounds.states, model.counterparts()["outputs"])
        turning = {i for places in rotations.quaternions for i in places}  # an attitude stays as it is
        weighted = [i for i, output in enumerate(model.outputs) if config.ocp.weights.Q[output.name] > 0.0 and i not in turning]
        period_s = max(MIN_PERIOD_S, PERIOD_HORIZONS * config.ocp.N * config.ocp.dt_s)
        reference = OUTPUT_SCENARIOS[name](np.array(lower), np.array(upper), weighted[: model.nu], period_s, REACH * ones(model.outputs))
    elif name in MANOEUVRES:
        reference = manoeuvre(name, model.outputs)
    else:
        reference = recorded(Path(name), model.outputs, rotations)
    if duration_s is not None:
        reference = reference.lasting(duration_s)
    period_s = ROW_PERIOD_S if name in MANOEUVRES else min(ROW_PERIOD_S, config.ocp.dt_s)
    check_duration(config, model, reference.duration_s, period_s)
    t: Array = np.float64(period_s) * np.arange(int(np.ceil(reference.duration_s / period_s - 1e-9)) + 1)
    h = model.h()

    def y(x: Array) -> Array:
        rows = reference.rows(np.array(h(x, model.p_nominal)).ravel(), t)
        rotations.unwrap(rows)
        return rows

    return Scenario(reference.name, model.nx, y, period_s, reference.duration_s, reference.end)
