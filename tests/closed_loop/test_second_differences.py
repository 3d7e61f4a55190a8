# SPDX-License-Identifier: Apache-2.0
"""Bounds on second differences in lockstep: what the robot does obeys them from command to command, with a delay and with states lost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import State
from rti_mpc.contract.status import Mode
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.reference.trajectory import eight
from rti_mpc.rti.rti import Rti
from tests.loop import Run, drive, reference, robot
from tests.problems import pioneer
from tests.slow import slow_but

BEND = np.array([0.05, 0.1])  # m/s and rad/s per 0.1 s squared; slew limits are 0.25 and 0.4
BENDS: dict[str, Any] = {"lbddu": -BEND, "ubddu": BEND}
ROUNDING = 1e-7
LOST = (20, 45)  # states on their way, by number; after two in a row the plan has expired, and the robot begins to come to rest


def driven(bounds: dict[str, Any], delay_s: float, **changes: Any) -> tuple[Run, Controller]:
    """Ten seconds of the eight from 0.5 m beside it."""
    controller = Controller(Rti(pioneer(**bounds, **changes), compile=False), Timing(delay_s=delay_s), compile=False)
    controller.receive_reference(reference(eight()))
    states = iter(range(10_000))

    def sees(state: State) -> State | None:
        return None if next(states) in LOST else state

    return drive(controller, robot(eight()), 10.0, latency_s=min(delay_s, 0.1), sees=sees), controller


def bends(run: Run) -> Array:
    """The largest second difference of each input that has acted, from one period to the next."""
    return np.asarray(np.abs(np.diff(run.u, 2, axis=0)).max(axis=0))


@pytest.mark.parametrize("delay_s", slow_but([0.0, 0.17], 0.17))
def test_inputs_that_act_bend_within_their_limits_which_they_exceed_without(delay_s: float) -> None:
    bounded, controller = driven(BENDS, delay_s)
    free, _ = driven({}, delay_s)
    assert controller.grid.skipped == len(LOST)
    assert {command.mode for command in bounded.commands} == {Mode.TRACKING}
    assert np.all(bends(bounded) <= BEND + ROUNDING)
    assert np.all(bends(bounded) >= BEND - ROUNDING), "the limits act"
    assert np.all(bends(free) > 3 * BEND)
    assert bounded.error_mm(eight())[50:].max() < 1.2 * free.error_mm(eight())[50:].max()


def test_held_inputs_bend_within_their_limits_too() -> None:
    """The control horizon is as long as it takes to bend from the fastest rise to a bound, 5 stages."""
    assert np.all(bends(driven(BENDS, 0.0, N=12, N_u=8)[0]) <= BEND + ROUNDING)


def test_ramp_to_rest_keeps_the_slew_limits_not_the_second_differences() -> None:
    """Without states the robot is brought to rest as fast as slew limits allow: comfort ends where safety begins."""
    body, controller = robot(eight()), Controller(Rti(pioneer(**BENDS), compile=False), Timing(), compile=False)
    controller.receive_reference(reference(eight()))
    run = drive(controller, body, 5.0)
    silent = drive(controller, body, 8.0, sees=lambda _: None)
    assert np.all(bends(run) <= BEND + ROUNDING)
    u = np.array(silent.u)
    np.testing.assert_array_equal(u[-1], np.zeros(2))
    assert np.all(np.abs(np.diff(u, axis=0)) <= np.array([0.25, 0.4]) * (1 + 1e-9))
    assert np.any(bends(silent) > 2 * BEND)
