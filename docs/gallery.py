# SPDX-License-Identifier: Apache-2.0
"""
Remake ``docs/gallery.md`` and the pictures in ``docs/gallery/``: each robot that ships, following its own scenario in lockstep.

    make gallery

Without a clock and without a bus, so that every run is the same; `rti-mpc demo --robot NAME` is the whole system.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from itertools import cycle
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from rti_mpc import Controller, Model, Reference, Timing, find_model
from rti_mpc.array import Array
from rti_mpc.model.find import SHIPPED_MODELS
from rti_mpc.model.robots.truck_trailer import PARAMETERS
from rti_mpc.signals import quantity
from rti_mpc_service.config.build import build_observer, build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.outline import placed
from rti_mpc_service.rig.figure import ERROR_COLOR, INK_COLOR, MEASURED_COLOR, PLOT_STYLE, REFERENCE_COLOR, SHADE_COLOR
from rti_mpc_service.rig.scenario import configured
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import ROBOTS
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings

DOCS = Path(__file__).parent
TRANSIENT_SHARE = 1 / 3  # of a run, after which errors count
COLORS = (ERROR_COLOR, MEASURED_COLOR, "#e08a1e", "#4c9f6b", "#7a5cc9", "#9aa3b2", "#2b2f3a")

Sketch = Callable[[Array], list[Array]]


@dataclass(frozen=True)
class View:
    """
    Drawing of a robot.

    Attributes:
        axes: Names of the two axes.
        at: Of a state, shape ``(nx,)``, the point whose path is drawn, ``(2,)``.
        wanted: Of a row of the reference, ``(ny,)``, the point wanted; None: the reference has none.
        sketch: Of a state, lines in the plane of the drawing, each ``(M, 2)``.
        times: Shares of the run at which the robot is sketched.
    """

    axes: tuple[str, str]
    at: Callable[[Array], Array]
    wanted: Callable[[Array], Array] | None
    sketch: Sketch
    times: tuple[float, ...] = (0.0, 0.4, 1.0)


def box(back: float, front: float, width: float) -> Array:
    """Return a closed rectangle along the x axis."""
    half = 0.5 * width
    return np.array([(back, -half), (front, -half), (front, half), (back, half), (back, -half)])


def body(*polygons: Array) -> Sketch:
    """Return the sketch of a body at the pose that its first three states are."""
    return lambda x: [placed(polygon, *x[:3]) for polygon in polygons]


def truck(x: Array) -> list[Array]:
    """Sketch trailer and truck."""
    _, l_h, l_t = (value for value, _ in PARAMETERS.values())
    hitch = x[:2] + l_t * np.array([np.cos(x[2]), np.sin(x[2])])
    ahead = x[2] + x[3]
    axle = hitch + l_h * np.array([np.cos(ahead), np.sin(ahead)])
    return [
        placed(box(-1.2, 3.2, 2.2), *x[:3]),
        np.array([placed(np.array([[3.2, 0.0]]), *x[:3])[0], hitch]),
        placed(box(-0.9, 4.4, 2.0), *axle, ahead),
    ]


def arm(x: Array) -> list[Array]:
    """Sketch the links."""
    elbow = 0.5 * np.array([np.cos(x[0]), np.sin(x[0])])
    return [np.array([(0.0, 0.0), elbow, elbow + 0.5 * np.array([np.cos(x[0] + x[1]), np.sin(x[0] + x[1])])])]


def tip(x: Array) -> Array:
    """Return the tip of the arm."""
    return np.asarray(arm(x)[0][-1])


def pole_end(x: Array) -> Array:
    """Return the end of the pole; it falls to the left where the cart is pushed to the right."""
    return np.array([x[0] - 0.8 * np.sin(x[1]), 0.8 * np.cos(x[1])])


def chain(x: Array) -> list[Array]:
    """Sketch springs and masses, from the side."""
    masses = np.vstack([np.zeros(3), x[:9].reshape(3, 3)])
    return [masses[:, 1:]]


def cross(x: Array) -> list[Array]:
    """Sketch the arms of a quadrotor from above, five times as long."""
    return [placed(np.array(ends), x[0], x[1], x[5]) for ends in ([(-0.25, 0.0), (0.25, 0.0)], [(0.0, -0.25), (0.0, 0.25)])]


def turned_cross(x: Array) -> list[Array]:
    """Sketch the same arms, turned by the yaw of a quaternion."""
    w, i, j, k = x[3:7]
    return cross(np.array([*x[:2], 0.0, 0.0, 0.0, np.arctan2(2 * (w * k + i * j), w**2 + i**2 - j**2 - k**2)]))


def plane(sketch: Sketch, **more: tuple[float, ...]) -> View:
    """Return the view of a robot in the plane from above."""
    return View(("x", "y"), lambda x: x[:2], lambda y: y[:2], sketch, **more)


ARROW = np.array([(0.12, 0.0), (-0.12, 0.09), (-0.07, 0.0), (-0.12, -0.09), (0.12, 0.0)])
CAR = body(2.0 * box(-0.1, 0.45, 0.3))
VIEWS: dict[str, View] = {
    "pioneer_3dx": plane(body(box(-0.45, 0.0, 0.38))),
    "unicycle": plane(body(ARROW)),
    "differential_drive": plane(body(box(-0.14, 0.14, 0.28), ARROW)),
    "kinematic_bicycle": plane(CAR),
    "dynamic_bicycle": plane(CAR, times=(0.0, 0.3, 0.33, 0.36, 0.39)),
    "truck_trailer": plane(truck, times=(0.0, 0.27, 0.5, 0.62, 1.0)),
    "omnidirectional": plane(body(box(-0.29, 0.29, 0.38), ARROW), times=(0.0, 0.1, 0.2, 0.3, 0.4)),
    "boat": plane(body(np.array([(0.9, 0.0), (0.3, 0.4), (-0.8, 0.4), (-0.8, -0.4), (0.3, -0.4), (0.9, 0.0)])), times=(0.0, 0.3, 0.6, 0.9)),
    "quadrotor": plane(cross),
    "quadrotor_quaternion": plane(turned_cross),
    "two_link_arm": View(("x", "z"), tip, lambda y: y, arm, (0.0, 0.33, 0.36, 0.39)),
    "cart_pole": View(("x", "z"), pole_end, None, lambda x: [np.array([(x[0], 0.0), pole_end(x)]), np.array([(x[0] - 0.2, 0.0), (x[0] + 0.2, 0.0)])]),
    "chain": View(("y", "z"), lambda x: x[7:9], lambda y: y[1:3], chain, (0.0, 0.08, 0.16, 0.25)),
}


@dataclass(frozen=True)
class Drive:
    """A robot that has followed its scenario, a row a state."""

    model: Model
    scenario: str
    t: Array
    x: Array
    y_ref: Array
    error: Array

    @property
    def settled(self) -> Array:
        """Largest error of each output after the transient, shape ``(ny,)``."""
        return np.asarray(np.abs(self.error[self.t >= TRANSIENT_SHARE * self.t[-1]]).max(axis=0))


def drive(name: str) -> Drive:
    """Let a robot follow its scenario."""
    config = load(ROBOTS[name])
    duration_s = find_scenario(config).duration_s
    scenario = find_scenario(config, duration_s=duration_s + config.ocp.N * config.ocp.dt_s + 1.0)
    config = configured(config, scenario)
    settings = robot_settings(config)
    y = scenario.y(np.array(settings["x0"]))
    controller = Controller(build_rti(config), Timing(), observer=build_observer(config))
    controller.receive_reference(Reference(1, 1, 0, round(1e9 * scenario.period_s), scenario.end, y, np.zeros((len(y), 0))))
    robot = Lockstep(RobotSettings(**settings))
    t, x = [], []
    while robot.now_ns < round(1e9 * duration_s):
        command = controller.receive_state(robot.tick(), robot.now_ns)
        t.append(1e-9 * robot.now_ns)
        x.append(robot.x.copy())
        if command is not None:
            robot.accept(command, robot.now_ns)
            controller.commit(command)
            controller.prepare()
    model, times, states = find_model(name), np.array(t), np.array(x)
    y_ref = np.column_stack([np.interp(times, scenario.period_s * np.arange(len(y)), column) for column in y.T])
    outputs = np.array(model.h()(states.T, model.p_nominal)).reshape(model.ny, -1).T
    error = model.rotations("outputs").difference(outputs, y_ref)
    return Drive(model, scenario.name, times, states, y_ref, error)


def draw(run: Drive, view: View, path: Path) -> None:
    """Draw the robot along its path, and its errors over time."""
    with mpl.rc_context(PLOT_STYLE):
        page = Figure(figsize=(8.4, 3.6), layout="constrained")
        plan, errors = page.subplots(1, 2, width_ratios=[1.25, 1.0])
        if view.wanted is not None:
            plan.plot(*np.array([view.wanted(y) for y in run.y_ref]).T, color=REFERENCE_COLOR, linewidth=4.0, alpha=0.55, label="reference")
        plan.plot(*np.array([view.at(x) for x in run.x]).T, color=MEASURED_COLOR, linewidth=1.2, label="robot")
        for share in view.times:
            for line in view.sketch(run.x[round(share * (len(run.x) - 1))]):
                plan.plot(*line.T, color=INK_COLOR, linewidth=1.3, alpha=0.3 + 0.7 * share, marker="." if view.axes != ("x", "y") else None)
        plan.set(aspect="equal", xlabel=f"{view.axes[0]} [m]", ylabel=f"{view.axes[1]} [m]", title=f"{run.model.name}: {run.scenario}")
        plan.set_adjustable("datalim")
        errors.axvspan(0.0, TRANSIENT_SHARE * run.t[-1], color=SHADE_COLOR)
        for signal, error, color in zip(run.model.outputs, run.error.T, cycle(COLORS), strict=False):
            errors.semilogy(run.t, np.maximum(np.abs(error), 1e-6), color=color, linewidth=1.0, label=f"{signal.name} [{signal.unit}]")
        errors.set(title="error", xlabel="robot time [s]", xlim=(0.0, run.t[-1]), ylim=(1e-6, 100.0 * np.abs(run.error).max()))
        errors.legend(loc="upper right", ncols=2)
        page.savefig(path, dpi=75)


def told(run: Drive) -> str:
    """Return the largest errors after the transient in words."""
    settled = zip(run.model.outputs, run.settled, strict=True)
    return ", ".join(f"{signal.name} {quantity(value, signal.unit, '.2g')}" for signal, value in settled)


PAGE = """# Robots that ship

