# SPDX-License-Identifier: Apache-2.0
"""
Command line: each command turns its options into one call. All physical settings are in the configuration file.

A command imports its modules when it runs, so that `rti-mpc --help` loads no solver,
no bus and no viewer. This is the only file that knows both `service` and `sim`.
"""

from __future__ import annotations

import inspect
import json
import os
import platform
from collections.abc import Callable
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import typer
from typer.core import TyperCommand

import rti_mpc
from rti_mpc.errors import ConfigError
from rti_mpc_service import entry, log
from rti_mpc_service.certs.commands import certs
from rti_mpc_service.certs.folder import credentials, secured
from rti_mpc_service.command_group import Commands
from rti_mpc_service.config.build import build_model, build_signals, bus_settings, robot_settings, stage_parameters, with_initial_state
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.config.signals_file import check_against
from rti_mpc_service.replay.commands import cases
from rti_mpc_service.shipped import ROBOTS, robot_file

if TYPE_CHECKING:
    from rti_mpc.wire.bus import BusSettings


SHIPPED = ROBOTS["pioneer_3dx"]


class FaultsCommand(TyperCommand):
    """Command whose help lists all faults."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the list of faults; its module is imported here only."""
        from rti_mpc_service.faults.table import FAULTS

        with formatter.section("Faults"):
            formatter.write_dl([(fault.name, fault.text) for fault in FAULTS])


app = typer.Typer(
    cls=Commands,
    help="Real-time nonlinear model predictive control as a service, over Zenoh.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.add_typer(certs, name="certs")
app.add_typer(cases)


def print_version(wanted: bool) -> None:
    """Print the versions of rti-mpc, its messages, Python and the packages it depends on."""
    if wanted:
        from rti_mpc.wire import cdr
        from rti_mpc_service.host import machine

        packages = ", ".join(f"{name} {version}" for name, version in machine.packages().items())
        typer.echo(f"rti-mpc {rti_mpc.__version__}, messages of version {cdr.MESSAGE_VERSION}, Python {platform.python_version()}, {packages}")
        raise typer.Exit


@app.callback()
def top(
    version: Annotated[
        bool, typer.Option("--version", callback=print_version, is_eager=True, help="Print the versions of rti-mpc and its dependencies.")
    ] = False,
) -> None:
    """Real-time nonlinear model predictive control as a service, over Zenoh."""


def claimed(path: Path | None) -> Path | None:
    """Check that a file can be written, before its content is computed for minutes."""
    try:
        if path is not None:
            path.touch()
    except OSError as error:
        raise ConfigError(f"--json must be a file that can be written, got {path}: {error.strerror}") from error
    return path


ConfigPath = Annotated[Path, typer.Argument(metavar="CONFIG", help="The robot's TOML file.", show_default="the shipped pioneer_3dx.toml")]
RobotName = Annotated[str | None, typer.Option("--robot", metavar="NAME", help="A robot that ships, instead of CONFIG: see `rti-mpc robots`.")]
JsonPath = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Also write the results as JSON.", callback=claimed)]


def file_of(config: Path, robot: str | None) -> Path:
    """
    Return the TOML file that a command is about.

    Raises:
        ConfigError: There are two, or no robot of this name ships.
    """
    if robot is not None and config != SHIPPED:
        raise ConfigError(f"CONFIG or --robot must be left out, got {config} and {robot}")
    return config if robot is None else robot_file(robot)


def options(
    mode: Annotated[Literal["peer", "client"] | None, typer.Option("--mode", "-m", help="Mode of the Zenoh session.")] = None,
    connect: Annotated[list[str] | None, typer.Option("--connect", "-e", metavar="ENDPOINT", help="Endpoint to connect to; repeatable.")] = None,
    listen: Annotated[list[str] | None, typer.Option("--listen", "-l", metavar="ENDPOINT", help="Endpoint to listen on; repeatable.")] = None,
    zenoh: Annotated[Path | None, typer.Option("--config", "-c", metavar="FILE", help="Zenoh's own configuration, JSON5.")] = None,
    tls: Annotated[
        Path | None, typer.Option("--tls", metavar="DIR", help="Folder of this host's certificates, see `rti-mpc certs`; the bus is TLS then.")
    ] = None,
    cfg: Annotated[list[str] | None, typer.Option("--cfg", metavar="KEY:VALUE", help="One Zenoh setting, applied last; repeatable.")] = None,
    multicast: Annotated[
        bool | None, typer.Option("--multicast-scouting/--no-multicast-scouting", help="Look for other processes by multicast; off by default.")
    ] = None,
) -> dict[str, Any]:
    """Collect Zenoh's options, named as in Zenoh's own programs."""
    given = {"mode": mode, "connect": connect, "listen": listen, "config": zenoh, "tls": tls, "cfg": cfg, "multicast": multicast}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in given.items() if value is not None}


