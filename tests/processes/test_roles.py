# SPDX-License-Identifier: Apache-2.0
"""The reference source, for robots with unusual orders of signals: rows come in the order of the outputs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Reference
from rti_mpc.reference.trajectory import eight, rows
from rti_mpc.signals import Role
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc_service.config.config import load
from tests.processes.system import System, heard
from tests.robots import toml

SOURCE = ("reference", "--scenario", "eight", "--duration", 20)
PERIOD_S = 0.05  # of the rows that the source sends


@pytest.mark.parametrize(
    ("name", "roles", "a"),
    [
        ("shuffled", ("heading", "x", "y"), 0.2),
        ("glider", ("x", "y"), None),
        pytest.param("rover", ("x", "y", "heading"), None, marks=pytest.mark.slow),
    ],
)
def test_reference_has_a_column_for_each_output_by_its_role(name: str, roles: tuple[Role, ...], a: float | None, tmp_path: Path) -> None:
    """The glider's parameter is called `a`, and is negative: taken for the axle's offset it would be refused."""
    path = tmp_path / "robot.toml"
    path.write_text(toml(name))
    with (
        System(tmp_path, path, robot=("sim",), reference=SOURCE) as system,
        Bus.join(BusSettings(connect=(system.endpoint,)), load(path).keys()) as bus,
    ):
        references = bus.subscriber(bus.keys.reference, capacity=4)
        system.start("robot", "reference")
        sent = heard(references, Reference, lambda _: True)
    np.testing.assert_array_equal(sent.y, rows(eight().lasting(20.0), PERIOD_S, "consistent", a, roles=roles))
