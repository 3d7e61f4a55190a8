# SPDX-License-Identifier: Apache-2.0
"""Headings that are wrong by about half a turn for a moment, as compasses and scan matching often give: the robot drives on as before."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import Reference, State
from rti_mpc.contract.status import Mode
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.observer import Disturbance, Observer, ObserverSettings
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.trajectory import Heading, Trajectory, circle, eight
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from tests.loop import drive, reference, robot
from tests.problems import PAPER, SLEW, pioneer
from tests.slow import slow_but

PATHS: dict[str, Heading] = {"circle": "tangent", "eight": "consistent"}
DURATION_S = 16.0
DISTURBANCES = {"u_c": Disturbance(drift=0.1, limit=0.3), "omega_c": Disturbance(drift=0.1, limit=0.3)}

pytestmark = pytest.mark.usefixtures("interpreted")


@pytest.fixture(scope="module")
def rti() -> Rti:
    """The shipped problem; each controller starts it cold."""
    return Rti(pioneer(N=20))


@pytest.fixture(scope="module")
def observed() -> tuple[Rti, ObserverSettings]:
    """The same, of a controller with an observer."""
    settings = ObserverSettings(DISTURBANCES)
    return Rti(Ocp(Observer(pioneer_3dx(), settings).model, **(PAPER | SLEW | {"N": 20}))), settings


@cache
def followed(path: str) -> tuple[Trajectory, Reference]:
    trajectory = {"circle": circle, "eight": eight}[path]()
    return trajectory, reference(trajectory, PATHS[path])


def errors_mm(controller: Controller, path: str, flip: float, at_s: float, samples: int, period_s: float = 0.1) -> tuple[Array, float]:
    """Tracking error of the plant at each state of `DURATION_S`, and its last heading; some states from a time on show another heading."""
    trajectory, message = followed(path)
    first = round(at_s / period_s)

    def seen(state: State) -> State:
        x = state.x.copy()
        x[2] += flip * (first <= state.seq % 100_000 - 1 < first + samples)
        return replace(state, x=x)

    body = robot(trajectory, state_period_s=period_s)
    controller.receive_reference(message)
    run = drive(controller, body, DURATION_S, sees=seen)
    assert controller.mode is Mode.TRACKING
    return run.error_mm(trajectory), float(run.x[-1][2])


@pytest.mark.parametrize("path", slow_but(PATHS, "eight"))
def test_one_wrong_heading_is_made_up_for_within_two_seconds(rti: Rti, path: str) -> None:
    """During the initial transient: the undisturbed error is 1 mm and falling."""
    undisturbed, heading = errors_mm(Controller(rti, Timing()), path, 0.0, 10.0, 0)
    for flip in (3.1, 3.3, -3.1, -3.3, 2 * np.pi, -2 * np.pi):
        error, ended = errors_mm(Controller(rti, Timing()), path, flip, 9.9, 1)
        after = slice(119, 130)  # from two seconds after it for one second
        assert np.all(error[after] < 2.0 * undisturbed[after]), flip
        assert ended == pytest.approx(heading, abs=0.01), flip


@pytest.mark.parametrize(
    ("path", "samples", "at_s"), slow_but([("circle", 2, 11.3), ("circle", 7, 6.0), ("eight", 2, 11.3), ("eight", 7, 6.0)], ("circle", 7, 6.0))
)
def test_robot_never_turns_round_itself_after_wrong_headings(rti: Rti, path: str, samples: int, at_s: float) -> None:
    _, heading = errors_mm(Controller(rti, Timing()), path, 0.0, at_s, 0)
    for flip in (3.1, 3.3, -3.1, -3.3):
        _, ended = errors_mm(Controller(rti, Timing()), path, flip, at_s, samples)
        assert ended == pytest.approx(heading, abs=0.1), flip


@pytest.mark.parametrize("flip", slow_but([3.1, 3.3, -3.1, -3.3], 3.1, -3.3))
def test_observer_forgets_a_wrong_heading_too(observed: tuple[Rti, ObserverSettings], flip: float) -> None:
    """Its estimate of the inputs' disturbances takes longer to recover than the heading."""
    rti, settings = observed
    observer = lambda: Observer(pioneer_3dx(), settings)  # noqa: E731
    _, heading = errors_mm(Controller(rti, Timing(), observer=observer()), "eight", 0.0, 9.9, 0)
    _, ended = errors_mm(Controller(rti, Timing(), observer=observer()), "eight", flip, 9.9, 1)
    assert ended == pytest.approx(heading, abs=0.1)


def test_wrong_headings_between_two_samples_leave_the_plan_in_its_turn(rti: Rti) -> None:
    """States come ten times as often as samples, and the wrong ones are over when the next sample is due."""
    undisturbed, heading = errors_mm(Controller(rti, Timing()), "eight", 0.0, 9.92, 0, period_s=0.01)
    for flip in (3.1, -3.1):
        error, ended = errors_mm(Controller(rti, Timing()), "eight", flip, 9.92, 3, period_s=0.01)
        assert ended == pytest.approx(heading, abs=1e-3), flip
        assert np.abs(error - undisturbed).max() < 0.05, flip  # mm: nothing of them was acted on