def process(command: Callable[..., int | None], *, with_model: bool = True) -> Callable[..., None]:
    """
    Register a command that runs a process on the bus: it takes CONFIG and Zenoh's options besides its own.

    Args:
        command: Takes the configuration, the settings of the bus, and its own options; returns an exit status, None for 0. If it
            takes `words`, CONFIG is the first TOML file among them; if it takes `path`, it is told which file CONFIG is.
        with_model: Whether the configuration is checked against the model.
    """
    shared = inspect.signature(options, eval_str=True).parameters
    _, _, *own = inspect.signature(command, eval_str=True, locals={"BusSettings": Any}).parameters.values()
    wants_path = any(parameter.name == "path" for parameter in own)
    own = [parameter for parameter in own if parameter.name != "path"]

    @wraps(command)
    def run(config: Path = SHIPPED, **given: Any) -> None:
        if "words" in given:
            words = [str(config), *(given["words"] or [])]
            file = next((word for word in words if word.endswith(".toml")), "")
            config, given["words"] = Path(file or SHIPPED), [word for word in words if word != file]
        if wants_path:
            given["path"] = config
        loaded = load(config, with_model=with_model)
        overrides = options(**{name: given.pop(name) for name in shared})
        folder = overrides.pop("tls", None) or credentials() or loaded.bus.tls
        settings = replace(bus_settings(loaded), **overrides)
        raise typer.Exit(command(loaded, secured(settings, folder, command.__name__) if folder else settings, **given) or 0)

    path = inspect.Parameter("config", inspect.Parameter.POSITIONAL_OR_KEYWORD, default=SHIPPED, annotation=ConfigPath)
    run.__signature__ = inspect.Signature([path, *own, *shared.values()])  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in (path, *own, *shared.values())}
    del run.__wrapped__  # otherwise inspect would read the signature of `command`
    return app.command()(run)


ScenarioName = Annotated[
    str | None,
    typer.Option(
        metavar="circle|eight|positioning|sines|steps|FILE.csv",
        help="Reference to follow; a file holds waypoints, or columns t and all outputs by name.",
        show_default="that of the file; or eight for a robot in the plane, sines of its outputs for any other",
    ),
]
WaypointSpeed = Annotated[float, typer.Option(metavar="M/S", min=0.001, help="Speed along waypoints.")]
WaypointSmoothing = Annotated[
    float | None,
    typer.Option(
        metavar="M", min=0.0, help="Length of path over which waypoints are averaged; 0: not averaged.", show_default="as their noise needs"
    ),
]
Timeout = Annotated[float, typer.Option("--timeout", metavar="SECONDS", min=0.1, help="Longest time to wait for an answer.")]


StatePath = Annotated[
    Path | None,
    typer.Option(
        "--state",
        metavar="DIR",
        help="Folder in which an operator's stop is kept across restarts.",
        show_default="$STATE_DIRECTORY, $XDG_STATE_HOME/rti_mpc or ~/.local/state/rti_mpc",
    ),
]


