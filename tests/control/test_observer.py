# SPDX-License-Identifier: Apache-2.0
"""The observer: by itself against a plant whose disturbances are known, then in closed loop with models that are wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import End, Reference, State
from rti_mpc.contract.status import Mode
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.observer import Disturbance, Observer, ObserverSettings
from rti_mpc.control.sent import Sent
from rti_mpc.control.state_stream import Arrival, StateStream
from rti_mpc.errors import OcpError
from rti_mpc.model.disturbance import with_disturbances
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import Model
from rti_mpc.model.obstacle import with_obstacles
from rti_mpc.model.robots.pioneer_3dx import NOMINAL_PARAMETERS, pioneer_3dx
from rti_mpc.reference.trajectory import circle
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc.signals import Signal
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, SLEW, drive, reference
from tests.problems import PAPER, double_integrator, pioneer
from tests.problems import SLEW as INCREMENTS
from tests.units import PIONEER_UNITS, in_other_units

POSE = ("x", "y", "psi")
INPUTS = {"u_c": Disturbance(drift=0.1, limit=0.3), "omega_c": Disturbance(drift=0.1, limit=0.3)}
SLIP = {"x": Disturbance(drift=0.02, limit=0.1), "y": Disturbance(drift=0.02, limit=0.1)}
DT = 0.1


def wrong_parameters() -> Model:
    """The robot with every theta 20 % off, up and down in turn."""
    scaled = {name: value * (1.2 if i % 2 else 0.8) for i, (name, value) in enumerate(NOMINAL_PARAMETERS.items()) if name != "a"}
    return pioneer_3dx().with_parameters(**scaled)


def slipping() -> Model:
    """The robot, sliding to its left at 2 cm/s."""
    model = pioneer_3dx()
    psi = model.x[2]
    return replace(model, f_expl_expr=model.f_expl_expr + 0.02 * ca.vertcat(-ca.sin(psi), ca.cos(psi), 0, 0, 0))


def observed(observer: Observer, plant: Model, x: Array, d: Array, steps: int, measures: slice = slice(None)) -> Array:
    """Let a plant go and be observed; return its last state."""
    rng = np.random.default_rng(1)
    phi = integrator(plant, "rk4", 20)
    observer.reset(np.where(np.arange(5) < 3, x, 0.0))
    for _ in range(steps):
        u = rng.uniform([-0.5, -0.7], [0.5, 0.7])
        x = np.array(phi(x, u + d, plant.p_nominal, DT)).ravel()
        observer.predict(u, DT)
        seen = np.full(5, 1e6)  # what is not measured must not be looked at
        seen[measures] = x[measures]
        observer.correct(seen)
    return x


def test_input_disturbances_and_unmeasured_speeds_are_found_from_the_pose_alone() -> None:
    observer = Observer(pioneer_3dx(), ObserverSettings(INPUTS, POSE), compile=False)
    d = np.array([0.05, -0.1])
    x = observed(observer, pioneer_3dx(), np.array([1.0, 2.0, 0.5, 0.3, 0.2]), d, 100, slice(3))
    np.testing.assert_allclose(observer.d, d, rtol=0, atol=1e-3)  # the filter allows for a drift; the plant has finer steps
    np.testing.assert_allclose(observer.x, x, rtol=0, atol=1e-3)


def test_disturbances_stay_inside_their_limits() -> None:
    observer = Observer(pioneer_3dx(), ObserverSettings(INPUTS), compile=False)
    observed(observer, pioneer_3dx(), np.zeros(5), np.array([0.9, -0.9]), 50)
    np.testing.assert_array_equal(observer.d, [0.3, -0.3])


def test_frozen_disturbances_keep_their_values_while_the_state_is_followed() -> None:
    observer = Observer(pioneer_3dx(), ObserverSettings(INPUTS), compile=False)
    observed(observer, pioneer_3dx(), np.zeros(5), np.array([0.05, 0.05]), 50)
    before = observer.d.copy()
    observer.frozen = True
    x = observed(observer, pioneer_3dx(), np.zeros(5), np.array([-0.2, 0.2]), 50)
    np.testing.assert_array_equal(observer.d, before)
    np.testing.assert_allclose(observer.x, x, rtol=0, atol=0.05)  # a wrong disturbance acts on the prediction; the measurement corrects it


def test_compiled_observer_is_the_interpreted_one() -> None:
    results = []
    for compile in (False, True):
        observer = Observer(pioneer_3dx(), ObserverSettings(INPUTS | SLIP, POSE), compile=compile)
        observed(observer, wrong_parameters(), np.zeros(5), np.zeros(2), 20, slice(3))
        results.append(np.concatenate([observer.x, observer.d]))
    np.testing.assert_allclose(*results, rtol=0, atol=1e-12)  # equal to rounding


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (ObserverSettings(measured=("x", "v")), r"measured must be of states \(x, y, psi, u, omega\), got v"),
        (ObserverSettings({"u_c": Disturbance(0.0, 1.0)}), r"disturbance of u_c must be positive, got 0.0 and 1.0"),
        (ObserverSettings(noise={"x": 0.0}), r"noise of a measured state must be positive"),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings: ObserverSettings, words: str) -> None:
    with pytest.raises(OcpError, match=words):
        Observer(pioneer_3dx(), settings, compile=False)


def estimates(x_units: Array, u_units: Array, noise: float | None = None) -> Array:
    """Return states and disturbances, in the old units, that a controller's observer finds from the pose of the robot in other units."""
    ocp = in_other_units(pioneer(N=7), x_units, u_units)
    units = dict(zip((signal.name for signal in (*ocp.model.inputs, *ocp.model.states)), (*u_units, *x_units), strict=True))
    disturbances = {name: Disturbance(of.drift / units[name], of.limit / units[name]) for name, of in (INPUTS | SLIP).items()}
    configured = {} if noise is None else {"x": noise / units["x"]}
    observer = Observer(ocp.model, ObserverSettings(disturbances, POSE, configured, configured), compile=False)
    Controller(Rti(replace(ocp, model=observer.model), compile=False), Timing(), observer=observer, compile=False)
    rng, phi = np.random.default_rng(1), integrator(slipping(), "rk4", 4)
    x: Array = np.array([1.0, 2.0, 0.5, 0.3, 0.2])
    observer.reset(x / x_units)
    found = []
    for _ in range(60):
        u = rng.uniform([-0.5, -0.7], [0.5, 0.7])
        x = np.array(phi(x, u + np.array([0.05, -0.1]), slipping().p_nominal, DT)).ravel()
        observer.predict(u / u_units, DT)
        observer.correct((x + rng.normal(size=5) * 1e-3) / x_units)
        found.append([*observer.x * x_units, *observer.d * [units[name] for name in disturbances]])
    return np.array(found)


