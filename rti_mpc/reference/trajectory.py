# SPDX-License-Identifier: Apache-2.0
r"""
Reference trajectories: the paper's, polylines and CSV files of waypoints, and their rows.

The paper prints :math:`x_d = \sin(t/k), y_d = \cos(t/k)` as its eight-shaped
curve: that is a circle. Both are here, each under its own name.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.contract.message import End
from rti_mpc.errors import ConfigError
from rti_mpc.reference.heading import Curve, consistent, periodic, tangent
from rti_mpc.reference.polyline import distinct, polyline
from rti_mpc.reference.smoothing import Smoothed, smoothed
from rti_mpc.reference.waypoint_file import read_csv
from rti_mpc.signals import POSE_ROLES, Role, Signal

Heading = Literal["tangent", "consistent", "none"]
HEADINGS: tuple[Heading, ...] = get_args(Heading)


@dataclass(frozen=True)
class Trajectory:
    """
    A path of the reference point as analytic functions of time.

    Attributes:
        name: Name of the scenario, as on the command line.
        position: Points at times ``(...)``, shape ``(..., 2)``, in m.
        velocity: Velocities there, shape ``(..., 2)``, in m/s.
        duration_s: Time for which it is followed; closed paths may be repeated.
        end: What to do after its last row.
        pose0: Where the scenario's robot starts, at rest: x, y in m, psi in rad.
        lap_s: Time of one lap of a closed path; None if the path is open and rests at its end.
        note: What its reader should know of how it was made; empty if nothing.
    """

    name: str
    position: Curve
    velocity: Curve
    duration_s: float
    end: End
    pose0: tuple[float, float, float]
    lap_s: float | None = None
    note: str = ""

    def lasting(self, duration_s: float) -> Trajectory:
        """
        Return this trajectory with another duration.

        Raises:
            ConfigError: The duration is not positive.
        """
        return replace(self, duration_s=_positive("duration_s", duration_s))


def circle(k: float = 10.0) -> Trajectory:
    """Build the curve that the paper prints, ``sin(t/k), cos(t/k)``, with the initial condition of its first simulation; two laps."""
    _positive("k", k)
    return Trajectory(
        name="circle",
        position=lambda t: np.stack([np.sin(t / k), np.cos(t / k)], axis=-1),
        velocity=lambda t: np.stack([np.cos(t / k), -np.sin(t / k)], axis=-1) / k,
        duration_s=4 * math.pi * k,
        end=End.STOP,
        pose0=(0.5, 0.0, 0.0),
        lap_s=2 * math.pi * k,
    )


def eight() -> Trajectory:
    """Build the eight that the paper draws, ``sin(t/10), sin(t/5)``, with the initial condition of its first simulation; two laps."""
    return Trajectory(
        name="eight",
        position=lambda t: np.stack([np.sin(t / 10), np.sin(t / 5)], axis=-1),
        velocity=lambda t: np.stack([np.cos(t / 10) / 10, np.cos(t / 5) / 5], axis=-1),
        duration_s=40 * math.pi,
        end=End.STOP,
        pose0=(0.5, 0.0, 0.0),
        lap_s=20 * math.pi,
    )


def positioning(r: float = 0.4, omega_r: float = 0.1) -> Trajectory:
    """Build the paper's second reference: a path of size `r` in m, followed with `omega_r` in rad/s for 5 pi seconds, then rest where it ends."""
    _positive("r", r)
    _positive("omega_r", omega_r)
    stop = 5 * math.pi

    def position(t: Array) -> Array:
        t = np.minimum(t, stop)
        return np.stack([2 * r * np.cos(omega_r * t + np.pi / 4), r * np.sin(2 * omega_r * t + np.pi / 4)], axis=-1)

    def velocity(t: Array) -> Array:
        speed = np.where(np.asarray(t) < stop, 2 * r * omega_r, 0.0)
        return np.stack([-speed * np.sin(omega_r * t + np.pi / 4), speed * np.cos(2 * omega_r * t + np.pi / 4)], axis=-1)

    return Trajectory("positioning", position, velocity, duration_s=60.0, end=End.HOLD, pose0=(1.4, 0.9, 7 * math.pi / 6))


def waypoints(
    points: Array, speed_m_s: float = 0.25, corner_m: float = 0.15, name: str = "waypoints", *, smooth_m: float | None = None
) -> Trajectory:
    """
    Follow a polyline at constant speed, with corners rounded so that they can be driven, and averaged first if it is a recorded one.

    An open polyline rests at its last point. A closed one (first point equal to the
    last) is repeated, two laps unless another duration is asked for. The robot starts
    on the path, in its direction.

    Args:
        points: Waypoints, shape ``(n, 2)``, in m.
        speed_m_s: Speed of the reference along the path.
        corner_m: Largest distance at which the path passes a waypoint; with 0 it has corners that no robot can follow.
        name: Name of the scenario.
        smooth_m: Arc length to average over, see `rti_mpc.reference.smoothing`; 0: none, None: what the noise of a recorded path needs. The
            trajectory's note says it.

    Raises:
        ConfigError: There are fewer than two distinct finite points, or a number is out of range.
        OcpError: What must be numbers is none.
    """
    speed = _positive("speed_m_s", speed_m_s)
    followed = smoothed(distinct(points), smooth_m)
    path = polyline(followed.points, corner_m)

    def velocity(t: Array) -> Array:
        moving = path.closed | ((0.0 <= np.asarray(t)) & (speed * t < path.length))
        return np.where(moving, speed, 0.0)[..., None] * path.direction(speed * t)

    x, y = path.xy0[0]
    lap_s = path.length / speed
    return Trajectory(
        name=name,
        position=lambda t: path.position(speed * t),
        velocity=velocity,
        duration_s=2 * lap_s if path.closed else lap_s,
        end=End.STOP if path.closed else End.HOLD,
        pose0=(float(x), float(y), float(path.theta0[0])),
        lap_s=lap_s if path.closed else None,
        note=note(followed),
    )