@process
def run(
    config: Config,
    bus: BusSettings,
    path: Path,
    standby: Annotated[bool, typer.Option("--standby", help="Stand by while another controller leads, and take over when it stops sending.")] = False,
    state: StatePath = None,
) -> int:
    """Run the controller: answer each state of the robot with a command that follows the reference."""
    from rti_mpc_service.controller.daemon import main

    if config.guard.enabled:
        check_against(path, build_signals(config))
    return main(config, bus, standby=standby, state=state)


@partial(process, with_model=False)
def guard(config: Config, bus: BusSettings, path: Path, state: StatePath = None) -> int:
    """Run the guard between controller and robot: pass on commands that are fresh and inside the limits, brake without them."""
    from rti_mpc_service.guard import main

    return main(config, bus, path, state=state)


@process
def sim(
    config: Config,
    bus: BusSettings,
    speed: Annotated[float, typer.Option(min=0.01, max=100.0, help="Simulated seconds per second of real time.")] = 1.0,
    x0: Annotated[list[str] | None, typer.Option(metavar="NAME=VALUE", help="Initial state, instead of the configuration's; repeatable.")] = None,
    duration: Annotated[float | None, typer.Option(metavar="SECONDS", min=0.0, help="Stop after this robot time.")] = None,
    log: Annotated[Path | None, typer.Option(metavar="FILE.csv", help="Write each state with its input and the time of its answer.")] = None,
) -> None:
    """Simulate the robot: a plant with its own parameters, which stops when it receives no valid commands."""
    from rti_mpc_sim.robot import main
    from rti_mpc_sim.settings import RobotSettings

    listen = bus.listen or config.bus.listen or (bus.connect if bus.mode == "peer" and bus.config is None else ())
    settings = RobotSettings(**robot_settings(with_initial_state(config, x0 or [])))
    main(settings, replace(bus, listen=listen), config.keys(), speed=speed, log=log, duration_s=duration, guarded=config.guard.enabled)


@process
def reference(
    config: Config,
    bus: BusSettings,
    scenario: ScenarioName = None,
    heading: Annotated[
        Literal["tangent", "consistent", "none"] | None,
        typer.Option(
            help="Heading of the reference: along the path; as a point ahead of the axle can follow it; or zero.", show_default="consistent"
        ),
    ] = None,
    duration: Annotated[
        float | None, typer.Option(metavar="SECONDS", min=0.1, help="Duration of the reference, robot time.", show_default="the scenario's own")
    ] = None,
    waypoint_speed: WaypointSpeed = 0.25,
    waypoint_smoothing: WaypointSmoothing = None,
    track: Annotated[
        str | None,
        typer.Option("--path", metavar="FILE.csv", help="Path for a robot that follows one, in place of a scenario: a file, or a track that ships."),
    ] = None,
    path_limits: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(
            metavar="V LATERAL ACCELERATION BRAKING", help="Limits of the speed along it, in m/s and m/s^2.", show_default="the speeds of the file"
        ),
    ] = None,
) -> None:
    """Publish a reference that starts at the robot's current state, and again after each restart of the robot."""
    from rti_mpc_service.reference import main
    from rti_mpc_service.scenario import find_scenario

    if track is not None:
        if left_out := [f"--{name}" for name, value in {"scenario": scenario, "heading": heading, "duration": duration}.items() if value is not None]:
            raise ConfigError(f"--path is followed in place of a scenario and says nothing of time: {', '.join(left_out)} must be left out")
        from rti_mpc.reference.speed_profile import SpeedLimits
        from rti_mpc_service import path_reference

        limits = None if path_limits is None else SpeedLimits(*path_limits)
        pieces = path_reference.find_path(track, waypoint_speed if limits is None else limits.speed, limits, waypoint_smoothing)
        path_reference.main(track, build_model(config), pieces, bus, config.keys())
        return
    if path_limits is not None:
        raise ConfigError("--path-limits are those of a --path, which must be given as well")
    followed = find_scenario(config, scenario, heading, duration, waypoint_speed, waypoint_smoothing)
    main(followed, bus, config.keys(), parameters=partial(stage_parameters, config))


