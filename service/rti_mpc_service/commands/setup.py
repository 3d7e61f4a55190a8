# SPDX-License-Identifier: Apache-2.0
"""Set-up of a robot of one's own, and examination of its file and of the host."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from rti_mpc_service.commands.arguments import ConfigPath, JsonPath, RobotName, StatePath, file_of
from rti_mpc_service.config.schema import Config
from rti_mpc_service.shipped import SHIPPED

setup = typer.Typer()


@setup.command()
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


@setup.command()
def robots() -> None:
    """List the robots that ship: size, period, horizon, what they do at rest, and where their parameters are from."""
    from rti_mpc_service.robots import main

    main()


@setup.command()
def schema() -> None:
    """Print the JSON schema of a robot's TOML file, with which editors complete and check it."""
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    typer.echo(json.dumps(head | Config.model_json_schema() | {"title": "rti-mpc robot"}, indent=1))


@setup.command()
def check(config: ConfigPath = SHIPPED, robot: RobotName = None) -> None:
    """Check a configuration: solve 200 samples, print the times of both phases, and compare with a second solver."""
    from rti_mpc_service.check.check import main

    raise typer.Exit(main(file_of(config, robot)))


@setup.command()
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
