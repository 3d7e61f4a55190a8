# SPDX-License-Identifier: Apache-2.0
"""
A race car laps three tracks: path following against tracking the centre line at constant speed, with the same lateral limit.

    python examples/race.py [race.png]

The car is the dynamic bicycle with tyres, a model car of 1:10; the one that is driven has 5 % less grip than the controller's.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np

from rti_mpc import Model, Ocp, Rti, simulate
from rti_mpc.model.path_following import path_following, window_place, with_drift
from rti_mpc.model.robots.dynamic_bicycle import dynamic_bicycle
from rti_mpc.reference.path import Path
from rti_mpc.reference.path_source import PathSource
from rti_mpc.reference.speed_profile import SpeedLimits
from rti_mpc.reference.tracks import TRACKS, track

LATERAL = 5.0  # limit of the lateral acceleration, m/s^2; the tyres hold 10
HALF_CAR_M = 0.15  # kept between the centre of the car and either edge of the track
CUTTING = 1.3  # by how much corners may be faster than on the centre line: a wider line has a larger radius
LIMITS = SpeedLimits(speed=7.0, lateral=LATERAL * CUTTING**2, acceleration=4.0, braking=5.0)
DT_S, N = 0.02, 40
GRIP = 0.95  # of the car that is driven, relative to the controller's
FREE = np.inf


@dataclass
class Lap:
    """
    How a lap went.

    Attributes:
        time_s: Of the last whole lap, s.
        xy: Positions of all laps, shape ``(M, 2)``, in m.
        speed: Speeds there, shape ``(M,)``, in m/s.
        edge_m: Smallest distance of the car's centre to an edge; negative off the track.
        lateral: Largest lateral acceleration, m/s^2.
        contour_m: Largest distance to the centre line.
        unusable: Samples without a plan.
    """

    time_s: float
    xy: np.ndarray
    speed: np.ndarray
    edge_m: float
    lateral: float
    contour_m: float
    unusable: int


def race_car() -> Model:
    """Return the model of a race car that follows a path, and tells how fast it moves across it."""
    return with_drift(path_following(dynamic_bicycle()))


def worn(model: Model) -> Model:
    """Return the car that is driven."""
    return model.with_parameters(mu=GRIP * dict(zip((p.name for p in model.parameters), model.p_nominal, strict=True))["mu"])


def racing() -> Rti:
    """Return the controller that follows a path: nearly free across the track, inside its edges and the lateral limit."""
    model = race_car()
    kept = [i for i, signal in enumerate(model.constraints) if signal.name in ("left", "right", "lateral_acceleration")]
    ocp = Ocp(
        model,
        N=N,
        dt=DT_S,
        Q=[0.02, 20.0, 4.0, 8.0],  # contour, lag, pace, drift
        R=[0.02, 0.02, 0.02],
        lbu=[-6.0, -6.0, 0.0],
        ubu=[5.0, 6.0, 9.0],
        lbx=[-FREE, -FREE, -FREE, -1.0, -FREE, -FREE, -0.42, -FREE, -FREE],
        ubx=[FREE, FREE, FREE, 8.0, FREE, FREE, 0.42, FREE, FREE],
        h_expr=model.h_expr[kept, 0],
        lh=[HALF_CAR_M, HALF_CAR_M, -LATERAL],
        uh=[FREE, FREE, LATERAL],
        zh=300.0,  # with 100 a car that enters a turn too fast exceeds the lateral limit by 5 % rather than leave its line
    )
    return Rti(ocp)


def tracking() -> Rti:
    """Return the controller that tracks the centre line in time."""
    free = [FREE] * 3
    limits = {"lbx": [-FREE, -FREE, -FREE, -1.0, -FREE, -FREE, -0.42], "ubx": [*free, 8.0, FREE, FREE, 0.42]}
    return Rti(Ocp(dynamic_bicycle(), N=N, dt=DT_S, Q=[10, 10, 1], R=[0.02, 0.02], lbu=[-6, -6], ubu=[5, 6], **limits))


def standing(path: Path, speed: float = 0.0) -> list[float]:
    """Return the state of the bicycle at the start of a path, in its direction."""
    (x, y), (along_x, along_y) = path.position(np.array(0.0)), path.tangent(np.array(0.0))
    return [x, y, np.arctan2(along_y, along_x), speed, 0.0, 0.0, 0.0]


def follow(rti: Rti, path: Path, laps: int = 2) -> Lap:
    """Let the car follow a path from standstill."""
    source = PathSource([path], rti.ocp.model.p_nominal, *window_place(rti.ocp.model) or (0, 0))
    samples = round((1.2 * laps * path.time_s + 1.0) / DT_S)
    run = simulate(
        rti,
        worn(rti.ocp.model),
        lambda t: np.zeros((len(t), rti.ocp.model.ny)),  # contour, lag, error of the pace and drift are to be zero
        x0=[*standing(path), 0.0, 0.0],
        samples=samples,
        parameters=lambda x: source.parameters(x[-2], x[-1]),
    )
    return judged(path, run.x, sum(not status.usable for status in run.status), laps)


def track_centre_line(rti: Rti, path: Path, speed: float) -> Lap:
    """Let the car track the centre line for a lap at constant speed, beginning with that speed."""

    def rows(t: np.ndarray) -> np.ndarray:
        along = path.tangent(speed * t)
        return np.column_stack([path.position(speed * t), np.arctan2(along[:, 1], along[:, 0])])

    samples = round((path.length / speed + 1.0) / DT_S)
    run = simulate(rti, worn(dynamic_bicycle()), rows, x0=standing(path, speed), samples=samples)
    return judged(path, run.x, sum(not status.usable for status in run.status), 1)


def fastest_constant(rti: Rti, path: Path) -> tuple[float, Lap]:
    """Return the largest constant speed, in steps of 3 %, whose lap keeps the lateral limit and the track, and that lap."""
    s = np.linspace(0.0, path.length, 1000)
    speed = 0.95 * float(np.sqrt(LATERAL / np.abs(path.curvature(s)).max()))
    best = speed, track_centre_line(rti, path, speed)
    while (lap := track_centre_line(rti, path, speed)).lateral <= 1.01 * LATERAL and lap.edge_m >= HALF_CAR_M:
        best = speed, lap
        speed *= 1.03
    return best


def judged(path: Path, x: np.ndarray, unusable: int, laps: int) -> Lap:
    """Judge the true states of a car, shape ``(M, nx)``, against the track."""
    s, contour, edge = np.zeros(len(x)), np.zeros(len(x)), np.zeros(len(x))
    near = 0.0
    for k, point in enumerate(x[:, :2]):
        near, left = path.offset(point, near)
        s[k], contour[k] = near, left
        edge[k] = min(path.at(path.left, np.array(near)) - left, path.at(path.right, np.array(near)) + left)
    crossed_s = np.interp(path.length * np.arange(laps + 1), s, DT_S * np.arange(len(s)))
    done = s <= laps * path.length
    time_s = float(crossed_s[-1] - crossed_s[-2]) if s[-1] > laps * path.length else FREE
    lateral = np.abs(x[done, 3] * x[done, 5])
    return Lap(time_s, x[done, :2], x[done, 3], float(edge[done].min()), float(lateral.max()), float(np.abs(contour[done]).max()), unusable)


def draw(laps: dict[str, tuple[Path, Lap]], file: str) -> None:
    """Draw the race line on each track, its colour the speed."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(15, 5.2), layout="constrained")
    for axes, (name, (path, lap)) in zip(page.subplots(1, len(laps)), laps.items(), strict=True):
        s = np.linspace(0.0, path.length, 1000)
        centre, along = path.position(s), path.tangent(s)
        normal = np.column_stack([-along[:, 1], along[:, 0]])
        axes.plot(*centre.T, color="#9aa3b2", linewidth=0.8, linestyle="--")
        for width in (path.at(path.left, s), -path.at(path.right, s)):
            axes.plot(*(centre + width[:, None] * normal).T, color="#20242c", linewidth=1.5)
        last = len(lap.xy) // 2
        driven = axes.scatter(*lap.xy[last:].T, c=lap.speed[last:], s=6, cmap="viridis", vmin=2.0, vmax=7.5)
        axes.set_aspect("equal")
        axes.set(title=f"{name}: {lap.time_s:.2f} s", xlabel="x [m]", ylabel="y [m]")
    page.colorbar(driven, ax=page.axes, label="speed [m/s]", shrink=0.7)
    page.savefig(file, dpi=90)


def main() -> None:
    """Race on all tracks, and print what came of it."""
    following, centre = racing(), tracking()
    laps = {}
    print(f"{'track':8} {'path following':>14} {'centre line':>12} {'at':>9} {'closest to edge':>16} {'lateral':>10} {'off centre':>11}")
    for name in TRACKS:
        path = track(name).limited(LIMITS)
        lap = follow(following, path)
        speed, constant = fastest_constant(centre, path)
        laps[name] = path, lap
        times = f"{lap.time_s:12.2f} s {constant.time_s:10.2f} s {speed:5.2f} m/s"
        print(f"{name:8} {times} {lap.edge_m:14.3f} m {lap.lateral:5.2f} m/s2 {lap.contour_m:9.2f} m")
    if len(sys.argv) > 1:
        draw(laps, sys.argv[1])


if __name__ == "__main__":
    main()
