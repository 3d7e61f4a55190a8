# SPDX-License-Identifier: Apache-2.0
"""Requests to the processes of a robot, and the table of all robots."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rti_mpc_service.commands.arguments import StatePath, Timeout
from rti_mpc_service.commands.on_bus import on_bus
from rti_mpc_service.config.schema import Config
from rti_mpc_service.shipped import SHIPPED

if TYPE_CHECKING:
    from rti_mpc.wire.bus import BusSettings


operator = typer.Typer()


@on_bus(operator, with_model=False)
def stop(config: Config, bus: BusSettings, timeout: Timeout = 2.0, state: StatePath = None) -> int:
    """Stop the robot; it stays stopped across every restart until `enable`."""
    from rti_mpc_service.request import stop_or_enable

    return stop_or_enable(bus, config.keys(), "stop", timeout, guarded=config.guard.enabled, state=state)


@on_bus(operator, with_model=False)
def enable(config: Config, bus: BusSettings, timeout: Timeout = 2.0, state: StatePath = None) -> int:
    """Release a robot that was stopped by `stop`."""
    from rti_mpc_service.request import stop_or_enable

    return stop_or_enable(bus, config.keys(), "enable", timeout, guarded=config.guard.enabled, state=state)


@on_bus(operator, with_model=False)
def status(
    config: Config,
    bus: BusSettings,
    path: Path,
    once: Annotated[bool, typer.Option("--once", help="Print the table once; without a terminal it always is.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, once, for scripts.")] = False,
    timeout: Timeout = 3.0,
) -> int:
    """Show all robots on the bus: mode, error, ages, times, who leads, whether the solvers agree, versions, the last event."""
    from rti_mpc_service.status.status import main

    return main(bus, config.keys(), named=path != SHIPPED, once=once, as_json=as_json, timeout_s=timeout)


@on_bus(operator, with_model=False)
def params(
    config: Config,
    bus: BusSettings,
    words: Annotated[list[str] | None, typer.Argument(metavar="get [KEY]... | set KEY=VALUE...", help="Keys and values as in the file.")] = None,
    timeout: Timeout = 2.0,
) -> int:
    """Print parameters of the running controller, or change them, all or none, between two samples."""
    from rti_mpc_service.request import params

    return params(bus, config.keys(), words or ["get"], timeout)


@on_bus(operator, with_model=False)
def snapshot(config: Config, bus: BusSettings, timeout: Timeout = 2.0) -> int:
    """Ask the leading controller for a snapshot, from which a replay of its recording can begin."""
    from rti_mpc_service.request import main

    return main(bus, config.keys(), "snapshot", timeout)