`rti-mpc robots` lists them, `rti-mpc demo --robot NAME` drives one: robot, controller, reference and recorder as
processes, with summary and figure. Each is one file in `rti_mpc/model/robots`, with equation, source and licence of
every parameter, and one TOML file in `deploy/robots`, to begin with for a robot of your own.

Here each follows its own scenario in lockstep, without clock and bus; errors are the largest after the first third.
`make gallery` makes this page again.

Short programs in `examples/` use them, print an error and, given the name of a file, draw a picture:
`python examples/race.py race.png`. `recording.ipynb` is a notebook that reads [what a demo has recorded](recording.md).

`race.py` laps three tracks with a car that follows a [path](paths.md), beside one that keeps to the centre line:

![Race lines on three tracks](race.png)

`obstacles.py` passes two discs that lie on the way:

![The way around two discs](gallery/obstacles.png)

`observer.py` estimates the current that the boat is in; without that it stays 19 cm off:

![An eight sailed in a current, with and without an observer](gallery/observer.png)

`tuning.py` compares three weights, in a table and as they drive:

![An eight driven with three weights](gallery/tuning.png)

`quadrotor.py` flies to a point and back:

![Position and thrusts of a quadrotor over time](gallery/quadrotor_there_and_back.png)

`own_planner.py` follows a walker whose way nobody knows, by a short reference twice a second:

![A robot a second behind a walker](gallery/own_planner.png)

`delay.py` draws a circle with an arm whose motors answer 30 ms late, a period and a half. With the delay ignored the arm
swings, more than 10 cm off; configured or measured, it is within 0.2 mm:

![A circle drawn by an arm with a delay](gallery/delay.png)

`several_robots.py` drives a TurtleBot, a car and a quadrotor on one host and one bus, each with a controller, a reference
and a clock of its own, and watches all of them by `rti-mpc status --once --json`, as a script of one's own can:

![Tracks of three robots in one plane](gallery/several_robots.png)

| robot | states, inputs | period | horizon | at rest without feedback | error |
| --- | --- | --- | --- | --- | --- |
"""


def main(names: list[str]) -> None:
    """Remake the pictures of some robots, or all of them and the page."""
    table, pictures = [], []
    (DOCS / "gallery").mkdir(exist_ok=True)
    for name in names or ROBOTS:
        config, module = load(ROBOTS[name], with_model=False), import_module(SHIPPED_MODELS[name].partition(":")[0])
        run = drive(name)
        print(name, told(run))
        draw(run, VIEWS[name], DOCS / "gallery" / f"{name}.png")
        size, period = f"{run.model.nx}, {run.model.nu}", f"{1e3 * config.ocp.dt_s:g} ms"
        table.append(f"| [{name}](#{name}) | {size} | {period} | {config.ocp.N} stages | {module.REST} | {told(run)} |")
        summary = (module.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ").replace(" [Wirsching2006]_", "")
        pictures.append(f"## {name}\n\n{summary[0].upper()}{summary[1:]}\n\n![{name} follows {run.scenario}](gallery/{name}.png)")
    if not names:
        (DOCS / "gallery.md").write_text(PAGE + "\n".join(table) + "\n\n" + "\n\n".join(pictures) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