def note(followed: Smoothed) -> str:
    """Say what was done to waypoints."""
    if not followed.window_m:
        return ""
    turning = f"waypoints turn to and fro by up to {math.degrees(followed.turn_rad):.0f} degrees from one to the next"
    return f"{turning}: averaged over {followed.window_m:g} m of path, which moves it by at most {1e3 * followed.moved_m:.0f} mm"


SCENARIOS = {"eight": eight, "circle": circle, "positioning": positioning}


def find_trajectory(scenario: str | Path, speed_m_s: float = 0.25, corner_m: float = 0.15, *, smooth_m: float | None = None) -> Trajectory:
    """
    Find a trajectory by name, or read it from a CSV file of waypoints.

    Args:
        scenario: One of `SCENARIOS`, or a path that ends in ``.csv``.
        speed_m_s: Speed along waypoints; the paper's curves have their own.
        corner_m: Largest distance at which the path passes a waypoint.
        smooth_m: Arc length to average waypoints over, as in `waypoints`.

    Raises:
        ConfigError: There is no such scenario, or the file is wrong: file, line and column are named.
    """
    named = scenario if isinstance(scenario, str | Path) else ""
    if named in SCENARIOS:
        return SCENARIOS[str(named)]()
    path = Path(named)
    if path.suffix.lower() != ".csv":
        meant = given.nearest(scenario, SCENARIOS)
        raise ConfigError(f"a scenario must be one of {', '.join(SCENARIOS)} or a FILE.csv of waypoints, got {scenario!r}{meant}")
    points = read_csv(path)
    try:
        return waypoints(points, speed_m_s, corner_m, name=path.stem, smooth_m=smooth_m)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def rows(
    trajectory: Trajectory,
    period_s: float,
    heading: Heading = "consistent",
    a: float | None = 0.2,
    psi0: float | None = None,
    roles: Sequence[Role] = POSE_ROLES,
) -> Array:
    """
    Sample a trajectory into reference rows.

    Args:
        trajectory: Trajectory to sample.
        period_s: Time between rows.
        heading: ``"tangent"``, or ``"consistent"`` for a point ahead of the axle; ``"none"`` is for controllers without weight on the heading,
            its rows carry the tangent for viewers.
        a: Distance of the reference point ahead of the axle, in m; None: it is on the axle, where the consistent heading is the tangent.
        psi0: Initial consistent heading of an open path, in rad: its tangent by default. Closed paths have the heading that repeats.
        roles: Roles of the columns, in their order: those of `rti_mpc.signals.POSE_ROLES`.

    Returns:
        Rows, shape ``(M, len(roles))``, from time 0 to the first at or after the duration, so that an open path ends at its last point; the
        heading is unwrapped.

    Raises:
        ConfigError: The period, the heading or `a` is out of range.
        OcpError: An argument is none, or a role unknown.
        OcpError: No consistent heading repeats on this closed path.
    """
    given.instance("trajectory", trajectory, Trajectory)
    for role in roles:
        given.one_of("a role", role, POSE_ROLES)
    if heading not in HEADINGS:
        raise ConfigError(f"heading must be one of {', '.join(HEADINGS)}, got {heading!r}")
    periods = math.ceil(trajectory.duration_s / _positive("period_s", period_s) - 1e-9)  # the last period counts as a whole one
    t: Array = np.arange(periods + 1) * np.float64(period_s)
    columns = dict(zip(("x", "y"), trajectory.position(t).T, strict=True))
    if "heading" in roles:
        columns["heading"] = headings(trajectory, t, heading, a, psi0)
    return np.ascontiguousarray(np.column_stack([columns[role] for role in roles]))


def headings(trajectory: Trajectory, t: Array, heading: Heading, a: float | None, psi0: float | None) -> Array:
    """Return the heading at times, both of shape ``(M,)``, as `rows` describes it."""
    psi = tangent(trajectory.velocity, t)
    if heading != "consistent" or a is None:
        return psi
    _positive("a", a)
    start = float(psi[0]) if psi0 is None else given.number("psi0", psi0)
    if trajectory.lap_s is not None:
        start = periodic(trajectory.velocity, trajectory.lap_s, a, start)
    return consistent(trajectory.velocity, t, a, start)


def followed_roles(model: str, outputs: Sequence[Signal]) -> tuple[Role, ...]:
    """
    Return the roles of a model's outputs, which the columns of its reference take.

    Args:
        model: Name of the model.
        outputs: Outputs of the model.

    Raises:
        ConfigError: A path gives no values for an output.
    """
    if unfilled := [output.name for output in outputs if output.role not in POSE_ROLES]:
        raise ConfigError(
            f"model {model}: a path in the plane fills outputs whose role is {', '.join(POSE_ROLES)}, not {', '.join(unfilled)}: "
            f"give each its role, or follow sines, steps or a FILE.csv with the columns t, {', '.join(output.name for output in outputs)}"
        )
    return tuple(output.role for output in outputs)


def _positive(name: str, value: float) -> float:
    """Return a number that must be finite and above zero."""
    if not (math.isfinite(given.number(name, value)) and value > 0.0):
        raise ConfigError(f"{name} must be finite and above 0, got {value}")
    return float(value)