@pytest.mark.parametrize("noise", [None, 0.005])
def test_same_robot_in_other_units_has_the_same_estimates(noise: float | None) -> None:
    """Noises that are left out follow from the problem's scales; one that is configured is what it is, in the state's unit. Here mm, degrees, rpm."""
    x_units, u_units = PIONEER_UNITS
    plain, other = estimates(np.ones(5), np.ones(2), noise), estimates(np.array([1e-3, 1e-3, *x_units[2:]]), u_units, noise)
    np.testing.assert_allclose(other, plain, rtol=0, atol=1e-8)  # m, rad, and per second: all range over about one


# In closed loop: the circle, after 20 s.


def steady_error_mm(plant: Model, settings: ObserverSettings | None, hides: tuple[int, ...] = ()) -> float:
    observer = None if settings is None else Observer(pioneer_3dx(), settings, compile=False)
    model = pioneer_3dx() if observer is None else observer.model
    rti = Rti(Ocp(model, **(PAPER | INCREMENTS | {"N": 20, "Q": [1.0, 1.0, 0.0]})), compile=False)
    controller = Controller(rti, Timing(), observer=observer, compile=False)
    body = Lockstep(RobotSettings(plant, np.array([*circle().pose0, 0.0, 0.0]), SLEW))
    controller.receive_reference(reference(circle()))

    def hidden(state: State) -> State:
        x = state.x.copy()
        x[list(hides)] = 0.0
        return replace(state, x=x)

    run = drive(controller, body, 40.0, sees=hidden)
    assert {command.mode for command in run.commands} == {Mode.TRACKING}
    assert not run.refused
    return float(run.error_mm(circle())[np.array(run.t_s) > 20.0].max())


@pytest.mark.parametrize("plant", [wrong_parameters, slipping])
def test_wrong_model_is_tracked_without_offset_by_its_observer(plant: Callable[[], Model]) -> None:
    """The promise is 1 mm; without the observer it is millimetres."""
    without, with_ = steady_error_mm(plant(), None), steady_error_mm(plant(), ObserverSettings(INPUTS | SLIP))
    print(f"{plant.__name__}: {without:.2f} mm without, {with_:.3f} mm with the observer")
    assert with_ < 1.0 < without


