# SPDX-License-Identifier: Apache-2.0
"""Robots that ship, in a table."""

from __future__ import annotations

from importlib import import_module

from rich.table import Table

from rti_mpc.model.find import SHIPPED_MODELS
from rti_mpc_service.config.build import build_model
from rti_mpc_service.config.config import load
from rti_mpc_service.console import plain_console, widened
from rti_mpc_service.shipped import DEPLOY, ROBOTS


def main() -> None:
    """Print name, size, period and horizon of each robot, what it does at rest, and where its parameters are from."""
    table = Table(box=None, padding=(0, 2, 0, 0))
    for heading in ("robot", "states", "inputs", "dt", "N", "at rest", "scenario", "parameters"):
        table.add_column(heading, justify="right" if heading in ("states", "inputs", "dt", "N") else "left")
    for name, path in ROBOTS.items():
        config = load(path, with_model=False)
        model, module = build_model(config), import_module(SHIPPED_MODELS[name].partition(":")[0])
        sizes = str(model.nx), str(model.nu), f"{1e3 * config.ocp.dt_s:g} ms", str(config.ocp.N)
        table.add_row(name, *sizes, module.REST, config.reference.scenario or "eight", module.SOURCE)
    console = widened(plain_console())
    console.print(table)
    console.print(f"rti-mpc demo --robot NAME drives one. Their files are in {DEPLOY / 'robots'}", soft_wrap=True, highlight=False)
