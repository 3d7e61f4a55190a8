# SPDX-License-Identifier: Apache-2.0
"""Commands of `rti-mpc certs`; what signs is imported when one runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rti_mpc_service.certs.roles import ROLES
from rti_mpc_service.commands.group import Commands
from rti_mpc_service.config.config import load

certs = typer.Typer(cls=Commands, help="Make an authority and certificates for the processes of a robot.", no_args_is_help=True)

AuthorityPath = Annotated[Path, typer.Option("--authority", metavar="DIR", help="Folder of the authority.")]
Days = Annotated[float, typer.Option("--days", min=0.01, max=36_500.0, help="Time for which certificates are valid.")]


@certs.command("authority")
def certs_authority(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to write, on a computer that is no robot.")] = Path("authority"),
    days: Days = 3650.0,
) -> None:
    """Make an authority: its private key signs all certificates, and stays where it is."""
    from rti_mpc_service.certs.issue import make_authority

    for path in make_authority(folder, days):
        typer.echo(path)


@certs.command("issue")
def certs_issue(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="The robot's TOML file.")],
    roles: Annotated[list[str], typer.Argument(metavar="ROLE", help=f"Roles that run on the host: {', '.join(ROLES)}.")],
    router: Annotated[str, typer.Option(metavar="ENDPOINT", help="Endpoint of the robot's router, such as tls/robot.local:7447.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write: the bundle of one host.")],
    authority: AuthorityPath = Path("authority"),
    days: Days = 90.0,
    at: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder of the bundle on its host, for programs that read Zenoh's configuration by themselves.")
    ] = Path("/etc/rti-mpc/tls"),
) -> None:
    """Make the bundle of one host: certificates, private keys and Zenoh's configurations of its roles; the router's has the access control list."""
    from rti_mpc_service.certs.authority import Authority
    from rti_mpc_service.certs.issue import issue

    for path in issue(Authority.read(authority), load(config, with_model=False).keys(), roles, router, out, at, days):
        typer.echo(path)


@certs.command("renew")
def certs_renew(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Folders with certificates; private keys need not be there.")],
    authority: AuthorityPath = Path("authority"),
    days: Days = 90.0,
) -> None:
    """Renew all certificates in folders; names and private keys stay."""
    from rti_mpc_service.certs.authority import Authority
    from rti_mpc_service.certs.issue import renew

    signer = Authority.read(authority)
    for path in (path for folder in folders for path in renew(signer, folder, days)):
        typer.echo(path)


@certs.command("show")
def certs_show(folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Folders with certificates.")]) -> None:
    """Print until when certificates are valid; the status is 1 if one ends within 30 days, or does not fit its key, authority or role."""
    from rti_mpc_service.certs.issue import shown

    lines = [line for folder in folders for line in shown(folder)]
    for text, _ in lines:
        typer.echo(text)
    raise typer.Exit(int(any(to_do for _, to_do in lines)))