@process
def view(
    config: Config,
    bus: BusSettings,
    words: Annotated[list[str] | None, typer.Argument(metavar="[RUN.mcap]", help="Recording to draw in place of the robot.")] = None,
    rerun_spawn: Annotated[bool, typer.Option("--rerun-spawn", help="Start a Rerun viewer on this machine.")] = False,
    rerun_connect: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Draw in a Rerun viewer at this address, also if it starts later.")
    ] = None,
    rerun_save: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help="Record to a file.")] = None,
    rerun_memory_limit: Annotated[
        str, typer.Option(metavar="SIZE", help="Memory of a spawned viewer, beyond which it drops the oldest data.")
    ] = "25%",
    robot: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Robot to draw; repeat it for several in one view.", show_default="the robot of CONFIG")
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Serve Rerun's page for browsers from this machine, to this machine alone.")] = False,
    rerun_web_port: Annotated[int, typer.Option(metavar="PORT", min=1, max=65535, help="Port of this page.")] = 9090,
) -> int:
    """Draw the robot live in Rerun, or record it; or draw a recording."""
    from rti_mpc_service.view.view import Screens, main, show

    screens = Screens(rerun_spawn, rerun_connect, rerun_save, rerun_memory_limit, rerun_web_port if web else None)
    if not words:
        return main(bus, config.keys(), screens, robots=robot or ())
    if len(words) > 1:
        raise ConfigError(f"view draws one recording, got {' '.join(words)}")
    if robot:
        raise ConfigError("--robot is for live robots: all those of a recording are drawn")
    return show(Path(words[0]), screens)


@partial(process, with_model=False)
def record(
    config: Config,
    bus: BusSettings,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="File to write; with a limit, a folder.", show_default="runs/ROBOT-TIME.mcap")
    ] = None,
    robot: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Robot to record, or a pattern such as '*'; repeatable.", show_default="the robot of CONFIG"),
    ] = None,
    last: Annotated[str | None, typer.Option(metavar="TIME", help="Keep this time, such as 10min, and delete what is older.")] = None,
    max_size: Annotated[str | None, typer.Option(metavar="SIZE", help="Keep this size, such as 2GB, and delete what is older.")] = None,
    repair: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="Instead, end a file whose recorder was killed, so that other tools read it.")
    ] = None,
) -> int:
    """Record all streams of one or more robots into an MCAP file, which Foxglove, PlotJuggler, Rerun and ROS 2 open."""
    from rti_mpc_service.record import record

    if repair is not None:
        return record.repaired(repair, out or repair)
    return record.main(bus, config.keys(), out=out, robots=robot or (), retention=record.parse_retention(last, max_size))


@app.command()
def export(
    recording: Annotated[Path, typer.Argument(metavar="RUN.mcap", help="Recording, or the folder of its segments.")],
    parquet: Annotated[Path, typer.Option(metavar="DIR", help="Folder for a Parquet file a stream, in a folder a robot.")],
    horizon: Annotated[bool, typer.Option("--horizon", help="Also all rows of plans and references used, as lists.")] = False,
) -> None:
    """Write a recording as tables, with columns named by signal, and units in their metadata."""
    from rti_mpc_service.record.export import main

    raise typer.Exit(main(recording, parquet, horizon=horizon))


RecordingPath = Annotated[Path, typer.Argument(metavar="RUN.mcap", help="Recording, or folder of its segments.", show_default=False)]
RecordedRobot = Annotated[str | None, typer.Option("--robot", metavar="NAME", help="Robot of the recording.", show_default="all")]
Owner = Annotated[int | None, typer.Option("--controller", metavar="NUMBER", help="Controller of the recording.", show_default="all")]
ModelFolder = Annotated[Path, typer.Option("--folder", metavar="DIR", help="Folder of a model of your own.", show_default="this folder")]
Trust = Annotated[bool, typer.Option("--trust", help="Run the attached source of the model, which is code of whoever made the recording.")]


