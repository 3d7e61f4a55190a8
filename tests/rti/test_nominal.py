# SPDX-License-Identifier: Apache-2.0
"""Models that are singular at zero, outside their range of operation: built and driven. Stiff models: refused as such."""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import pytest

from rti_mpc.errors import OcpError
from rti_mpc.model.model import Model, Signal
from rti_mpc.rti.nominal import nominal_state
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc.si import read
from tests.problems import INF, pioneer
from tests.slow import slow_but
from tests.units import with_units


def test_state_that_is_found_where_a_model_is_regular_is_the_same_in_any_units() -> None:
    """A level, of which one metre is tried: it was one micrometre of a level in micrometres."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    level, inflow = Signal("h", "m"), Signal("q", "m/s")
    tank = Model("tank", x, u, u * ca.sqrt(x - 0.01), x, level, inflow, level)  # none below its bottom outlet
    found = []
    for units in ({}, {"h": "um", "q": "mm/s"}):
        model = with_units(tank, units)
        ocp = Ocp(model, N=3, dt=0.1, Q=1.0, R=1.0)
        found.append(float(nominal_state(ocp)[0]) * read(model.states[0].unit).size)
    assert found[1] == pytest.approx(found[0], rel=1e-9)


class Plant(NamedTuple):
    """A model, where it starts, what it is to reach, and the rest of its problem."""

    model: Model
    x0: list[float]
    u0: list[float]
    y_ref: list[float]
    problem: dict[str, Any]


def reactor(**changes: Any) -> Plant:
    """A stirred tank with a reaction of Arrhenius: exp(-E / RT) has no derivative at T = 0."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    c, T = x[0], x[1]
    rate = 7.2e10 * ca.exp(-8750 / T) * c
    f = [1 - c - rate, 350 - T + 209 * rate - 2.09 * (T - 300 - 20 * u)]
    model = Model("reactor", x, u, f, T, ("c", "T"), ("q",), ("T",), **changes)
    return Plant(model, [0.5, 350.0], [0.0], [352.0], {"dt": 0.02, "lbu": -5, "ubu": 5})


def tank(**changes: Any) -> Plant:
    """A tank that flows out with the root of its level."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    model = Model("tank", x, u, u - 0.5 * ca.sqrt(x), x, "h", "q", "h", **changes)
    return Plant(model, [1.0], [0.5], [1.5], {"dt": 0.5, "lbu": 0, "ubu": 2})


def bicycle(**changes: Any) -> Plant:
    """A car whose slip angles divide by its speed, which is bounded from below."""
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 2)
    v, vy, r, _ = ca.vertsplit(x)
    front, rear = u[1] - ca.atan((vy + 1.2 * r) / v), -ca.atan((vy - 1.3 * r) / v)
    f = [u[0], 60 * front + 60 * rear - v * r, 48 * front - 52 * rear, vy]
    model = Model("bicycle", x, u, f, [v, x[3]], ("v", "vy", "r", "y"), ("a", "delta"), ("v", "y"), **changes)
    problem = {"dt": 0.05, "lbu": [-3, -0.3], "ubu": [3, 0.3], "lbx": [5, -INF, -INF, -INF]}
    return Plant(model, [10.0, 0.0, 0.0, 0.0], [0.0, 0.0], [12.0, 0.5], problem)


def attitude(**changes: Any) -> Plant:
    """A quaternion, normalised where it is used."""
    x, u = ca.SX.sym("q", 4), ca.SX.sym("w", 3)
    w, i, j, k = ca.vertsplit(x / ca.norm_2(x))
    p, q, r = ca.vertsplit(u)
    f = [(-i * p - j * q - k * r) / 2, (w * p + j * r - k * q) / 2, (w * q + k * p - i * r) / 2, (w * r + i * q - j * p) / 2]
    model = Model("attitude", x, u, f, x[1:], ("w", "i", "j", "k"), ("p", "q", "r"), ("i", "j", "k"), **changes)
    return Plant(model, [1.0, 0.0, 0.0, 0.0], [0.0] * 3, [0.1, 0.2, 0.0], {"dt": 0.05, "lbu": -2, "ubu": 2})


PLANTS = {"reactor": reactor, "tank": tank, "bicycle": bicycle, "attitude": attitude}


def problem(plant: Plant, **changes: Any) -> Ocp:
    return Ocp(plant.model, **{"N": 10, "Q": [1.0] * plant.model.ny, "R": [0.01] * plant.model.nu} | plant.problem | changes)


@pytest.mark.parametrize(("name", "given"), slow_but(product(PLANTS, (False, True)), *product(PLANTS, (False,)), ("tank", True)))
def test_model_that_is_singular_at_zero_is_built_and_driven_to_its_set_point(name: str, given: bool) -> None:
    plant = PLANTS[name]()
    if given:
        plant = PLANTS[name](x_nominal=plant.x0)
    rti = Rti(ocp := problem(plant), compile=False)
    assert np.isfinite(rti.x).all()
    assert not given or rti.x_nominal.tolist() == plant.x0
    phi, x = ocp.phi(), np.array(plant.x0)
    rti.reset(x, plant.u0)
    for _ in range(150):
        rti.prepare([plant.y_ref] * ocp.N)
        assert rti.feedback(x).usable
        x = np.array(phi(x, rti.u[0], [])).ravel()
    np.testing.assert_allclose(np.array(plant.model.h()(x, [])).ravel(), plant.y_ref, rtol=0, atol=1e-3)  # in the unit of each output


def test_model_that_drains_below_where_it_is_regular_is_built_all_the_same() -> None:
    """Its inputs at rest empty the tank within the horizon; the root of a negative level is none."""
    rti = Rti(problem(tank(), N=20, ubu=INF), compile=False)
    assert np.isfinite(rti.scale).all()


def test_nominal_state_is_zero_brought_inside_the_bounds_wherever_that_is_regular() -> None:
    np.testing.assert_array_equal(nominal_state(pioneer()), np.zeros(5))
    np.testing.assert_array_equal(nominal_state(pioneer(lbx=[-INF, -INF, -INF, 0.1, -1.0])), [0.0, 0.0, 0.0, 0.1, 0.0])
    np.testing.assert_array_equal(nominal_state(problem(bicycle())), [5.0, 0.0, 0.0, 0.0])


def test_nominal_state_that_is_singular_is_refused_with_its_numbers() -> None:
    with pytest.raises(OcpError, match=r"x_nominal must be a state at which model tank is finite .*, got h = -1, where the rate of h is not finite"):
        Rti(problem(tank(x_nominal=-1.0)), compile=False)


def drive(tau_s: float) -> Model:
    """A speed that follows its command with a time constant, and the way it makes."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    return Model("drive", x, u, [x[1], (u - x[1]) / tau_s], x[0], ("p", "v"), "v_c", "p")


