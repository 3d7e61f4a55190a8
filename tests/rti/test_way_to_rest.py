# SPDX-License-Identifier: Apache-2.0
"""The way to rest: from a state of motion to an equilibrium, inside bounds and slew limits, and what a robot does there."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.errors import OcpError
from rti_mpc.model.integrator import integrator
from rti_mpc.model.robots.dynamic_bicycle import dynamic_bicycle
from rti_mpc.model.robots.two_link_arm import two_link_arm
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.operation import states_of_operation
from rti_mpc.rti.rest import STANDING_S, RestClass, assess, find_stop_law, standing_s
from rti_mpc.rti.way_to_rest import StopLaw, WayToRest
from tests.movers import car, law_of, mover, ocp_of
from tests.problems import tank
from tests.slow import slow_but

CLASSES = {
    "pioneer": RestClass.HOLDS,
    "boat": RestClass.HOLDS,
    "car": RestClass.DRIFTS,
    "bicycle": RestClass.DRIFTS,
    "arm": RestClass.UNSTABLE,
    "quadrotor": RestClass.UNSTABLE,
    "cart_pole": RestClass.UNSTABLE,
}
FEW = ("pioneer", 12), ("car", 12), ("arm", 12)  # with how many states of operation


@cache
def way_of(name: str) -> WayToRest:
    """One for all of a robot: each search begins anew."""
    law = law_of(name)
    assert law is not None
    return WayToRest(ocp_of(name), law, compile=False)


def rates(way: WayToRest, name: str, row: int) -> Array:
    model = ocp_of(name).model
    f = ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr])
    return np.array(f(way.x[row], way.u[row], model.p_nominal)).ravel()


@pytest.mark.parametrize(("name", "states"), slow_but([*((name, 40) for name in CLASSES), *FEW], *FEW))
def test_robot_is_classified_by_what_it_does_at_rest(name: str, states: int) -> None:
    rest = assess(ocp_of(name), law_of(name), states, compile=False)
    assert rest.kind is CLASSES[name]
    assert 0.0 < rest.time_s < 10.0
    assert rest.states == states
    assert bool(rest.alone) is (CLASSES[name] is not RestClass.HOLDS), "only of one that does not hold it is said how fast it moves alone"


@pytest.mark.parametrize("name", ["pioneer", "boat"])
def test_robot_that_its_inputs_at_rest_stop_needs_no_way(name: str) -> None:
    assert law_of(name) is None


@pytest.mark.parametrize(
    ("name", "states"),
    slow_but(
        [*((name, 8) for name in ("car", "bicycle", "arm", "quadrotor", "cart_pole")), ("car", 3), ("quadrotor", 3)], ("car", 3), ("quadrotor", 3)
    ),
)
def test_way_ends_at_rest_and_is_inside_bounds_and_slew_limits(name: str, states: int) -> None:
    ocp, way = ocp_of(name), way_of(name)
    for x, u in zip(*states_of_operation(ocp, states, seed=7), strict=True):
        assert way.find(x, u)
        assert np.array_equal(way.x[0], x)
        assert np.abs(rates(way, name, -1)).max() < 1e-6, "its last row is an equilibrium"
        assert np.abs(way.x[-1] - way.x[-2]).max() < 0.05, "which is where it has come to"
        assert np.all((way.u >= ocp.lbu) & (way.u <= ocp.ubu))
        steps = np.diff(way.u, axis=0, prepend=u[None])
        assert np.all((steps >= ocp.lbdu - 1e-12) & (steps <= ocp.ubdu + 1e-12))


def test_car_brakes_as_hard_as_it_may_and_keeps_its_heading_free() -> None:
    way = way_of("car")
    assert way.find(np.array([4.0, -1.0, 7.0, 3.0]), np.zeros(2))
    assert way.u[0, 0] == -2.0
    assert way.x[-1, 3] == pytest.approx(0.0, abs=1e-9), "of Newton steps"
    assert way.x[-1, 0] - 4.0 == pytest.approx(np.cos(7.0) * 3.0**2 / 4.0, rel=0.1), "v^2 / 2a, and the end of it is slower"
    assert np.allclose(way.K[1], 0.0), "at rest no curvature moves it"


@pytest.mark.parametrize("name", slow_but(["car", "bicycle", "arm", "quadrotor"], "car", "quadrotor"))
def test_robot_that_has_come_off_its_way_is_back_and_still_soon(name: str) -> None:
    """As after a plan that could not be followed any more: 0.03 m, or rad, off in the first place that it may rest at."""
    ocp, way = ocp_of(name), way_of(name)
    model, period_s = ocp.model, way.law.period_s
    x = np.array(model.x_nominal or np.zeros(model.nx))
    assert way.find(x, np.array(model.u_rest))
    phi, x = integrator(model, "rk4"), way.x[-1] + 0.03 * np.eye(model.nx)[0]
    f = ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr])
    rate = np.zeros(model.nx)
    for _ in range(round(3.0 / period_s)):
        u = np.clip(way.u[-1] - way.K @ (x - way.x[-1]), ocp.lbu, ocp.ubu)
        rate, x = np.array(f(x, u, model.p_nominal)).ravel(), np.array(phi(x, u, model.p_nominal, period_s)).ravel()
    assert np.abs(x - way.x[-1]).max() < 1e-3, "m, rad"
    assert np.abs(rate[:2]).max() < 1e-3, "m/s, rad/s"


def test_car_that_has_braked_with_all_it_has_is_led_back_onto_its_way_after_the_last_row() -> None:
    ocp, law = ocp_of("car"), law_of("car")
    assert law is not None
    way_s = law.rows * law.period_s
    stands_s = standing_s(ocp, law, lambda x: x[:, :2], speed=1e-3)
    assert way_s < stands_s < way_s + 1.0
    assert standing_s(ocp, law, lambda x: x[:, :2], speed=0.1) == pytest.approx(way_s), "a tenth of a metre per second it has lost before"
    alone = replace(law, holds=True)
    assert standing_s(ocp, alone, lambda x: x[:, :2], speed=1e-3) == pytest.approx(way_s + STANDING_S), "without its gain it drifts on"


def test_gain_of_a_robot_that_answers_late_is_one_with_which_it_does_not_sway() -> None:
    ocp, law, delay_s = ocp_of("car"), law_of("car"), 0.2
    assert law is not None
    with pytest.raises(OcpError, match=r"it still moves: x, y, v, .* 0\.21 s late"):
        assess(ocp, replace(law, delay_s=delay_s), 24, compile=False)
    late = find_stop_law(ocp, delay_s=delay_s)
    assert late is not None
    assert late.input_weight > law.input_weight
    assess(ocp, late, 24, compile=False)


def test_arm_is_held_by_its_torques_wherever_it_stops() -> None:
    way = way_of("arm")
    for q_1 in (-1.5, 0.0, 1.5):
        assert way.find(np.array([q_1, 0.5, 1.0, -1.0]), np.zeros(2))
        weight = 0.25 * 9.81 * np.cos(way.x[-1, 0] + way.x[-1, 1])
        assert way.u[-1] == pytest.approx([0.75 * 9.81 * np.cos(way.x[-1, 0]) + weight, weight], abs=1e-5)
        assert abs(way.x[-1, 0] - q_1) < 0.5


@pytest.mark.parametrize(
    ("x", "u"),
    [((2.94, -0.15, 1.93, -0.1), (19.6, -12.0)), ((2.624, 0.207, 2.953, 1.296), (19.24, 9.58))],
    ids=["slowly", "fast"],
)
def test_way_of_an_arm_that_is_nearly_stretched_is_aimed_at_where_it_ends(x: tuple[float, ...], u: tuple[float, ...]) -> None:
    """Aimed at where the last pass had led, each pass ended on the other side of it, 0.2 to 0.8 rad away."""
    limits = {"lbu": [-30.0, -15.0], "ubu": [30.0, 15.0], "lbdu": [-15.0, -8.0], "ubdu": [15.0, 8.0]}
    ocp = Ocp(two_link_arm(), N=5, dt=0.02, Q=np.ones(2), R=np.ones(2), **limits)
    scale_x, scale_u = np.array([3.0, 2.5, 3.0, 3.0]), np.array([30.0, 15.0])
    way = WayToRest(ocp, StopLaw(22, 52, 0.02, 1, 0.01, np.array([3.0, 3.0, 416.0, 1194.0]), scale_x, scale_u), compile=False)
    assert way.find(np.array(x), np.array(u))
    assert way.x[-2] == pytest.approx(way.x_e, abs=0.02), "rad, rad/s"
    assert np.abs(way.x[-2, 2:]).max() < 0.03, "rad/s: a hundredth of its speeds in operation"


@pytest.mark.slow
def test_ways_to_rest_are_found_for_a_car_that_slides() -> None:
    """Wherever it stands it is at rest, so that a way may lead far from where it is aimed: aims that go half the way there do not find one."""
    states = {"lbx": [-np.inf] * 3 + [-1.0, -1.0, -4.0, -0.4189], "ubx": [np.inf] * 3 + [5.0, 1.0, 4.0, 0.4189]}
    limits = {"lbu": [-6.0, -3.2], "ubu": [6.0, 3.2], "lbdu": [-2.0, -1.0], "ubdu": [2.0, 1.0]}
    assert find_stop_law(Ocp(dynamic_bicycle(), N=5, dt=0.02, Q=np.ones(3), R=np.ones(2), **states, **limits)) is not None


def test_way_that_is_followed_leads_back_to_where_it_ended_from_beside_it() -> None:
    way = way_of("quadrotor")
    assert way.find(np.array([0.0, 0.0, 0.2, 1.0, -0.5, 0.0]), np.full(2, 4.905))
    end = way.x[-1].copy()
    for elapsed in (5, len(way.u) + 10):
        assert way.follow(way.x[min(elapsed, len(way.u) - 1)] + 0.05, way.u[0], elapsed)
        assert way.x[-2] == pytest.approx(end, abs=0.05)
        assert np.array_equal(way.x[-1], end)


@pytest.mark.parametrize("name", slow_but(["arm", "quadrotor", "cart_pole"], "arm", "quadrotor"))
def test_gain_holds_what_does_not_stay_by_itself(name: str) -> None:
    """Linear, over a row: what the gain leaves of the motion at rest decays; x and heading of a car's side do not move at all."""
    way = way_of(name)
    ocp = ocp_of(name)
    assert way.find(np.zeros(ocp.model.nx), np.array(ocp.model.u_rest))
    phi = ocp.phi()
    z = [ocp.model.x, ocp.model.u, ocp.model.p]
    A, B = (np.array(ca.Function("J", z, [ca.jacobian(phi(*z), wanted)])(way.x[-1], way.u[-1], [])) for wanted in z[:2])
    assert np.abs(np.linalg.eigvals(A - B @ way.K)).max() < 1.0


