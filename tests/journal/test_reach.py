# SPDX-License-Identifier: Apache-2.0
"""Reach of a controller: what a snapshot of it must hold."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.control.controller import Controller, Timing
from rti_mpc.journal.reach import NOT_STATE, attributes, held, memory, root
from rti_mpc.rti.rti import Rti
from tests.problems import pioneer


@pytest.fixture(scope="module")
def controller() -> Controller:
    return Controller(Rti(pioneer(N=3), compile=False), Timing(), compile=False)


def test_attributes_that_are_left_out_of_snapshots_are_attributes(controller: Controller) -> None:
    """One that was renamed would be left in."""
    parts = [controller, controller._planner, controller._modes]
    assert {(type(part).__name__, name) for part in parts for name, _ in attributes(part)} >= NOT_STATE


def test_array_that_compiled_code_is_bound_to_is_reached_from_the_call(controller: Controller) -> None:
    reached = {memory(root(array)) for array in held(controller._prediction._integrate)}
    assert memory(root(controller._prediction.x)) in reached


def test_view_of_an_array_is_known_by_the_array_that_owns_the_memory() -> None:
    whole = np.zeros((3, 2))
    assert root(whole[1:].T) is whole
    assert memory(whole[1:]) != memory(whole)
