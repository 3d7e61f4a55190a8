# SPDX-License-Identifier: Apache-2.0
"""
Demo: the whole system on this machine, with robot, controller, reference, recorder and viewer as processes, and a summary.

The demo is one more peer. It listens on a free loopback port to which all others
connect, so that several demos can run side by side. It starts the robot when all
other processes are present, listens, and stops them when the robot has been driven
for long enough. Robot and controller have priority over all others.
"""

from __future__ import annotations

import re
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
from rti_mpc.model.model import Model
from rti_mpc.model.path_following import window_place
from rti_mpc.reference.tracks import TRACKS
from rti_mpc.reference.trajectory import Heading
from rti_mpc.signals import in_plane, plane, quantity
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.cdr import encode
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc_service.config.build import build_model, build_ocp, robot_settings
from rti_mpc_service.config.fit import check_period, check_stop
from rti_mpc_service.config.schema import Config
from rti_mpc_service.console import plain_console, widened
from rti_mpc_service.demo.board import Board, print_summary
from rti_mpc_service.host import machine
from rti_mpc_service.host.echo import ROLE as ECHO
from rti_mpc_service.host.echo import Echo
from rti_mpc_service.json_text import json_text
from rti_mpc_service.path_reference import path_of_options, path_scenario
from rti_mpc_service.rig import robot_log
from rti_mpc_service.rig.children import Children
from rti_mpc_service.rig.company import CLI_MODULE, START_TIMEOUT_S, WATCHER_NICENESS, Failed, check_children, wait
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.rig.run_data import wanted
from rti_mpc_service.rig.scenario import BEST_HEADINGS, configured, path_options, reference_options, write_files
from rti_mpc_service.rig.summary import Outcome, summarize
from rti_mpc_service.rig.witness import Witness
from rti_mpc_service.scenario import Scenario, find_scenario

CONTROLLER_SILENCE_S = 5.0  # after which the run ends: the robot will not be driven any further
END_TIMEOUT_S = 5.0  # a guard may take 3 s to bring the robot to rest
POLL_PERIOD_S = 0.1
DRAW_PERIOD_S = 0.25
REFERENCE_MARGIN_S = 5.0  # reference beyond the last sample's horizon: near the last row a controller slows down
MAX_USUAL_SPEED, SHORTEST_REAL_PERIOD_S = 4.0, 0.01  # of demos that are not told their speed: controller, robot, guard and watchers share a host
WATCHER_END_TIMEOUT_S = 8.0  # for viewer and recorder to write what they have received
WATCHERS = {role: module for role, module in (("viewer", "rerun"), ("recorder", "mcap")) if find_spec(module)}
# The viewer ends first, so that what it shows ends while the robot is still driven; the recorder ends when all others have said their last.
END_ORDER = ("viewer", "controller", "guard", "robot", "reference", "echo", "recorder")


@dataclass(frozen=True)
class DemoPlan:
    """
    Settings of a demo.

    Attributes:
        config: Configuration that all processes load.
        scenario: Scenario to follow.
        reference: Options of the reference's process.
        duration_s: Duration of the run in robot time.
        speed: Seconds of robot time per second.
        folder: Folder of all results.
        viewer: Whether to show the run in a Rerun viewer.
    """

    config: Config
    scenario: Scenario
    reference: tuple[object, ...]
    duration_s: float
    speed: float
    folder: Path
    viewer: bool


def plan(
    config: Config,
    name: str | None,
    *,
    heading: Heading | None,
    waypoint_speed_m_s: float,
    waypoint_smoothing_m: float | None,
    path: str | None,
    path_limits: tuple[float, float, float, float] | None,
    speed: float | None,
    duration_s: float | None,
    folder: Path | None,
    viewer: bool,
    guard: bool,
) -> DemoPlan:
    """
    Return the settings of a demo; what is None is decided by the scenario.

    Raises:
        ConfigError: There is no such scenario or path, or it does not fit the robot.
        OcpError: No consistent heading repeats on a closed path.
    """
    waypoints = (waypoint_speed_m_s, waypoint_smoothing_m)
    if path is not None:
        scenario = path_scenario(build_model(config), path, path_of_options(path, path_limits, *waypoints, scenario=name, heading=heading))
        reference = path_options(path, path_limits, *waypoints)
    else:
        check_no_path(config, path_limits)
        scenario = find_scenario(config, name, heading or BEST_HEADINGS.get(name or ""), None, *waypoints)
        lasts_s = (duration_s or scenario.duration_s) + config.ocp.N * config.ocp.dt_s + REFERENCE_MARGIN_S
        reference = reference_options(name, scenario, lasts_s, *waypoints)
    config = configured(config, scenario, guard)
    check_start(config)
    return DemoPlan(
        config=config,
        scenario=scenario,
        reference=reference,
        duration_s=duration_s or scenario.duration_s,
        speed=usual_speed(config.ocp.dt_s) if speed is None else speed,
        folder=folder or Path("runs") / f"{scenario.name}-{datetime.now():%Y%m%d-%H%M%S}",
        viewer=viewer,
    )