def test_pose_alone_is_enough_to_drive() -> None:
    assert steady_error_mm(wrong_parameters(), ObserverSettings(INPUTS, POSE), hides=(3, 4)) < 1.0


def test_observer_has_the_robots_own_parameters_where_the_problem_has_those_of_obstacles_too() -> None:
    robot = pioneer_3dx()
    own = 1.01 * np.array(robot.p_nominal)
    observer = Observer(robot, ObserverSettings(INPUTS), compile=False)
    model = with_disturbances(with_obstacles(robot, [(3.0, 3.0, 0.2)]), INPUTS)
    rti = Rti(Ocp(model, **(PAPER | INCREMENTS | {"N": 5, "Q": [1.0, 1.0, 0.0], "z": 100.0})), compile=False)
    controller = Controller(rti, Timing(), observer=observer, compile=False)
    y = reference(circle()).y
    controller.receive_reference(Reference(1, 1, 0, 20 * MS, End.HOLD, y, np.tile([*own, 3.0, 3.0, 0.2], (len(y), 1))))
    drive(controller, Lockstep(RobotSettings(robot, np.array([*circle().pose0, 0.0, 0.0]), SLEW)), 1.0)
    assert controller.mode is Mode.TRACKING
    np.testing.assert_array_equal(observer.p, own)


def test_estimate_for_which_the_model_has_no_value_begins_anew_at_the_next_state() -> None:
    """The outflow of a tank is the root of its level: one measurement below zero, and no number follows from it."""
    h, q = ca.SX.sym("h"), ca.SX.sym("q")
    tank = Model(
        "tank",
        h,
        q,
        0.3 * q - 0.5 * ca.sqrt(h),
        y_expr=h,
        states=(Signal("h", "m"),),
        inputs=(Signal("q", "m/s"),),
        outputs=(Signal("h", "m"),),
        x_nominal=(0.3,),
    )
    observer = Observer(tank, ObserverSettings({"h": Disturbance(drift=0.1, limit=0.2)}), compile=False)
    rti = Rti(Ocp(observer.model, N=10, dt=DT, Q=[1.0], R=[0.1], lbu=[0.0], ubu=[3.0]), compile=False)
    controller = Controller(rti, Timing(), observer=observer, compile=False)
    controller.receive_reference(Reference(1, 1, 0, 100 * MS, End.HOLD, np.full((100, 1), 0.4), np.zeros((100, 0))))
    body = Lockstep(RobotSettings(tank, np.array([0.3]), state_period_s=DT))
    run = drive(controller, body, 6.0, sees=lambda state: replace(state, x=np.array([-0.2])) if state.seq == 20 else state)
    codes = [notice.code for notice in controller.notices()]
    assert codes.count("estimate_lost") == 1
    assert np.isfinite(observer.d).all()
    assert [command.mode for command in run.commands[-5:]] == [Mode.TRACKING] * 5
    assert run.x[-1] == pytest.approx(0.4, abs=0.01)


def test_estimate_goes_on_from_its_own_last_state_where_states_between_were_late() -> None:
    """At 1 m/s and 100 Hz; eight states that have waited 0.4 s are not answered, and nothing is estimated from them."""
    model = double_integrator().model
    observer = Observer(model, ObserverSettings({model.inputs[0].name: Disturbance(0.1, 5.0)}), compile=False)
    stream = StateStream(model, 225 * MS, 100 * MS, 1.0, observer)
    sent = Sent(np.zeros(1), -np.ones(1), np.ones(1), 100 * MS)
    seen = []
    for k in range(200):
        stamp_ns, late_ns = 10 * MS * k, 400 * MS if 150 <= k < 158 else 0
        seen.append(stream.receive(State(1, k + 1, stamp_ns, np.array([1e-9 * stamp_ns, 1.0])), 10**9 + stamp_ns + late_ns))
        if seen[-1] in (Arrival.FRESH, Arrival.NEW_LIFE):
            stream.estimate(sent, known=True)
            np.testing.assert_allclose(stream.x, [1e-9 * stamp_ns, 1.0], rtol=0, atol=1e-6)
            np.testing.assert_allclose(stream.d, 0.0, rtol=0, atol=1e-6)
    assert Arrival.OLD in seen[150:158]
    assert seen[-1] is Arrival.FRESH