def test_law_that_a_model_gives_is_rolled_out_instead() -> None:
    ocp = car()
    model = ocp.model
    given = car(lbdu=-0.5, ubdu=0.5)
    object.__setattr__(given, "model", replace(model, stop_expr=ca.vertcat(-4.0 * model.x[3], 0.5 * model.u[1])))
    law = find_stop_law(given)
    assert law is not None
    way = WayToRest(given, law, compile=False)
    assert way.find(np.array([0.0, 0.0, 0.0, 2.0]), np.array([0.0, 0.4]))
    assert way.u[:3, 0] == pytest.approx([-0.5, -1.0, -1.5]), "inside the slew limits"
    assert way.u[:3, 1] == pytest.approx([0.2, 0.1, 0.05]), "of the last input that acted"
    assert way.x[-1, 3] == pytest.approx(0.0, abs=1e-9)


def test_tank_whose_one_state_its_input_changes_by_itself_is_held_at_its_level() -> None:
    ocp = Ocp(tank(), N=10, dt=0.5, Q=1, R=0.01, lbu=0, ubu=2, lbx=0.2, ubx=3)
    law = find_stop_law(ocp)
    assert law is not None
    way = WayToRest(ocp, law, compile=False)
    assert way.find(np.array([2.0]), np.array([0.5]))
    assert way.u[-1] == pytest.approx(0.5 * np.sqrt(way.x[-1]), abs=1e-6)
    assert way.x[-1] == pytest.approx(2.0, abs=0.01), "what is lost in a row of 0.5 s at most"


def test_model_that_does_not_come_to_rest_from_where_it_operates_is_refused_with_where_that_is() -> None:
    ocp = mover("undriven", "q:m w:m/s", "t:N", lambda x, u: (x[1], 0.0 * u[0]), lbu=-5, ubu=5, lbx=[-2, -2], ubx=[2, 2], dt=0.1)
    with pytest.raises(OcpError, match=r"20\.2 s after a stop at q = -2 m, w = -2 m/s it still moves: q$"):
        find_stop_law(ocp)


def test_arm_that_is_too_weak_for_where_it_is_comes_to_rest_where_it_is_not() -> None:
    ocp = mover("weak", "q:rad w:rad/s", "t:Nm", lambda x, u: (x[1], u[0] - 9.81 * ca.sin(x[0])), lbu=-5, ubu=5, lbx=[-2, -2], ubx=[2, 2], dt=0.1)
    law = find_stop_law(ocp)
    assert law is not None
    way = WayToRest(ocp, law, compile=False)
    assert way.find(np.array([1.5, 0.0]), np.zeros(1))
    assert abs(9.81 * np.sin(way.x[-1, 0])) <= 5.0
