# SPDX-License-Identifier: Apache-2.0
"""Commands that run on the bus: they take CONFIG and Zenoh's options besides their own."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from rti_mpc_service.certs.folder import credentials, secured
from rti_mpc_service.commands.arguments import ConfigPath
from rti_mpc_service.config.build import bus_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.shipped import SHIPPED


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


def on_bus(group: typer.Typer, *, with_model: bool = True) -> Callable[[Callable[..., int | None]], Callable[..., None]]:
    """
    Register a command: it takes the configuration, the settings of the bus and its own options, and returns an exit status, None for 0.

    If it takes `words`, CONFIG is the first TOML file among them; if it takes `path`, it is told which file CONFIG is.

    Args:
        group: Commands that it belongs to.
        with_model: Whether the configuration is checked against the model.
    """
    return partial(register, group, with_model)


def register(group: typer.Typer, with_model: bool, command: Callable[..., int | None]) -> Callable[..., None]:
    """Give a command its argument CONFIG and Zenoh's options, and register it."""
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
    return group.command()(run)