@app.command()
def replay(
    recording: RecordingPath,
    start: Annotated[str | None, typer.Option("--from", metavar="TIME", help="Time after the first state from which on to replay.")] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Another weight or bound: what would have been commanded in the same states; repeatable."),
    ] = None,
    robot: RecordedRobot = None,
    owner: Owner = None,
    folder: ModelFolder = Path(),
    trust: Trust = False,
    tolerance: Annotated[float, typer.Option(min=0.0, help="Largest relative difference on another machine or other versions.")] = 1e-6,
    path: JsonPath = None,
    closed_loop: Annotated[
        bool, typer.Option("--closed-loop", help="Also drive the simulated robot of the configuration, with --set if given, and compare both drives.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for a figure of both drives, and a recording of both for `rti-mpc view`.")
    ] = None,
) -> None:
    """Repeat what a recorded controller did, from its journal, and compare each command bit by bit; or drive it in closed loop."""
    from rti_mpc_service.replay.replay import main, parse_start

    choice: dict[str, Any] = {"robot": robot, "owner": owner, "folder": folder, "trust": trust}
    choice |= {"tolerance": tolerance, "json_path": path, "make_body": lockstep_robot if closed_loop else None, "out": out}
    raise typer.Exit(main(recording, start_s=parse_start(start), assignments=assignments or (), **choice))


