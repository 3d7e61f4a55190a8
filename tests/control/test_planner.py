# SPDX-License-Identifier: Apache-2.0
"""Plan of one sample, as a controller asks for it."""

from __future__ import annotations

from unittest.mock import patch

from rti_mpc.control.controller import Controller, Timing
from rti_mpc.reference.trajectory import eight
from rti_mpc.rti.rti import Rti
from tests.loop import drive, reference, robot
from tests.problems import pioneer


def test_each_sample_looks_the_reference_up_once_a_cold_one_too() -> None:
    """A cold one is the longest of all, and is answered while the robot waits: it linearizes three times, about one reference."""
    controller, body = Controller(Rti(pioneer(), compile=False), Timing(), compile=False), robot(eight())
    controller.receive_reference(reference(eight()))
    with patch.object(controller._track, "look_up", wraps=controller._track.look_up) as looked_up:
        run = drive(controller, body, 0.3)
        assert len(run.commands) == 3
        assert looked_up.call_count == 1 + len(run.commands), "for the first command, and after each for the next one"
