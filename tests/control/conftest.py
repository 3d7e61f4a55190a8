# SPDX-License-Identifier: Apache-2.0
"""A controller, and a robot that follows the circle."""

from __future__ import annotations

import pytest

from rti_mpc.control.controller import Controller, Timing
from rti_mpc.reference.trajectory import circle
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import Rti
from rti_mpc_sim.lockstep import Lockstep
from tests.loop import drive, reference, robot
from tests.problems import pioneer


@pytest.fixture(scope="module")
def rti() -> Rti:
    """One for all: a controller's first sample starts cold, whatever came before. No weight on headings: then the circle can be followed exactly."""
    return Rti(pioneer(N=12, Q=[1.0, 1.0, 0.0]), SolverSettings(eps=1e-6, max_iter=4000), compile=False)


@pytest.fixture
def controller(rti: Rti) -> Controller:
    return Controller(rti, Timing(), compile=False)


@pytest.fixture
def on_the_circle(controller: Controller) -> tuple[Controller, Lockstep]:
    """A robot that has followed the circle for 15 s."""
    body = robot(circle())
    controller.receive_reference(reference(circle()))
    drive(controller, body, 15.0)
    return controller, body