@partial(process, with_model=False)
def why(
    config: Config,
    bus: BusSettings,
    words: Annotated[list[str] | None, typer.Argument(metavar="[RUN.mcap]", help="Recording, in place of the running controller.")] = None,
    at: Annotated[str | None, typer.Option("--at", metavar="TIME", help="Time after the first command, such as 72.5s.")] = None,
    seq: Annotated[int | None, typer.Option("--seq", metavar="NUMBER", help="Number of the command.", show_default="the last command")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    case: Annotated[Path | None, typer.Option(metavar="FILE.npz", help="Also write the sample's QP as a case, for `rti-mpc solve-case`.")] = None,
    robot: RecordedRobot = None,
    owner: Owner = None,
    folder: ModelFolder = Path(),
    trust: Trust = False,
) -> int:
    """Explain a command, recorded or just sent: who solved it, which bounds act, what its plan costs, and the events that led there."""
    from rti_mpc_service.replay import live
    from rti_mpc_service.replay.replay import parse_start
    from rti_mpc_service.replay.why import main

    choice: dict[str, Any] = {"owner": owner, "folder": folder, "trust": trust, "as_json": as_json, "case_path": case}
    if not words:
        if not (at is None and seq is None and robot is None):
            raise ConfigError("--at, --seq and --robot must come with a recording: a running controller is asked for its last command")
        return live.main(bus, config.keys(), **choice)
    if len(words) > 1:
        raise ConfigError(f"why explains a command of one recording, got {' '.join(words)}")
    return main(Path(words[0]), at_s=None if at is None else parse_start(at), seq=seq, robot=robot, **choice)


@partial(process, with_model=False)
def router(config: Config, bus: BusSettings) -> None:
    """Run a Zenoh router, for clients on several hosts or with access control."""
    from rti_mpc_service import router_log
    from rti_mpc_service.router import main

    router_log.follow()
    main(bus, config.keys())


@partial(process, with_model=False)
def stop(config: Config, bus: BusSettings, timeout: Timeout = 2.0, state: StatePath = None) -> int:
    """Stop the robot; it stays stopped across every restart until `enable`."""
    from rti_mpc_service.request import stop_or_enable

    return stop_or_enable(bus, config.keys(), "stop", timeout, guarded=config.guard.enabled, state=state)


@partial(process, with_model=False)
def enable(config: Config, bus: BusSettings, timeout: Timeout = 2.0, state: StatePath = None) -> int:
    """Release a robot that was stopped by `stop`."""
    from rti_mpc_service.request import stop_or_enable

    return stop_or_enable(bus, config.keys(), "enable", timeout, guarded=config.guard.enabled, state=state)


@partial(process, with_model=False)
def status(
    config: Config,
    bus: BusSettings,
    once: Annotated[bool, typer.Option("--once", help="Print the table once; without a terminal it always is.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, once, for scripts.")] = False,
    timeout: Timeout = 3.0,
) -> int:
    """Show all robots on the bus: mode, error, ages, times, who leads, whether the solvers agree, versions, the last event."""
    from rti_mpc_service.status.status import main

    return main(bus, config.keys(), once=once, as_json=as_json, timeout_s=timeout)


@partial(process, with_model=False)
def params(
    config: Config,
    bus: BusSettings,
    words: Annotated[list[str] | None, typer.Argument(metavar="get [KEY]... | set KEY=VALUE...", help="Keys and values as in the file.")] = None,
    timeout: Timeout = 2.0,
) -> int:
    """Print parameters of the running controller, or change them, all or none, between two samples."""
    from rti_mpc_service.request import params

    return params(bus, config.keys(), words or ["get"], timeout)


@partial(process, with_model=False)
def snapshot(config: Config, bus: BusSettings, timeout: Timeout = 2.0) -> int:
    """Ask the leading controller for a snapshot, from which a replay of its recording can begin."""
    from rti_mpc_service.request import main

    return main(bus, config.keys(), "snapshot", timeout)


@app.command()
def demo(
    config: ConfigPath = SHIPPED,
    robot: RobotName = None,
    scenario: ScenarioName = None,
    heading: Annotated[
        Literal["tangent", "consistent", "none"] | None,
        typer.Option(
            help="Heading of the reference: along the path; as a point ahead of the axle can follow it; or zero, with no weight on it.",
            show_default="the scenario's best",
        ),
    ] = None,
    speed: Annotated[float, typer.Option(min=0.01, max=100.0, help="Simulated seconds per second of real time.")] = 4.0,
    duration: Annotated[
        float | None, typer.Option(metavar="SECONDS", min=1.0, help="Duration of the drive, robot time.", show_default="the scenario's own")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for configuration, summary, figure and recording.", show_default="runs/SCENARIO-TIME")
    ] = None,
    viewer: Annotated[bool, typer.Option("--viewer", help="Show the drive live in Rerun.")] = False,
    guard: Annotated[bool, typer.Option("--guard", help="Run a guard between controller and robot.")] = False,
    waypoint_speed: WaypointSpeed = 0.25,
    waypoint_smoothing: WaypointSmoothing = None,
) -> None:
    """Run the whole system on this machine, and print a summary of errors, limits and times."""
    from rti_mpc_service.demo.demo import main

    raise typer.Exit(
        main(
            load(file_of(config, robot)),
            scenario,
            heading=heading,
            waypoint_speed_m_s=waypoint_speed,
            waypoint_smoothing_m=waypoint_smoothing,
            speed=speed,
            duration_s=duration,
            folder=out,
            viewer=viewer,
            guard=guard,
        )
    )


@app.command(cls=FaultsCommand)
def faults(
    config: ConfigPath = SHIPPED,
    robot: RobotName = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Name of a fault from the list below; repeatable.", show_default="all")
    ] = None,
    path: JsonPath = None,
    scenario: ScenarioName = None,
    waypoint_speed: WaypointSpeed = 0.25,
    waypoint_smoothing: WaypointSmoothing = None,
    record: Annotated[
        Path | None, typer.Option("--record", metavar="DIR", help="Record all streams into a new folder, to replay what each controller did.")
    ] = None,
) -> None:
    """Inject faults into a running system, one after the other, and print what the robot did: the fault matrix."""
    from rti_mpc_service.faults.run import main

    raise typer.Exit(main(file_of(config, robot), tuple(only or ()), path, scenario, waypoint_speed, waypoint_smoothing, record))


