# SPDX-License-Identifier: Apache-2.0
"""A boat in a current that its model does not know, in lockstep: its observer estimates it, and a stop balances it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import End, Reference, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.observer import Disturbance, Observer, ObserverSettings
from rti_mpc.errors import OcpError
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rest import RestClass, assess, find_stop_law
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.way_to_rest import StopLaw
from rti_mpc_service.faults.system import steady
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, Run, drive
from tests.movers import boat, carried, floating

STILL = 1e-3  # m/s
CURRENT = np.array([0.2, -0.15])  # m/s
MOST = np.array([0.5, 0.5])  # of what is estimated
SETTINGS = ObserverSettings({name: Disturbance(drift=0.02, limit=0.5) for name in ("x", "y")})
LAW = StopLaw(  # as it is found, in seconds
    rows=102,
    horizon=100,
    period_s=0.1,
    substeps=1,
    input_weight=0.01,
    rates=np.array([1.7, 2.5, 1.0, 2.8, 0.5, 2.25]),
    scale_x=np.array([1.0, 1.0, 1.0, 2.0, 0.5, 1.0]),
    scale_u=np.array([60.0, 10.0]),
    disturbances=MOST,
)


@cache
def problem() -> Ocp:
    """With what its observer estimates among its parameters."""
    return floating(model=Observer(carried(boat().model), SETTINGS, compile=False).model)


def afloat(law: StopLaw | None, speed: float, noise: float = 0.0) -> tuple[Controller, Lockstep]:
    """A controller that follows a line, and a boat in a current."""
    observer = Observer(carried(boat().model), SETTINGS, compile=False)
    controller = Controller(Rti(problem(), compile=False), Timing(), observer=observer, stop_law=law, compile=False)
    t = 0.1 * np.arange(400)
    y = np.outer(t, [0.8, 0, 0, 0, 0, 0]) + np.array([0, 0, 0, 0.8, 0, 0])
    controller.receive_reference(Reference(1, 1, 0, 100 * MS, End.HOLD, y, np.zeros((len(y), 0))))
    plant = carried(boat().model).with_parameters(c_x=CURRENT[0], c_y=CURRENT[1])
    return controller, Lockstep(RobotSettings(plant, np.array([0, 0, 0, speed, 0, 0]), state_period_s=0.1, noise_std=np.full(6, noise)))


def test_way_to_rest_turns_to_the_nearer_of_bow_and_stern_wherever_the_path_has_turned_to() -> None:
    controller, body = afloat(LAW, 0.8)
    t = 0.1 * np.arange(600)
    heading = t / 8.0
    y = np.column_stack([4 * np.sin(heading), 4 - 4 * np.cos(heading), heading, 0.5 + 0 * t, 0 * t, 0.125 + 0 * t])
    controller.receive_reference(Reference(2, 1, 0, 100 * MS, End.HOLD, y, np.zeros((len(y), 0))))
    run = drive(controller, body, 50.0)
    assert controller.mode is Mode.TRACKING
    turned = [abs(command.x_rest[-1, 2] - command.x_rest[0, 2]) for command in run.commands[50:]]
    assert max(turned) < 2.2, "rad: a quarter turn, and what it turns at the plan's end and swings back"


def ground_speed(run: Run) -> float:
    """Of the last period, m/s."""
    here, before = run.x[-1][:2], run.x[-2][:2]
    return float(np.hypot(*(here - before)) / 0.1)


def turn(body: Lockstep, angle: float) -> Array:
    """Let the current turn."""
    c, s = np.cos(angle), np.sin(angle)
    water: Array = body._plant._p
    water[:] = np.array([[c, -s], [s, c]]) @ water
    return water


def test_boat_is_brought_to_rest_in_a_current_and_stays_there() -> None:
    controller, body = afloat(LAW, 0.8)
    run = drive(controller, body, 4.0)
    assert controller.mode is Mode.TRACKING
    assert ground_speed(run) > 0.5
    controller.stop("by a test")
    drive(controller, body, 16.0, run=run)
    assert controller.mode is Mode.STOPPED
    assert ground_speed(run) < STILL
    assert controller.at_rest
    assert abs(body.u[0]) == pytest.approx(40 * np.hypot(*CURRENT), rel=1e-3), "its drag in the water that passes it"
    where = body.x.copy()
    drive(controller, body, 26.0, run=run)
    assert np.hypot(*(body.x - where)[:2]) < STILL


def test_boat_whose_disturbances_are_taken_to_end_at_rest_is_carried_away() -> None:
    """As slip and friction do: inputs that command speeds are brought to zero, whatever is estimated."""
    assert find_stop_law(problem()) is None
    controller, body = afloat(None, 0.8)
    run = drive(controller, body, 4.0)
    controller.stop("by a test")
    drive(controller, body, 16.0, run=run)
    assert not body.u.any()
    assert ground_speed(run) == pytest.approx(np.hypot(*CURRENT), abs=STILL)


def test_last_command_keeps_the_boat_at_rest_in_the_current_it_was_made_in() -> None:
    controller, body = afloat(LAW, 0.8)
    run = drive(controller, body, 4.0)
    for _ in range(150):
        body.tick()
    where = body.x.copy()
    for _ in range(50):
        body.tick()
    assert np.hypot(*(body.x - where)[:2]) < STILL
    assert len(run.commands[-1].K) == 2


def test_last_command_brings_a_boat_back_that_was_pushed_off_its_way_and_it_stands_soon() -> None:
    """Sideways by leaning out of the current, as nothing else moves it there."""
    controller, body = afloat(LAW, 0.8)
    drive(controller, body, 4.0)
    for _ in range(150):
        body.tick()
    water = CURRENT / np.hypot(*CURRENT)
    where = body.x[:2].copy()
    body._plant.x[:2] += 0.03 * np.array([-water[1], water[0]])
    for _ in range(100):
        body.tick()
    here = body.x[:2].copy()
    body.tick()
    assert np.hypot(*(here - where)) < 3e-3, "m: a tenth of it"
    assert np.hypot(*(body.x[:2] - here)) / 0.1 < STILL


@pytest.mark.parametrize("known", [False, True])
def test_last_command_leads_to_rest_once_the_estimate_is_steady_and_not_before(known: bool) -> None:
    """For which `rti-mpc faults` waits."""
    controller, body = afloat(LAW, 0.0)
    samples: list[Telemetry] = []
    while len(samples) < (40 if known else 1) and not steady(samples, MOST):
        drive(controller, body, 1e-9 * body.now_ns + 0.1)
        samples.append(controller.telemetry(prepare_us=0.0, feedback_us=0.0, latency_us=0.0, slack_s=0.0))
    assert steady(samples, MOST) == known
    for _ in range(120):
        body.tick()
    where = body.x.copy()
    body.tick()
    assert (np.hypot(*(body.x - where)[:2]) / 0.1 < STILL) == known


@pytest.mark.slow
def test_stopped_boat_turns_with_a_current_that_is_another_one() -> None:
    """It was latched before it was driven, so nothing of the current was known when its way to rest began."""
    controller, body = afloat(LAW, 0.0)
    controller.stop("by a test")
    run = drive(controller, body, 10.0)
    assert controller.mode is Mode.STOPPED
    assert ground_speed(run) < STILL
    for angle in (np.pi / 3, np.pi):
        water = turn(body, angle)
        drive(controller, body, 1e-9 * body.now_ns + 12.0, run=run)
        assert ground_speed(run) < STILL
        aside = np.cos(body.x[2]) * water[1] - np.sin(body.x[2]) * water[0]
        assert abs(aside) < STILL, "its bow or its stern is against the current"


@pytest.mark.slow
def test_boat_whose_states_are_noisy_stays_within_what_the_noise_moves_it() -> None:
    controller, body = afloat(LAW, 0.8, noise=1e-3)
    run = drive(controller, body, 4.0)
    controller.stop("by a test")
    drive(controller, body, 20.0, run=run)
    where = body.x.copy()
    drive(controller, body, 30.0, run=run)
    assert np.hypot(*(body.x - where)[:2]) < 0.05


@pytest.mark.slow
def test_law_is_found_for_all_currents_and_a_boat_in_one_drifts() -> None:
    law = find_stop_law(problem(), MOST)
    assert law is not None
    assert law.rows * law.period_s <= 20.0
    rest = assess(problem(), law, 100, compile=False)
    assert rest.kind is RestClass.DRIFTS
    assert rest.time_s < 12.0


@pytest.mark.slow
def test_current_that_its_inputs_cannot_balance_is_refused_by_name() -> None:
    with pytest.raises(OcpError, match=r"d_x = -?2 m/s, d_y = -?2 m/s it still moves: x, y"):
        find_stop_law(problem(), np.array([2.0, 2.0]))
