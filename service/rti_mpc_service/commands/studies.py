# SPDX-License-Identifier: Apache-2.0
"""Studies without a bus: computing times, the paper, tuning."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

import typer

from rti_mpc.errors import ConfigError
from rti_mpc_service.commands.arguments import (
    ConfigPath,
    JsonPath,
    RobotName,
    ScenarioName,
    WaypointSmoothing,
    WaypointSpeed,
    file_of,
    folder_of_run,
    new_file,
    new_folder,
)
from rti_mpc_service.commands.robot import lockstep_robot
from rti_mpc_service.shipped import SHIPPED

studies = typer.Typer()


def known_keys(vary: list[str] | None) -> list[str] | None:
    """Check what is to be varied, before the robot's file and all that drives it are loaded."""
    from rti_mpc_service.tune.varied import asked_for

    for text in vary or ():
        asked_for(text)
    return vary


def new_paper(param: typer.CallbackParam, out: Path | None) -> Path | None:
    """Check that a folder has no paper yet, see `new_file`."""
    if out is not None:
        new_file(param, out / "paper.md")
        new_folder(param, out / "paper")
    return out


@studies.command()
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
        if interpreted or costs:
            raise ConfigError("--interpreted and --costs must be left out with --problem, which always compiles and compares costs")
        from rti_mpc_service.bench import family_bench

        raise typer.Exit(family_bench.main(problem, horizon or (), solver or family_bench.DEFAULT_SOLVERS, quick=quick, path=path))
    from rti_mpc_service.bench.bench import DEFAULT_HORIZONS, main

    horizons, solvers = tuple(horizon or DEFAULT_HORIZONS), tuple(solver or ())
    raise typer.Exit(main(horizons, solvers=solvers, interpreted=interpreted, quick=quick, costs=costs, path=path))


@studies.command()
def paper(
    out: Annotated[Path | None, folder_of_run("Folder for paper.md and its folder of figures and run.json.", "paper", new_paper)] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A short run: three seconds of every experiment, few points of each sweep.")] = False,
) -> None:
    """Reproduce the paper's study: its algorithms, real-time iteration and converged NMPC, and the effect of each setting."""
    from rti_mpc_service.paper.study import main

    raise typer.Exit(main(out, quick=quick))


@studies.command()
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
            callback=known_keys,
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
        Path | None, typer.Option(metavar="FILE.toml", help="New file to write; figure and study go beside it.", show_default="CONFIG.tuned.toml")
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