@process
def conformance(
    config: Config,
    bus: BusSettings,
    words: Annotated[list[str] | None, typer.Argument(metavar="robot|guard", help="What is judged.")] = None,
    json_path: JsonPath = None,
    moves: Annotated[bool, typer.Option("--moves-the-robot", help="Consent to the motion: metres, at up to the bounds of the inputs.")] = False,
) -> int:
    """Judge a robot or a guard of any make against the contract, in the place of its controller; it moves the robot."""
    from rti_mpc_service.conformance.run import main

    return main(config, bus, words or (), json_path, moves=moves)


@app.command()
def bench(
    horizon: Annotated[
        list[int] | None, typer.Option("--horizon", "-n", min=2, help="Horizon, in stages; repeatable.", show_default="7, 20, 50, 100, 200")
    ] = None,
    solver: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Further QP solver to measure, by its name in qpsolvers, such as daqp; repeatable.")
    ] = None,
    problem: Annotated[
        list[str] | None, typer.Option(metavar="FAMILY", help="Problem family to measure instead, such as slalom, or all; repeatable.")
    ] = None,
    interpreted: Annotated[bool, typer.Option("--interpreted", help="Also measure without a compiler.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="A short run: eight seconds of driving.")] = False,
    costs: Annotated[bool, typer.Option("--costs", help="Also compare closed-loop costs with those of exact QPs and of converged NMPC.")] = False,
    path: JsonPath = None,
) -> None:
    """Measure the computing time per sample by horizon, solver and formulation, and of IPOPT on the same states."""
    if problem:
        from rti_mpc_service.bench import family_bench

        raise typer.Exit(family_bench.main(problem, horizon or (), solver or family_bench.DEFAULT_SOLVERS, quick=quick, path=path))
    from rti_mpc_service.bench.bench import DEFAULT_HORIZONS, main

    horizons, solvers = tuple(horizon or DEFAULT_HORIZONS), tuple(solver or ())
    raise typer.Exit(main(horizons, solvers=solvers, interpreted=interpreted, quick=quick, costs=costs, path=path))


@app.command()
def paper(
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for paper.md and its folder of figures and run.json.", show_default="runs/paper-TIME")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A short run: three seconds of every experiment, few points of each sweep.")] = False,
) -> None:
    """Reproduce the paper's study: its algorithms, real-time iteration and converged NMPC, and the effect of each setting."""
    from rti_mpc_service.paper.study import main

    raise typer.Exit(main(out, quick=quick))


@app.command()
def check(config: ConfigPath = SHIPPED, robot: RobotName = None) -> None:
    """Check a configuration: solve 200 samples, print the times of both phases, and compare with a second solver."""
    from rti_mpc_service.check.check import main

    raise typer.Exit(main(file_of(config, robot)))


@app.command()
def robots() -> None:
    """List the robots that ship: size, period, horizon, what they do at rest, and where their parameters are from."""
    from rti_mpc_service.robots import main

    main()


def lockstep_robot(settings: dict[str, Any], epoch: int = 1, now_ns: int = 0) -> Any:
    """Make a simulated robot that its caller advances, from a time on. Other processes find this function by its name."""
    from rti_mpc_sim.lockstep import Lockstep
    from rti_mpc_sim.settings import RobotSettings

    return Lockstep(RobotSettings(**settings), epoch, now_ns)


