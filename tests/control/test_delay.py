# SPDX-License-Identifier: Apache-2.0
"""The delay, measured and compensated: against a robot whose delay is known."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from rti_mpc.contract.message import Command
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.delay import DelayEstimator
from rti_mpc.control.grid import DELAY_MARGIN_PERIODS, DELAY_SLEW_SAMPLES, MAX_DELAY_PERIODS, Grid
from rti_mpc.control.observer import Disturbance, Observer, ObserverSettings
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.trajectory import eight
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.actuator import Actuator
from tests.loop import MS, SLEW, Run, drive, reference, robot
from tests.problems import PAPER, double_integrator, pioneer
from tests.problems import SLEW as INCREMENTS
from tests.slow import slow_but

DT = 100 * MS
NOISE = np.array([1e-3, 1e-3, 2e-3, 5e-3, 5e-3])


@pytest.fixture(scope="module")
def rti() -> Rti:
    return Rti(pioneer(N=12, Q=[1.0, 1.0, 0.0]), compile=False)


def driven(rti: Rti, delay_s: float | None, actuator_delay_s: float, noise: float = 0.0, duration_s: float = 40.0) -> tuple[Controller, Run]:
    controller = Controller(rti, Timing(delay_s=delay_s), compile=False)
    body = robot(eight(), actuator_delay_s=actuator_delay_s, noise_std=noise * NOISE, seed=3)
    controller.receive_reference(reference(eight().lasting(duration_s + 5.0)))
    return controller, drive(controller, body, duration_s)


def error_mm(run: Run) -> float:
    return float(run.error_mm(eight())[np.array(run.t_s) > 20.0].max())


@pytest.mark.parametrize(
    ("delay_s", "noise"),
    slow_but([(0.2, 0.0), (None, 0.0), (None, 1.0)], (0.2, 0.0), (None, 1.0)),
    ids=["configured", "measured", "measured with noise"],
)
def test_delay_of_two_periods_costs_less_than_twice_the_error_without_delay(rti: Rti, delay_s: float | None, noise: float) -> None:
    undelayed = error_mm(driven(rti, 0.0, 0.0, noise)[1])
    assert error_mm(driven(rti, delay_s, 0.2, noise)[1]) <= 2.0 * undelayed
    if not noise:
        assert error_mm(driven(rti, 0.0, 0.2)[1]) > 10.0 * undelayed  # what it is without compensation


@pytest.mark.parametrize("actuator_delay_s", slow_but([0.0, 0.05, 0.13, 0.2], 0.0, 0.13))
def test_delay_is_found_from_the_response(rti: Rti, actuator_delay_s: float) -> None:
    """Within half a candidate's step, in ten seconds; what is added to it covers that."""
    controller, _ = driven(rti, None, actuator_delay_s, duration_s=10.0)
    assert controller._delay is not None
    assert 1e-9 * controller._delay.delay_ns == pytest.approx(actuator_delay_s, abs=0.0126)
    telemetry = controller.telemetry(prepare_us=0, feedback_us=0, latency_us=0, slack_s=0)
    assert telemetry.delay_s == pytest.approx(1e-9 * controller._delay.delay_ns + 0.1 * DELAY_MARGIN_PERIODS, abs=1e-6)


@pytest.mark.parametrize("seed", [1, 2])
def test_delay_is_found_beside_an_observer_from_what_is_measured(seed: int) -> None:
    """Its estimate is predicted with the delay that is believed, and would confirm it: 0.15 s, and 18 and 12 mm of error."""
    observer = Observer(pioneer_3dx(), ObserverSettings({"y": Disturbance(0.05, 0.3)}), compile=False)
    rti = Rti(Ocp(observer.model, **(PAPER | INCREMENTS | {"N": 12, "Q": [1.0, 1.0, 0.0]})), compile=False)
    controller = Controller(rti, Timing(delay_s=None), observer=observer, compile=False)
    body = robot(eight(), actuator_delay_s=0.2, noise_std=NOISE, seed=seed)
    controller.receive_reference(reference(eight().lasting(35.0)))
    assert error_mm(drive(controller, body, 30.0)) < 5.0
    assert controller._delay is not None
    assert 1e-9 * controller._delay.delay_ns == pytest.approx(0.2, abs=0.0126)


def test_estimator_compares_only_what_is_measured() -> None:
    estimator = DelayEstimator(double_integrator().model, DT, MAX_DELAY_PERIODS * DT, scale=np.ones(2), measured=[0], compile=False)
    one = Command(1, 1, 0, 1, 0, 0, 250 * MS, 0, Mode.TRACKING, QpStatus.SOLVED, DT, np.ones((6, 1)))
    estimator.sent(one)
    estimator.observe(np.zeros(2), 0)
    estimator.observe(np.array([0.005, 9.9]), DT)  # a mass accelerated by 1 m/s^2 at once, whose speed nobody measures
    assert estimator._costs.argmin() == 0
    assert estimator._costs[0] == pytest.approx(0.0, abs=1e-9)


