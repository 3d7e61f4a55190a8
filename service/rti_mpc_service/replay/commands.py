# SPDX-License-Identifier: Apache-2.0
"""Command about cases; what solves them is imported when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

cases = typer.Typer()


@cases.command("solve-case")
def solve_case(
    case: Annotated[
        Path, typer.Argument(metavar="FILE", help="Case, FILE.npz of `rti-mpc why --case`; or recording, for all samples that failed or were late.")
    ],
    solver: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="riccati, osqp, or any of qpsolvers; repeatable.", show_default="riccati")
    ] = None,
    folder: Annotated[Path, typer.Option(metavar="DIR", help="Folder of a model of your own.", show_default="this folder")] = Path(),
    trust: Annotated[bool, typer.Option("--trust", help="Run the attached source of the model, which is code of whoever made the file.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Solve the QP of a sample by any solver, and judge the plan that was made of it."""
    from rti_mpc_service.replay.solve import main

    raise typer.Exit(main(case, solver or ["riccati"], folder=folder, trust=trust, as_json=as_json))