@app.command()
def tune(
    config: ConfigPath = SHIPPED,
    robot: RobotName = None,
    scenario: ScenarioName = None,
    held_out: Annotated[
        str | None,
        typer.Option(
            "--held-out",
            metavar="SCENARIO",
            help="Scenario that no trial sees, which decides whether the chosen values are better.",
            show_default="circle, or steps of outputs; eight or sines if the study has that; the second half of a recording",
        ),
    ] = None,
    heading: Annotated[
        Literal["tangent", "consistent", "none"] | None, typer.Option(help="Heading of the references.", show_default="consistent")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(metavar="SECONDS", min=1.0, help="Duration of a drive, robot time.", show_default="the scenario's own")
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY[=LOW:HIGH]",
            help="Key of the file to vary, such as ocp.weights.Q.psi=0.001:1, ocp.N or timing.delay_s; repeatable.",
            show_default="weights above 0 except those of the position, two decades up and down",
        ),
    ] = None,
    trials: Annotated[int, typer.Option(metavar="N", min=1, max=100_000, help="Number of trials of the study, with those it has already.")] = 100,
    effort: Annotated[float, typer.Option(metavar="FACTOR", min=0.01, max=100.0, help="Effort allowed, relative to today's.")] = 1.0,
    jobs: Annotated[int | None, typer.Option(metavar="N", min=1, max=1000, help="Processes.", show_default="one per core")] = None,
    storage: Annotated[
        str | None,
        typer.Option(
            metavar="URL", help="Storage of Optuna, for several machines on one study.", show_default="sqlite, in a file beside the one written"
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.toml", help="File to write; figure and study go beside it.", show_default="CONFIG.tuned.toml")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the proposals.")] = 1,
    waypoint_speed: WaypointSpeed = 0.25,
    waypoint_smoothing: WaypointSmoothing = None,
) -> None:
    """Tune weights by simulation: propose, drive, and write those that a held-out scenario finds better into a copy of the file."""
    from rti_mpc_service.tune.closed_loop import Course
    from rti_mpc_service.tune.tune import main

    course = Course(scenario, heading, duration, waypoint_speed, waypoint_smoothing)
    raise typer.Exit(
        main(
            file_of(config, robot),
            course,
            held_out,
            lockstep_robot,
            vary=vary or (),
            trials=trials,
            jobs=jobs or os.cpu_count() or 1,
            effort=effort,
            seed=seed,
            storage=storage,
            out=out,
        )
    )


@app.command()
def init(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Name of the robot and of its Python module.")] = None,
    like: Annotated[str, typer.Option("--like", metavar="unicycle|bicycle", help="Example to start from.")] = "unicycle",
    deploy: Annotated[bool, typer.Option("--deploy", help="Write systemd units, configurations of Zenoh and the runbook into deploy/.")] = False,
) -> None:
    """Write configuration, model, test and a page of next steps for a robot of your own into this folder."""
    from rti_mpc_service.init import main

    for path in main(name, like, Path(), deploy=deploy):
        typer.echo(path)
    typer.echo(f"next: rti-mpc check {name}.toml, see {name}.md" if name else "next: see deploy/runbook.md")


@app.command()
def schema() -> None:
    """Print the JSON schema of a robot's TOML file, with which editors complete and check it."""
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    typer.echo(json.dumps(head | Config.model_json_schema() | {"title": "rti-mpc robot"}, indent=1))


@app.command()
def doctor(
    config: ConfigPath = SHIPPED,
    path: JsonPath = None,
    security: Annotated[
        bool, typer.Option("--security", help="Say instead what is open here: listeners, missing TLS, certificates about to end, permissions.")
    ] = False,
    tls: Annotated[Path | None, typer.Option("--tls", metavar="DIR", help="With --security: folder of this host's certificates.")] = None,
    state: StatePath = None,
) -> None:
    """Examine this host: scheduler, clock, timers, bus, compiler, and the shortest period that the loop can keep; or its security."""
    if security:
        from rti_mpc_service.doctor import security as examination

        raise typer.Exit(examination.main(config, path, tls=tls, state=state))
    from rti_mpc_service.doctor.doctor import main

    raise typer.Exit(main(config, path))


def main() -> NoReturn:
    """Run the command line; bad input is refused in one line, with exit status 2."""
    entry.enter(log.start, app)


if __name__ == "__main__":
    main()
