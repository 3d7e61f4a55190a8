# SPDX-License-Identifier: Apache-2.0
"""Drives of the whole system: a demonstration, its faults, and conformance of robots and guards."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperCommand

from rti_mpc_service.commands.arguments import (
    ConfigPath,
    JsonPath,
    PathLimits,
    PathName,
    RobotName,
    ScenarioName,
    WaypointSmoothing,
    WaypointSpeed,
    file_of,
    folder_of_run,
    new_folder,
)
from rti_mpc_service.commands.on_bus import on_bus
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.shipped import SHIPPED

if TYPE_CHECKING:
    from rti_mpc.wire.bus import BusSettings


drives = typer.Typer()


class DemoCommand(TyperCommand):
    """Command whose help explains how the summary counts commands."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write what each count means; its module is imported here only."""
        from rti_mpc_service.demo.board import COMMAND_COUNTS

        with formatter.section("Commands that the summary counts"):
            formatter.write_dl(list(COMMAND_COUNTS.items()))


@drives.command(cls=DemoCommand)
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
    speed: Annotated[
        float | None,
        typer.Option(min=0.01, max=100.0, help="Simulated seconds per second of real time.", show_default="4, or less for periods under 40 ms"),
    ] = None,
    duration: Annotated[
        float | None, typer.Option(metavar="SECONDS", min=1.0, help="Duration of the drive, robot time.", show_default="the scenario's own")
    ] = None,
    out: Annotated[Path | None, folder_of_run("New folder for configuration, summary, figure and recording.", "SCENARIO", new_folder)] = None,
    viewer: Annotated[bool, typer.Option("--viewer", help="Show the drive live in Rerun.")] = False,
    guard: Annotated[bool, typer.Option("--guard", help="Run a guard between controller and robot.")] = False,
    waypoint_speed: WaypointSpeed = 0.25,
    waypoint_smoothing: WaypointSmoothing = None,
    track: PathName = None,
    path_limits: PathLimits = None,
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
            path=track,
            path_limits=path_limits,
            speed=speed,
            duration_s=duration,
            folder=out,
            viewer=viewer,
            guard=guard,
        )
    )


class FaultsCommand(TyperCommand):
    """Command whose help lists all faults."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the list of faults; its module is imported here only."""
        from rti_mpc_service.faults.table import FAULTS

        with formatter.section("Faults"):
            formatter.write_dl([(fault.name, fault.text) for fault in FAULTS])


@drives.command(cls=FaultsCommand)
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
        Path | None,
        typer.Option("--record", metavar="DIR", help="New folder in which to record all streams, to replay each controller.", callback=new_folder),
    ] = None,
) -> None:
    """Inject faults into a running system, one after the other, and print what the robot did: the fault matrix."""
    from rti_mpc_service.faults.run import main

    raise typer.Exit(main(file_of(config, robot), tuple(only or ()), path, scenario, waypoint_speed, waypoint_smoothing, record))


@on_bus(drives)
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