def test_noise_alone_is_no_delay(rti: Rti) -> None:
    controller, _ = driven(rti, None, 0.0, noise=1.0)
    assert controller.grid.delay_ns < 40 * MS


def test_delay_longer_than_can_be_measured_is_taken_for_the_longest(rti: Rti) -> None:
    controller, run = driven(rti, None, 0.29, duration_s=20.0)
    assert controller.grid.delay_ns == MAX_DELAY_PERIODS * DT
    assert not run.refused[20:]


def test_measured_delay_never_makes_the_grid_jump(rti: Rti) -> None:
    _, run = driven(rti, None, 0.2, duration_s=20.0)
    steps = np.diff([command.stamp_ns for command in run.commands])
    assert np.all(np.abs(steps - DT) <= 2 * DT // DELAY_SLEW_SAMPLES)  # the first one catches up with its own
    for one, other in zip(run.commands, run.commands[1:], strict=False):
        assert np.all(np.abs(other.u[0] - one.u[0]) <= 1.000001 * 0.1 * SLEW * (1 + 1 / DELAY_SLEW_SAMPLES))


@pytest.mark.parametrize("delay_ns", [-(10**9), 0, 10**12])
def test_delay_stays_between_nothing_and_three_periods(delay_ns: int) -> None:
    grid = Grid(0.1, Timing(delay_s=None))
    for _ in range(1000):
        grid.adapt(delay_ns)
        assert 0 <= grid.delay_ns <= MAX_DELAY_PERIODS * DT


def played(actuator: Actuator, x: np.ndarray, from_ns: int, to_ns: int) -> np.ndarray:
    """A mass on a line, exactly."""
    for until_ns, (a,) in actuator.play(from_ns, to_ns):
        t = 1e-9 * (until_ns - from_ns)
        x = np.array([x[0] + t * x[1] + t * t * a / 2, x[1] + t * a])
        from_ns = until_ns
    return x


def estimated(delay_ms: int, noise: float, unit: float = 1.0) -> DelayEstimator:
    """What is learnt from 100 states of a mass under random inputs, all in units of which 1 m/s^2 is so many."""
    rng = np.random.default_rng(delay_ms)
    model = double_integrator().model
    model = replace(model, f_expl_expr=ca.vertcat(model.x[1], unit * model.u))
    estimator = DelayEstimator(model, DT, MAX_DELAY_PERIODS * DT, scale=np.full(2, unit), compile=False)
    actuator = Actuator(np.zeros(1), np.full(1, np.inf), epoch=1, delay_ns=delay_ms * MS)
    x = np.zeros(2)
    for k in range(100):
        now_ns = k * DT
        estimator.observe(unit * (x + noise * rng.standard_normal(2)), now_ns)
        command = Command(1, k + 1, now_ns, 1, k, now_ns, now_ns + 250 * MS, 0, Mode.TRACKING, QpStatus.SOLVED, DT, rng.uniform(-1, 1, (6, 1)))
        estimator.sent(command)
        actuator.accept(command, now_ns)
        x = played(actuator, x, now_ns, now_ns + DT)
    return estimator


@pytest.mark.parametrize("delay_ms", [0, 30, 75, 140])
@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_estimator_by_itself_finds_the_delay_of_random_inputs(delay_ms: int, noise: float) -> None:
    assert 1e-6 * estimated(delay_ms, noise).delay_ns == pytest.approx(delay_ms, abs=10.0)


@pytest.mark.parametrize("unit", [2.0**-20, 2.0**10], ids=["2^-20", "2^10"])
@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_same_is_learnt_in_any_unit(noise: float, unit: float) -> None:
    """Factors are powers of two, so that nothing is rounded."""
    one, other = estimated(75, noise), estimated(75, noise, unit)
    np.testing.assert_array_equal(one._costs, other._costs)
    assert one.delay_ns == other.delay_ns


def test_inputs_that_do_not_change_say_nothing() -> None:
    estimator = DelayEstimator(double_integrator().model, DT, MAX_DELAY_PERIODS * DT, scale=np.ones(2), compile=False)
    for k in range(100):
        estimator.observe(np.array([0.01 * k, 0.1]), k * DT)
        estimator.sent(Command(1, k + 1, k * DT, 1, k, k * DT, k * DT + 250 * MS, 0, Mode.TRACKING, QpStatus.SOLVED, DT, np.zeros((6, 1))))
    assert not estimator._costs.any()


def test_another_life_of_the_robot_keeps_what_was_learnt() -> None:
    estimator = DelayEstimator(double_integrator().model, DT, MAX_DELAY_PERIODS * DT, scale=np.ones(2), compile=False)
    estimator.delay_ns = 75 * MS
    estimator.observe(np.zeros(2), 10**12)
    estimator.clear()
    estimator.observe(np.zeros(2), 0)
    estimator.observe(np.zeros(2), DT)
    assert estimator.delay_ns == 75 * MS
