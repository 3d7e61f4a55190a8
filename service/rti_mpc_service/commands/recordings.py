# SPDX-License-Identifier: Apache-2.0
"""Recordings: made, exported, replayed, questioned."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rti_mpc.errors import ConfigError
from rti_mpc_service.commands.arguments import JsonPath, new_file, new_folder
from rti_mpc_service.commands.on_bus import on_bus
from rti_mpc_service.commands.robot import lockstep_robot
from rti_mpc_service.config.schema import Config

if TYPE_CHECKING:
    from rti_mpc.wire.bus import BusSettings


recordings = typer.Typer()


@on_bus(recordings, with_model=False)
def record(
    config: Config,
    bus: BusSettings,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.mcap", help="New file to write; with a limit, a folder.", show_default="runs/ROBOT-TIME.mcap", callback=new_file),
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


@recordings.command()
def export(
    recording: Annotated[Path, typer.Argument(metavar="RUN.mcap", help="Recording, or the folder of its segments.")],
    parquet: Annotated[Path, typer.Option(metavar="DIR", help="New folder for a Parquet file a stream, in a folder a robot.", callback=new_folder)],
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


@recordings.command()
def replay(
    recording: RecordingPath,
    start: Annotated[str | None, typer.Option("--from", metavar="TIME", help="Time of the robot's clock from which on to replay.")] = None,
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
    from rti_mpc_service.replay.replay import main
    from rti_mpc_service.replay.robot_time import parse_time

    choice: dict[str, Any] = {"robot": robot, "owner": owner, "folder": folder, "trust": trust}
    choice |= {"tolerance": tolerance, "json_path": path, "make_body": lockstep_robot if closed_loop else None, "out": out}
    raise typer.Exit(main(recording, start_s=parse_time(start), assignments=assignments or (), **choice))


@on_bus(recordings, with_model=False)
def why(
    config: Config,
    bus: BusSettings,
    words: Annotated[list[str] | None, typer.Argument(metavar="RUN.mcap", help="Recording, in place of the running controller.")] = None,
    at: Annotated[str | None, typer.Option("--at", metavar="TIME", help="Time of the robot's clock, such as 72.5s.")] = None,
    seq: Annotated[int | None, typer.Option("--seq", metavar="NUMBER", help="Number of the command.", show_default="the last command")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    case: Annotated[
        Path | None,
        typer.Option(metavar="FILE.npz", help="Also write the sample's QP, a case for `rti-mpc solve-case`, to a new file.", callback=new_file),
    ] = None,
    robot: RecordedRobot = None,
    owner: Owner = None,
    folder: ModelFolder = Path(),
    trust: Trust = False,
) -> int:
    """Explain a command, recorded or just sent: who solved it, which bounds act, what its plan costs, and the events that led there."""
    from rti_mpc_service.replay import live
    from rti_mpc_service.replay.robot_time import parse_time
    from rti_mpc_service.replay.why import main

    choice: dict[str, Any] = {"owner": owner, "folder": folder, "trust": trust, "as_json": as_json, "case_path": case}
    if not words:
        if not (at is None and seq is None and robot is None):
            raise ConfigError("--at, --seq and --robot must come with a recording: a running controller is asked for its last command")
        return live.main(bus, config.keys(), **choice)
    if len(words) > 1:
        raise ConfigError(f"why explains a command of one recording, got {' '.join(words)}")
    return main(Path(words[0]), at_s=parse_time(at), seq=seq, robot=robot, **choice)


@recordings.command("solve-case")
def solve_case(
    case: Annotated[
        Path, typer.Argument(metavar="FILE", help="Case, FILE.npz of `rti-mpc why --case`; or recording, for all samples that failed or were late.")
    ],
    solver: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="riccati, osqp, or any of qpsolvers; repeatable.", show_default="riccati")
    ] = None,
    folder: ModelFolder = Path(),
    trust: Trust = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Solve the QP of a sample by any solver, and judge the plan that was made of it."""
    from rti_mpc_service.replay.solve import main

    raise typer.Exit(main(case, solver or ["riccati"], folder=folder, trust=trust, as_json=as_json))