def usual_speed(dt_s: float) -> float:
    """Return how many times real speed a demo drives a robot of a period in s: what processes on a host keep up with, at least 1."""
    return max(1.0, min(MAX_USUAL_SPEED, dt_s / SHORTEST_REAL_PERIOD_S))


def check_no_path(config: Config, path_limits: object) -> None:
    """
    Check that nothing asks for a path, where none is given.

    Raises:
        ConfigError: The robot follows one, or limits are given for one.
    """
    if path_limits is not None:
        raise ConfigError("--path-limits are those of a --path, which must be given as well")
    if window_place(model := build_model(config)) is not None:
        raise ConfigError(f"model {model.name} follows a path: --path must say which, {', '.join(TRACKS)} or a FILE.csv")


def check_start(config: Config) -> None:
    """
    Check that the outputs are numbers where the simulated robot starts.

    Raises:
        ConfigError: One is not.
    """
    model, x0 = build_model(config), robot_settings(config)["x0"]
    y = np.array(model.h()(x0, model.p_nominal)).ravel()
    if wrong := [output.name for output, value in zip(model.outputs, y, strict=True) if not np.isfinite(value)]:
        raise ConfigError(f"sim.x0 must be a state whose outputs are finite, {wrong[0]} is not, got {x0}")


def main(config: Config, scenario: str | None, **options: Any) -> int:
    """
    Run a demo, write its folder, and print its summary.

    Returns:
        Exit status: 0 if the robot was driven to the end.

    Raises:
        ConfigError: A stop would not bring the robot to rest, a command not last until the next, the scenario is none, or does not fit the robot,
            or the folder cannot be written.
    """
    check_period(config)
    check_stop(config)
    console = plain_console()
    run = plan(config, scenario, **options)
    try:
        run.folder.mkdir(parents=True, exist_ok=True)
        write_files(run.folder / "config.toml", run.config)
    except OSError as error:
        raise ConfigError(f"--out must be a folder that can be written, got {run.folder}: {error.strerror}") from error
    if run.scenario.note:
        console.print(run.scenario.note, soft_wrap=True)
    stop = stop_on_signals()
    try:
        outcome = drive(run, console, stop)
    except Failed as error:
        console.print(f"rti-mpc: {error}", soft_wrap=True)
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
    title = f"{run.scenario.title}, {run.speed:g} times real speed"
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
        company = {"controller", "reference", ECHO, *WATCHERS, *guards(run)}
        shown = set[str]()

        def met() -> bool:
            """Whether everybody is there; shows meanwhile who is missing, and that the controller compiles."""
            missing = witness.listen().missing(company)
            lines = {f"starting {', '.join(missing)}", *compiling(children.log("controller"))} if missing else set[str]()
            for line in sorted(lines - shown, reverse=True):
                board.wait(line)
            shown.update(lines)
            return not missing

        wait(met, children, stop, START_TIMEOUT_S, "all processes")
        echo = Echo(bus, State(0, 0, 0, np.zeros(ocp.model.nx)), 0.5 * ocp.dt / run.speed)
        meeting = ("-l", "tcp/127.0.0.1:0", "-e", endpoint)
        children.start("robot", CLI_MODULE, "sim", run.folder / "config.toml", *meeting, "--speed", run.speed, "--log", run.folder / "robot.csv")
        board.wait("starting the robot")
        follow(run, ocp.model, witness, board, children, stop)
        board.wait("stopping all processes")
        for name in (name for name in END_ORDER if name in {*company, "robot"}):
            if children.end(name, WATCHER_END_TIMEOUT_S if name in WATCHERS else END_TIMEOUT_S):
                board.console.print(f"{name} did not end well, see {children.log(name)}", soft_wrap=True)
        witness.listen()
    if witness.info is None or witness.reference is None or witness.began_ns is None:
        raise Failed("stopped before the robot had a reference")
    return Outcome(
        scenario=run.scenario,
        reference=witness.reference,
        plant=robot_settings(run.config)["model"],
        anchor_ns=witness.began_ns,
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


def compiling(log: Path) -> set[str]:
    """Return what a controller has logged about its compilation."""
    return set(re.findall(r'"text": "(compiling [^"]*)"', log.read_text(encoding="utf-8", errors="replace")))


def start(run: DemoPlan, children: Children, endpoint: str, size: int) -> None:
    """Start all processes except the robot."""
    keys, config = run.config.keys(), run.folder / "config.toml"
    children.start("controller", CLI_MODULE, "run", config, "-e", endpoint)
    for name in guards(run):
        children.start(name, CLI_MODULE, "guard", config, "-e", endpoint)
    children.start("reference", CLI_MODULE, "reference", config, "-e", endpoint, *run.reference, nice=WATCHER_NICENESS)
    children.start("echo", "rti_mpc_service.host.echo", endpoint, keys.prefix, keys.robot, size)
    live = ("--rerun-spawn",) if run.viewer else ()
    commands = {
        "viewer": ("view", config, "--rerun-save", run.folder / "run.rrd", *live),
        "recorder": ("record", config, "--out", run.folder / "run.mcap"),
    }
    for name in WATCHERS:
        children.start(name, CLI_MODULE, *commands[name], "-e", endpoint, nice=WATCHER_NICENESS)


def follow(run: DemoPlan, model: Model, witness: Witness, board: Board, children: Children, stop: Event) -> None:
    """
    Listen until the robot was driven for long enough, the controller fell silent, or the demo is stopped.

    Raises:
        Failed: A process has ended by itself, or the robot was never driven.
    """
    slower = f" at {run.speed:g} times real speed, which a lower --speed makes easier," if run.speed > 1.0 else ""
    wait(lambda: witness.listen().begun, children, stop, START_TIMEOUT_S, f"the first sample{slower}")
    heard, heard_s, shown_s = 0, time.monotonic(), 0.0
    while not stop.is_set() and witness.reference is not None and witness.began_ns is not None:
        now_s, last = time.monotonic(), witness.telemetry[-1]
        time_s = 1e-9 * (last.state_stamp_ns - witness.began_ns)
        if len(witness.telemetry) > heard:
            heard, heard_s = len(witness.telemetry), now_s
        if time_s >= run.duration_s or now_s - heard_s > CONTROLLER_SILENCE_S:
            return
        if now_s - shown_s > DRAW_PERIOD_S:
            shown_s = now_s
            board.show(time_s, error_text(model, last, witness.reference), witness.telemetry, witness.events)
        check_children(children)
        stop.wait(POLL_PERIOD_S)
        witness.listen()


def error_text(model: Model, sample: Telemetry, reference: Reference) -> str:
    """Return the error of a sample as text: the distance in the plane, or the error of each output."""
    error = model.rotations("outputs").difference(sample.y, wanted(reference, np.array(sample.stamp_ns)))
    columns = plane(model.outputs)
    if in_plane(model.outputs) and columns is not None:
        return f"{1e3 * float(np.hypot(*error[list(columns)])):.2f} mm"
    return "  ".join(f"{output.name} {quantity(value, output.unit, '+.3g')}" for value, output in zip(error, model.outputs, strict=True))


def conclude(run: DemoPlan, outcome: Outcome, console: Console) -> int:
    """Write and print the summary of a run, draw it, and print how to view it; return the exit status."""
    summary = {**summarize(outcome), "heading": run.scenario.heading, "machine": machine.machine_info()}
    (run.folder / "summary.json").write_text(json_text(summary) + "\n", encoding="utf-8")
    if not summary["samples"]:
        console.print(f"rti-mpc: nothing was driven, see {run.folder / 'logs'}", soft_wrap=True)
        return 1
    title = f"{run.scenario.title}, {run.duration_s:.0f} s of the robot at {run.speed:g} times real speed"
    console.print(title, soft_wrap=True, highlight=False)
    print_summary(console, summary)
    if find_spec("matplotlib") is not None:
        from rti_mpc_service.rig.figure import figure

        figure(outcome.run(), run.folder / "run.png")
        console.print(f"figure     {run.folder / 'run.png'}", soft_wrap=True)
    if "viewer" in WATCHERS:
        rerun = Path(sys.executable).with_name("rerun")
        console.print(f"view it    {path_as_typed(rerun) if rerun.exists() else 'rerun'} {run.folder / 'run.rrd'}", soft_wrap=True)
    if "recorder" in WATCHERS:
        console.print(f"recording  {run.folder / 'run.mcap'}", soft_wrap=True)
    console.print(f"all of it  {run.folder}", soft_wrap=True)
    if not summary["driven"]:
        console.print("rti-mpc: the robot was not driven to the end")
    return 0 if summary["driven"] else 1


def guards(run: DemoPlan) -> tuple[str, ...]:
    """Return the guard's role, if there is one."""
    return ("guard",) if run.config.guard.enabled else ()


def path_as_typed(path: Path) -> Path:
    """Return a path relative to the current folder, if it is below it."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
