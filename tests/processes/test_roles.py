# SPDX-License-Identifier: Apache-2.0
"""The reference source, for robots with unusual orders of signals: rows come in the order of the outputs."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Reference, State
from rti_mpc.reference.trajectory import eight, rows
from rti_mpc.signals import Role
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.cdr import decode
from rti_mpc_service.config.build import build_model
from rti_mpc_service.config.config import load
from tests.processes.system import System, until
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
    nx = build_model(load(path)).nx
    with System(tmp_path, path, reference=SOURCE) as system, Bus.join(BusSettings(listen=(system.endpoint,), connect=()), system.keys) as robot:
        states, references, seqs = robot.publisher(system.keys.state), robot.subscriber(system.keys.reference), itertools.count(1)
        system.start("reference")

        def sent() -> Reference | None:
            seq = next(seqs)
            states.put(State(1, seq, seq, np.zeros(nx)))  # a standing robot
            received = references.try_recv()
            return None if received is None else decode(Reference, received.payload)

        reference = until(sent, "a reference", pause_s=0.02)
    np.testing.assert_array_equal(reference.y, rows(eight().lasting(20.0), PERIOD_S, "consistent", a, roles=roles))
