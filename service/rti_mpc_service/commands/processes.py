# SPDX-License-Identifier: Apache-2.0
"""Processes of a robot: controller, guard, source of a reference, viewer, router."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from rti_mpc.errors import ConfigError
from rti_mpc_service.commands.arguments import PathLimits, PathName, ScenarioName, StatePath, WaypointSmoothing, WaypointSpeed, new_file
from rti_mpc_service.commands.on_bus import on_bus
from rti_mpc_service.config.build import build_model, build_signals, stage_parameters
from rti_mpc_service.config.schema import Config
from rti_mpc_service.config.signals_file import check_against

if TYPE_CHECKING:
    from rti_mpc.wire.bus import BusSettings


processes = typer.Typer()


@on_bus(processes)
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


@on_bus(processes, with_model=False)
def guard(config: Config, bus: BusSettings, path: Path, state: StatePath = None) -> int:
    """Run the guard between controller and robot: pass on commands that are fresh and inside the limits, brake without them."""
    from rti_mpc_service.guard import main

    return main(config, bus, path, state=state)


@on_bus(processes)
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
    track: PathName = None,
    path_limits: PathLimits = None,
) -> int:
    """Publish a reference that starts at the robot's current state, and again after each restart of the robot."""
    from rti_mpc_service.reference import main
    from rti_mpc_service.scenario import find_scenario

    if track is not None:
        from rti_mpc_service import path_reference

        pieces = path_reference.path_of_options(
            track, path_limits, waypoint_speed, waypoint_smoothing, scenario=scenario, heading=heading, duration=duration
        )
        return path_reference.main(track, build_model(config), pieces, bus, config.keys())
    if path_limits is not None:
        raise ConfigError("--path-limits are those of a --path, which must be given as well")
    followed = find_scenario(config, scenario, heading, duration, waypoint_speed, waypoint_smoothing)
    return main(followed, bus, config.keys(), parameters=partial(stage_parameters, config))


@on_bus(processes)
def view(
    config: Config,
    bus: BusSettings,
    words: Annotated[list[str] | None, typer.Argument(metavar="RUN.mcap", help="Recording to draw in place of the robot.")] = None,
    rerun_spawn: Annotated[bool, typer.Option("--rerun-spawn", help="Start a Rerun viewer on this machine.")] = False,
    rerun_connect: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Draw in a Rerun viewer at this address, also if it starts later.")
    ] = None,
    rerun_save: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help="Record to a new file.", callback=new_file)] = None,
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


@on_bus(processes, with_model=False)
def router(config: Config, bus: BusSettings) -> None:
    """Run a Zenoh router, for clients on several hosts or with access control."""
    from rti_mpc_service import router_log
    from rti_mpc_service.router import main

    router_log.follow()
    main(bus, config.keys())
