# SPDX-License-Identifier: Apache-2.0
"""
Command line. All physical settings are in the configuration file.

A command imports its modules when it runs, so that `rti-mpc --help` loads no solver,
no bus and no viewer.
"""

from __future__ import annotations

import platform
from typing import Annotated, NoReturn

import typer

import rti_mpc
from rti_mpc_service import entry, log
from rti_mpc_service.commands.certs import certs
from rti_mpc_service.commands.drives import drives
from rti_mpc_service.commands.group import Commands
from rti_mpc_service.commands.operator import operator
from rti_mpc_service.commands.processes import processes
from rti_mpc_service.commands.recordings import recordings
from rti_mpc_service.commands.robot import robot
from rti_mpc_service.commands.setup import setup
from rti_mpc_service.commands.studies import studies

app = typer.Typer(
    cls=Commands,
    help="Real-time nonlinear model predictive control as a service, over Zenoh.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for group in (drives, processes, robot, operator, recordings, studies, setup):
    app.add_typer(group)
app.add_typer(certs, name="certs")


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


def main() -> NoReturn:
    """Run the command line; bad input is refused in one line, with exit status 2."""
    entry.enter(log.start, app)


if __name__ == "__main__":
    main()
