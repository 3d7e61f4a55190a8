# SPDX-License-Identifier: Apache-2.0
"""Robots that ship follow their own scenarios and come to rest, in lockstep, each as its file has it."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import Journal, JournalKind, Reference
from rti_mpc.contract.status import Mode
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.journal.book import Book
from rti_mpc.journal.replay import Replay, replay
from rti_mpc.model.find import SHIPPED_MODELS, find_model
from rti_mpc.model.model import Model
from rti_mpc.rti.rest import RestClass, assess
from rti_mpc.rti.rti import Rti
from rti_mpc_service.config.build import build_observer, build_ocp, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.fit import check_stop
from rti_mpc_service.config.schema import Config
from rti_mpc_service.rig.scenario import configured
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import ROBOTS
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import Run, drive
from tests.model.test_robots import derivative
from tests.slow import slow_but

# For how long each is driven, and within what of its reference its first two outputs are in the last quarter of that, in their units.
DRIVEN = {
    "pioneer_3dx": (20.0, 0.001),
    "boat": (20.0, 0.001),
    "cart_pole": (8.0, 0.1),
    "chain": (10.0, 0.005),
    "differential_drive": (15.0, 0.001),
    "dynamic_bicycle": (4.0, 0.005),
    "kinematic_bicycle": (5.0, 0.001),
    "omnidirectional": (5.0, 0.001),
    "quadrotor": (0.4, 0.005),
    "quadrotor_quaternion": (0.4, 0.005),
    "truck_trailer": (30.0, 0.005),
    "two_link_arm": (2.0, 0.001),
    "unicycle": (15.0, 0.005),
}


def test_every_robot_that_ships_has_a_file_and_is_driven_here() -> None:
    assert set(DRIVEN) == set(ROBOTS)
    assert all(load(path, with_model=False).model.name == name for name, path in ROBOTS.items())


def followed(name: str, duration_s: float) -> tuple[Config, Reference]:
    """Its configuration, its start included, and its reference, which goes on after that time."""
    config = load(ROBOTS[name])
    scenario = find_scenario(config, duration_s=duration_s + config.ocp.N * config.ocp.dt_s + 1.0)
    config = configured(config, scenario)
    y = scenario.y(np.array(robot_settings(config)["x0"]))
    return config, Reference(1, 1, 0, round(1e9 * scenario.period_s), scenario.end, y, np.zeros((len(y), 0)))


def controlled(name: str, duration_s: float, *, stoppable: bool = False) -> tuple[Controller, Lockstep, Reference]:
    """Its controller, its robot and its reference."""
    config, reference = followed(name, duration_s)
    rti = Rti(build_ocp(config), compile=False)
    law = check_stop(config) if stoppable else None
    controller = Controller(rti, Timing(), observer=build_observer(config), stop_law=law, compile=False)
    controller.receive_reference(reference)
    return controller, Lockstep(RobotSettings(**robot_settings(config))), reference


def errors(model: Model, run: Run, reference: Reference, from_s: float) -> Array:
    """Outputs less reference from a time on, angles within half a turn, shape ``(M, ny)``."""
    late = [i for i, t in enumerate(run.t_s) if t >= from_s]
    y = np.array([np.array(model.h()(run.x[i], model.p_nominal)).ravel() for i in late])
    rows = np.array([run.t_s[i] for i in late]) / (1e-9 * reference.period_ns)
    wanted = np.stack([np.interp(rows, np.arange(len(reference.y)), column) for column in reference.y.T], axis=-1)
    return model.rotations("outputs").difference(y, wanted)


@pytest.mark.parametrize("name", slow_but(ROBOTS, "cart_pole", "dynamic_bicycle", "two_link_arm", "unicycle"))
def test_robot_comes_to_its_reference(name: str) -> None:
    duration_s, tolerance = DRIVEN[name]
    controller, body, reference = controlled(name, duration_s)
    run = drive(controller, body, duration_s)
    assert controller.mode is Mode.TRACKING
    assert controller.ladder.fallbacks == 0
    error = errors(find_model(name), run, reference, 0.75 * duration_s)
    assert np.abs(error[:, :2]).max() < tolerance


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_journal_of_a_robot_is_replayed_with_no_differing_bit(name: str) -> None:
    controller, body, _ = controlled(name, 1.0, stoppable=True)
    book, messages = Book(controller), list[Journal]()
    for until_s in (0.4, 0.8, 1.2):
        book.photograph(0)
        messages += book.messages(0)
        drive(controller, body, until_s)
    messages += book.messages(0)
    assert not book.failure
    for start_seq in [message.seq for message in messages if message.kind is JournalKind.SNAPSHOT]:
        other, _, _ = controlled(name, 1.0, stoppable=True)
        on = Replay(other, other._rti)
        for _ in replay(on, messages, start_seq):
            pass
        assert on.outcome.samples > 0
        assert not on.outcome.differences, str(on.outcome.differences[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_robot_rests_as_it_says(name: str) -> None:
    config = load(ROBOTS[name])
    module = import_module(SHIPPED_MODELS[name].partition(":")[0])
    if config.model.stop == "coasts":
        assert module.REST == "coasts"
        return
    law = check_stop(config)
    assert assess(build_ocp(config), law, 50, compile=False).kind is RestClass(f"{module.REST} without feedback")


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_robot_that_is_stopped_comes_to_rest(name: str) -> None:
    """A pole that is let go hangs in the end, since its pivot has friction."""
    duration_s = min(4.0, DRIVEN[name][0])
    controller, body, _ = controlled(name, duration_s, stoppable=True)
    drive(controller, body, duration_s)
    model = find_model(name).with_parameters(**load(ROBOTS[name]).sim.parameters)
    moving = np.abs(derivative(model, body.x, body.u))
    controller.stop("by a test")
    drive(controller, body, duration_s + (60.0 if name == "cart_pole" else 12.0))
    assert controller.mode is Mode.STOPPED
    assert np.abs(derivative(model, body.x, body.u)).max() < 0.01 * moving.max()
