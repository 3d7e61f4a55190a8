# SPDX-License-Identifier: Apache-2.0
"""
Drive three robots on one host, each with a controller, a reference and a clock of its own, on one bus, and watch all by `rti-mpc status`.

    python examples/several_robots.py [several_robots.png]

A script of one's own reads the same JSON: modes, errors, ages and times of all robots that are there.
"""

import csv
import json
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event

import numpy as np

from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc_service.config.config import load
from rti_mpc_service.rig.children import Children
from rti_mpc_service.rig.company import CLI_MODULE, START_TIMEOUT_S, wait
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.shipped import robot_file

SPEEDS = {"differential_drive": 3.0, "kinematic_bicycle": 0.75, "quadrotor": 0.375}  # of each robot's clock: a lap takes 21 s of ours
CONFIGS = {name: load(robot_file(name)) for name in SPEEDS}
SETTLED_S, WATCHED_S, REFERENCE_S = 8.0, 22.0, 1800.0


def status(endpoint: str) -> dict[str, dict]:
    """Return what each robot is doing, by its name."""
    command = ["nice", sys.executable, "-m", CLI_MODULE, "status", "-e", endpoint, "--once", "--json"]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=False).stdout)["robots"]


def drive(folder: Path) -> list[dict[str, dict]]:
    """Start all processes, watch the robots for a lap, end what was started, and return what was seen."""
    endpoint, names = free_endpoint(), {config.robot for config in CONFIGS.values()}
    meeting = Bus.join(BusSettings(listen=(endpoint,), connect=()), CONFIGS["quadrotor"].keys())  # all others connect to it

    def all_have(what: str, *least: str) -> bool:
        robots = status(endpoint)
        return robots.keys() == names and all(set(robot[what]) >= set(least) for robot in robots.values())

    with meeting, Children(folder) as children:
        for name in CONFIGS:
            children.start(f"{name}-controller", CLI_MODULE, "run", robot_file(name), "-e", endpoint)
            children.start(f"{name}-reference", CLI_MODULE, "reference", robot_file(name), "-e", endpoint, "--duration", REFERENCE_S)
        wait(lambda: all_have("present", "controller", "reference"), children, Event(), START_TIMEOUT_S, "controllers and references")
        for name, speed in SPEEDS.items():
            log = folder / f"{name}.csv"
            children.start(name, CLI_MODULE, "sim", robot_file(name), "-l", "tcp/127.0.0.1:0", "-e", endpoint, "--speed", speed, "--log", log)
        wait(lambda: all_have("error", "position"), children, Event(), START_TIMEOUT_S, "robots that are driven")
        time.sleep(SETTLED_S)
        end_s, seen = time.monotonic() + WATCHED_S, []
        while time.monotonic() < end_s:
            seen.append(status(endpoint))
    return seen


def draw(folder: Path, file: str) -> None:
    """Draw the tracks in one plane."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(8.4, 3.6), layout="constrained")
    axes = page.subplots()
    for name, config in CONFIGS.items():
        with (folder / f"{name}.csv").open(newline="") as log:
            track = np.array([(float(row["x"]), float(row["y"])) for row in csv.DictReader(log)])
        (line,) = axes.plot(*track.T, linewidth=1.2, label=f"{config.robot}, each {1e3 * config.ocp.dt_s:.0f} ms")
        axes.plot(*track[-1], color=line.get_color(), marker="o")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="Three robots, three controllers, one bus", aspect="equal", xlim=(-4.4, 8.0))
    axes.legend(loc="center right")
    page.savefig(file, dpi=90)


with TemporaryDirectory() as temporary:
    seen = drive(Path(temporary))
    if len(sys.argv) > 1:
        draw(Path(temporary), sys.argv[1])
medians = []
for name in sorted(seen[-1]):
    errors = [robots[name]["error"]["position"]["value"] for robots in seen if robots.get(name, {}).get("error")]
    medians.append(np.median(errors))
    print(f"{name}: {medians[-1]:.2f} mm off in the median of {len(errors)} looks, {max(errors, default=np.nan):.2f} mm at most")
print(f"{max(medians):.2f} mm off is the worst of them in the median")