@pytest.mark.parametrize(("method", "tau_s", "longest_s"), [("rk4", 0.03, 0.0836), ("rk4", 0.002, 0.00557), ("euler", 0.04, 0.08)])
def test_stiff_model_is_refused_as_such_with_its_state_and_the_longest_stage(method: str, tau_s: float, longest_s: float) -> None:
    with pytest.raises(OcpError) as refusal:
        Rti(Ocp(drive(tau_s), N=20, dt=0.1, Q=1, R=0.1, method=method, lbu=-1, ubu=1), compile=False)
    line = str(refusal.value)
    assert f"model drive, which is stiff: v settles with a time constant of {tau_s:g} s" in line
    assert float(line.partition("at most ")[2].split()[0]) == pytest.approx(longest_s, rel=2e-3)  # of where it was looked for
    shorter = float(line.partition("at most ")[2].split()[0])
    assert Rti(Ocp(drive(tau_s), N=20, dt=shorter, Q=1, R=0.1, method=method, lbu=-1, ubu=1), compile=False)


@pytest.mark.parametrize("rate", [ca.SX([[0, 1], [-900, 0]]), ca.SX([[0, 1], [900, 0]]), ca.SX([[0, 1], [-100, -1]])])
def test_motion_that_swings_or_grows_by_itself_is_not_taken_for_stiff(rate: ca.SX) -> None:
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    model = Model("spring", x, u, rate @ x + ca.vertcat(0, u), x[0], ("r", "v"), "F", "r")
    assert Rti(Ocp(model, N=5, dt=0.02, Q=1, R=0.1), compile=False)


def test_stiff_model_is_not_advised_to_take_more_steps_than_can_be_built() -> None:
    with pytest.raises(OcpError, match=r"take the implicit integrator, irk, or shorten dt, got dt = 0\.1 s"):
        Rti(Ocp(drive(1e-9), N=20, dt=0.1, Q=1, R=0.1, lbu=-1, ubu=1), compile=False)


@pytest.mark.parametrize("changes", [{"method": "irk"}, {"sim_method_num_steps": 4}], ids=["implicit", "steps"])
def test_stiff_model_is_built_with_the_integrator_that_its_refusal_names(changes: dict[str, Any]) -> None:
    problem_of = {"N": 20, "dt": 0.1, "Q": 1, "R": 0.1, "lbu": -1, "ubu": 1}
    with pytest.raises(OcpError, match="take the implicit integrator, irk, or sim_method_num_steps = 4, or shorten dt"):
        Rti(Ocp(drive(0.01), **problem_of), compile=False)
    ocp = Ocp(drive(0.01), **problem_of | changes)
    assert Rti(ocp, compile=False)
    assert ocp.model.method == ocp.method, "and all that predicts with the model has it"
