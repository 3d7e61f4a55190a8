# SPDX-License-Identifier: Apache-2.0
"""Arguments and options that several commands have."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from rti_mpc.errors import ConfigError
from rti_mpc_service.shipped import SHIPPED, robot_file


def new_file(param: typer.CallbackParam, path: Path | None) -> Path | None:
    """
    Check that a command would overwrite nothing, before it does anything: a device or a pipe may be there.

    Raises:
        ConfigError: A file or folder exists there.
    """
    if path is not None and (os.path.isfile(path) or os.path.isdir(path)):  # false also for a name that cannot be: writing tells
        raise ConfigError(f"{param.opts[0]} must not overwrite a file, got {path}, which exists")
    return path


def new_folder(param: typer.CallbackParam, path: Path | None) -> Path | None:
    """
    Check that a command would overwrite nothing, and mix nothing with what is older, before it does anything.

    Raises:
        ConfigError: The folder holds something, or is a file.
    """
    try:
        held = None if path is None else next(path.iterdir(), None)
    except FileNotFoundError:
        return path
    except OSError as error:
        raise ConfigError(f"{param.opts[0]} must be a folder that can be written, got {path}: {error.strerror}") from error
    if held is not None:
        raise ConfigError(f"{param.opts[0]} must be a folder that is new or empty, got {path} with {held.name}")
    return path


def claimed(path: Path | None) -> Path | None:
    """
    Check that a file can be written, before its content is computed for minutes; scripts ask for it again and again, so it is replaced.

    Raises:
        ConfigError: It cannot; none is left behind that was not there before.
    """
    try:
        if path is not None and (path.is_file() or path.is_dir() or not path.exists()):  # a pipe is opened once, by whoever writes
            new = not path.exists()
            path.open("ab").close()
            if new:
                path.resolve().unlink()  # not a link to it
    except OSError as error:
        raise ConfigError(f"--json must be a file that can be written, got {path}: {error.strerror}") from error
    return path


def folder_of_run(text: str, name: str, check: Callable[..., Path | None]) -> Any:
    """Return the option of a folder for what a command writes, by default below `runs`, by name and time."""
    return typer.Option(metavar="DIR", help=text, show_default=f"runs/{name}-TIME", callback=check)


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
PathName = Annotated[
    str | None,
    typer.Option("--path", metavar="FILE.csv", help="Path for a robot that follows one, in place of a scenario: a file, or a track that ships."),
]
PathLimits = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option(
        metavar="V LATERAL ACCELERATION BRAKING", help="Limits of the speed along it, in m/s and m/s^2.", show_default="the speeds of the file"
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
