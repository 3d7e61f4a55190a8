# SPDX-License-Identifier: Apache-2.0
"""
Demo: the whole system on this machine, with robot, controller, reference and recorder as processes, and a summary.

The demo is one more peer. It listens on a free loopback port to which all others
connect, so that several demos can run side by side. It starts the robot when all
other processes are present, listens, and stops them when the robot has been driven
for long enough. Robot and controller have priority over all others.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from rich.console import Console

from rti_mpc.contract.message import Command, Reference, State, Telemetry
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.errors import ConfigError
from rti_mpc.reference.trajectory import Heading, Trajectory, find_trajectory
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.cdr import encode
from rti_mpc.wire.info import Info
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc_service.config import toml
from rti_mpc_service.config.build import build_ocp
from rti_mpc_service.config.fit import check_stop
from rti_mpc_service.config.schema import Config
from rti_mpc_service.console import widened
from rti_mpc_service.demo.board import Board, print_summary
from rti_mpc_service.host import machine
from rti_mpc_service.host.echo import ROLE as ECHO
from rti_mpc_service.host.echo import Echo
from rti_mpc_service.rig import robot_log
from rti_mpc_service.rig.children import Children
from rti_mpc_service.rig.company import CLI_MODULE, WATCHER_NICENESS, Failed, check_children, wait
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.rig.scenario import BEST_HEADINGS, configured
from rti_mpc_service.rig.summary import Outcome, summarize
from rti_mpc_service.rig.witness import Witness

START_TIMEOUT_S = 60.0  # for all processes to be present; the first controller on a machine compiles
CONTROLLER_SILENCE_S = 5.0  # after which the run ends: the robot will not be driven any further
END_TIMEOUT_S = 3.0
POLL_PERIOD_S = 0.1
DRAW_PERIOD_S = 0.25
REFERENCE_MARGIN_S = 5.0  # reference beyond the last sample's horizon: near the last row a controller slows down
RECORDER_END_TIMEOUT_S = 8.0  # for the recorder to write what it has received
# The recorder ends first, so that the recording ends while the robot is still driven.
END_ORDER = (*(("recorder",) if find_spec("rerun") else ()), "controller", "guard", "robot", "reference", "echo")


@dataclass(frozen=True)
class DemoPlan:
    """
    Settings of a demo.

    Attributes:
        config: Configuration that all processes load.
        scenario: Scenario, as on the command line.
        heading: Heading of the reference.
        trajectory: Trajectory to follow.
        duration_s: Duration of the run in robot time.
        speed: Seconds of robot time per second.
        folder: Folder of all results.
        viewer: Whether to show the run in a Rerun viewer.
    """

    config: Config
    scenario: str
    heading: Heading
    trajectory: Trajectory
    duration_s: float
    speed: float
    folder: Path
    viewer: bool

    @property
    def reference_s(self) -> float:
        """How long the reference lasts."""
        return self.duration_s + self.config.ocp.N * self.config.ocp.dt_s + REFERENCE_MARGIN_S


def plan(
    config: Config, scenario: str, *, heading: Heading | None, speed: float, duration_s: float | None, folder: Path | None, viewer: bool, guard: bool
) -> DemoPlan:
    """
    Return the settings of a demo; what is None is decided by the scenario.

    Raises:
        ConfigError: There is no such scenario, or the model has outputs that no path fills.
    """
    trajectory = find_trajectory(scenario)
    heading = heading or BEST_HEADINGS.get(scenario, "consistent")
    return DemoPlan(
        config=configured(config, trajectory, heading, guard),
        scenario=scenario,
        heading=heading,
        trajectory=trajectory,
        duration_s=duration_s or trajectory.duration_s,
        speed=speed,
        folder=folder or Path("runs") / f"{trajectory.name}-{datetime.now():%Y%m%d-%H%M%S}",
        viewer=viewer,
    )


def main(config: Config, scenario: str, **options: Any) -> int:
    """
    Run a demo, write its folder, and print its summary.

    Returns:
        Exit status: 0 if the robot was driven to the end.

    Raises:
        ConfigError: A stop would not bring the robot to rest, the scenario is none, or does not fit the robot, or the folder cannot be written.
    """
    check_stop(config)
    console = Console()
    run = plan(config, scenario, **options)
    try:
        run.folder.mkdir(parents=True, exist_ok=True)
        (run.folder / "config.toml").write_text(toml.write(run.config), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--out must be a folder that can be written, got {run.folder}: {error.strerror}") from error
    if run.trajectory.note:
        console.print(run.trajectory.note, soft_wrap=True, markup=False)
    stop = stop_on_signals()
    try:
        outcome = drive(run, console, stop)
    except Failed as error:
        console.print(f"rti-mpc: {error}", soft_wrap=True, markup=False)
        return 1
    return conclude(run, outcome, widened(console))


def drive(run: DemoPlan, console: Console, stop: Event) -> Outcome:
    """
    Start all processes, listen until the end, and stop them.

    Raises:
        Failed: A process has ended by itself, or not all came up.
    """
    ocp = build_ocp(run.config)
    endpoint = free_endpoint()
    title = f"{run.trajectory.name}, heading {run.heading}, {run.speed:g} times real speed"
    logs = run.folder / "logs"
    logs.mkdir(exist_ok=True)
    keys = run.config.keys()
    with (
        Bus.join(BusSettings(listen=(endpoint,), connect=()), keys) as bus,
        Children(logs) as children,
        Board(console, title, ocp.model.inputs, run.duration_s) as board,
    ):
        witness = Witness(bus)
        command = Command(0, 0, 0, 0, 0, 0, 0, 0, Mode.TRACKING, QpStatus.SOLVED, 0, np.zeros((ocp.N, ocp.model.nu)))
        start(run, children, endpoint, len(encode(command)))
        company = {"controller", "reference", ECHO, *(["viewer"] if recorded() else []), *guards(run)}
        board.wait(f"starting {', '.join(sorted(company))}")
        wait(lambda: witness.listen().met(company), children, stop, START_TIMEOUT_S, "all processes")
        echo = Echo(bus, State(0, 0, 0, np.zeros(ocp.model.nx)), 0.5 * ocp.dt / run.speed)
        meeting = ("-l", "tcp/127.0.0.1:0", "-e", endpoint)
        children.start("robot", CLI_MODULE, "sim", run.folder / "config.toml", *meeting, "--speed", run.speed, "--log", run.folder / "robot.csv")
        board.wait("starting the robot")
        follow(run, witness, board, children, stop)
        board.wait("stopping all processes")
        for name in (name for name in END_ORDER if name != "guard" or guards(run)):
            if children.end(name, RECORDER_END_TIMEOUT_S if name == "recorder" else END_TIMEOUT_S):
                board.console.print(f"{name} did not end well, see {children.log(name)}", soft_wrap=True, markup=False)
        witness.listen()
    if witness.info is None or witness.reference is None:
        raise Failed("stopped before the robot had a reference")
    return Outcome(
        trajectory=run.trajectory,
        anchor_ns=witness.reference.stamp_ns,
        duration_s=run.duration_s,
        speed=run.speed,
        ocp=ocp,
        info=witness.info,
        log=robot_log.read(run.folder / "robot.csv", witness.info),
        telemetry=witness.telemetry,
        unheard=witness.lost,
        events=witness.events,
        echo_us=echo.round_trip_us,
    )


def start(run: DemoPlan, children: Children, endpoint: str, size: int) -> None:
    """Start all processes except the robot."""
    keys, config = run.config.keys(), run.folder / "config.toml"
    scenario = ("--scenario", run.scenario, "--heading", run.heading, "--duration", run.reference_s)
    children.start("controller", CLI_MODULE, "run", config, "-e", endpoint)
    for name in guards(run):
        children.start(name, CLI_MODULE, "guard", config, "-e", endpoint)
    children.start("reference", CLI_MODULE, "reference", config, "-e", endpoint, *scenario, nice=WATCHER_NICENESS)
    children.start("echo", "rti_mpc_service.host.echo", endpoint, keys.prefix, keys.robot, size)
    if recorded():
        live = ("--rerun-spawn",) if run.viewer else ()
        children.start("recorder", CLI_MODULE, "view", config, "-e", endpoint, "--rerun-save", run.folder / "run.rrd", *live, nice=WATCHER_NICENESS)


def follow(run: DemoPlan, witness: Witness, board: Board, children: Children, stop: Event) -> None:
    """
    Listen until the robot was driven for long enough, the controller fell silent, or the demo is stopped.

    Raises:
        Failed: A process has ended by itself, or the robot was never driven.
    """
    wait(lambda: witness.listen().begun, children, stop, START_TIMEOUT_S, "the first sample")
    heard, heard_s, shown_s = 0, time.monotonic(), 0.0
    while not stop.is_set() and witness.reference is not None:
        now_s, last = time.monotonic(), witness.telemetry[-1]
        time_s = 1e-9 * (last.state_stamp_ns - witness.reference.stamp_ns)
        if len(witness.telemetry) > heard:
            heard, heard_s = len(witness.telemetry), now_s
        if time_s >= run.duration_s or now_s - heard_s > CONTROLLER_SILENCE_S:
            return
        if now_s - shown_s > DRAW_PERIOD_S:
            shown_s = now_s
            board.show(time_s, error_mm(run, witness.info, last, witness.reference), witness.telemetry, witness.events)
        check_children(children)
        stop.wait(POLL_PERIOD_S)
        witness.listen()


def error_mm(run: DemoPlan, info: Info | None, sample: Telemetry, reference: Reference) -> float | None:
    """Return the distance of the robot from the path in a sample, mm; None if the model has no position."""
    if info is None or info.position is None:
        return None
    at_s = np.array(1e-9 * (sample.stamp_ns - reference.stamp_ns))
    return 1e3 * float(np.hypot(*(sample.x0[list(info.position)] - run.trajectory.position(at_s))))


def conclude(run: DemoPlan, outcome: Outcome, console: Console) -> int:
    """Write and print the summary of a run, draw it, and print how to view it; return the exit status."""
    summary = {**summarize(outcome), "heading": run.heading, "machine": machine.machine_info()}
    (run.folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    if not summary["samples"]:
        console.print(f"rti-mpc: nothing was driven, see {run.folder / 'logs'}", soft_wrap=True, markup=False)
        return 1
    console.print(
        f"{run.trajectory.name}, heading {run.heading}, {run.duration_s:.0f} s of the robot at {run.speed:g} times real speed", highlight=False
    )
    print_summary(console, summary)
    if find_spec("matplotlib") is not None:
        from rti_mpc_service.rig.figure import figure

        figure(outcome.run(), run.folder / "run.png")
        console.print(f"figure     {run.folder / 'run.png'}", soft_wrap=True, markup=False)
    if recorded():
        rerun = Path(sys.executable).with_name("rerun")
        console.print(f"recording  {path_as_typed(rerun) if rerun.exists() else 'rerun'} {run.folder / 'run.rrd'}", soft_wrap=True, markup=False)
    console.print(f"all of it  {run.folder}", soft_wrap=True, markup=False)
    if not summary["driven"]:
        console.print("rti-mpc: the robot was not driven to the end", markup=False)
    return 0 if summary["driven"] else 1


def guards(run: DemoPlan) -> tuple[str, ...]:
    """Return the guard's role, if there is one."""
    return ("guard",) if run.config.guard.enabled else ()


def recorded() -> bool:
    """Whether Rerun is installed, so that the run is recorded."""
    return find_spec("rerun") is not None


def path_as_typed(path: Path) -> Path:
    """Return a path relative to the current folder, if it is below it."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
