# SPDX-License-Identifier: Apache-2.0
"""Simulated robot: as a process on the bus, and in lockstep for commands that advance it themselves. Nothing else imports the simulation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rti_mpc_service.commands.arguments import new_file
from rti_mpc_service.commands.on_bus import on_bus
from rti_mpc_service.config.build import operating_rates, robot_settings, with_initial_state
from rti_mpc_service.config.schema import Config

if TYPE_CHECKING:
    from rti_mpc.wire.bus import BusSettings


robot = typer.Typer()


@on_bus(robot)
def sim(
    config: Config,
    bus: BusSettings,
    speed: Annotated[float, typer.Option(min=0.01, max=100.0, help="Simulated seconds per second of real time.")] = 1.0,
    x0: Annotated[list[str] | None, typer.Option(metavar="NAME=VALUE", help="Initial state, instead of the configuration's; repeatable.")] = None,
    duration: Annotated[float | None, typer.Option(metavar="SECONDS", min=0.0, help="Stop after this robot time.")] = None,
    log: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="New file for each state with its input and the time of its answer.", callback=new_file)
    ] = None,
) -> None:
    """Simulate the robot: a plant with its own parameters, which stops when it receives no valid commands."""
    from rti_mpc_sim.robot import main
    from rti_mpc_sim.settings import RobotSettings

    listen = bus.listen or config.bus.listen or (bus.connect if bus.mode == "peer" and bus.config is None else ())
    settings = RobotSettings(**robot_settings(with_initial_state(config, x0 or [])), rates=operating_rates(config))
    main(settings, replace(bus, listen=listen), config.keys(), speed=speed, log=log, duration_s=duration, guarded=config.guard.enabled)


def lockstep_robot(settings: dict[str, Any], epoch: int = 1, now_ns: int = 0) -> Any:
    """Make a simulated robot that its caller advances, from a time on. Other processes find this function by its name."""
    from rti_mpc_sim.lockstep import Lockstep
    from rti_mpc_sim.settings import RobotSettings

    return Lockstep(RobotSettings(**settings), epoch, now_ns)
