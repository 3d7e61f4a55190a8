# SPDX-License-Identifier: Apache-2.0
"""Closed loops without a bus: simulated, summed up, compared and drawn."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest

from rti_mpc import Ocp, Rti, compare, plot, simulate
from rti_mpc.array import Array
from rti_mpc.errors import RtiMpcError
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.rti.simulation import Simulation
from tests.problems import PAPER, arc, double_integrator, pioneer
from tests.robots import arm


@pytest.fixture(scope="module")
def rti() -> Rti:
    return Rti(double_integrator(lbu=-2.0, ubu=2.0), compile=False)


@pytest.fixture(scope="module")
def run(rti: Rti) -> Simulation:
    return simulate(rti, rti.ocp.phi(), [[1.0, 0.0]], samples=60)


@pytest.fixture(scope="module")
def robot() -> Rti:
    return Rti(pioneer(), compile=False)


@pytest.fixture(scope="module")
def driven(robot: Rti) -> Simulation:
    """The paper's robot on its eight, from beside it."""
    return simulate(robot, robot.ocp.phi(), arc, x0=[0.1, 0.1, 0.5, 0.0, 0.0], samples=60)


def test_simulation_is_the_loop_that_one_writes_by_hand(rti: Rti, run: Simulation) -> None:
    phi, x = rti.ocp.phi(), np.zeros(2)
    rti.reset(x, np.zeros(1))
    for k in range(60):
        rti.prepare(np.tile([1.0, 0.0], (10, 1)))
        rti.feedback(x)
        np.testing.assert_array_equal(run.u[k], rti.u[0])
        x = np.array(phi(x, rti.u[0], [])).ravel()
        np.testing.assert_array_equal(run.x[k + 1], x)
    assert run.t[-1] == pytest.approx(6.0)
    np.testing.assert_array_equal(run.y, run.x)
    assert all(status.usable for status in run.status)


def test_reference_is_a_function_of_time_or_rows_one_stage_apart_the_last_one_held(rti: Rti, run: Simulation) -> None:
    for reference in (lambda t: np.column_stack([np.ones_like(t), 0 * t]), np.tile([1, 0], (3, 1)), [[1.0, 0.0]] * 61):
        np.testing.assert_array_equal(simulate(rti, rti.ocp.phi(), reference, samples=60).x, run.x)
    assert len(simulate(rti, rti.ocp.phi(), [[1.0, 0.0]] * 11).u) == 10, "as far as the rows go"


def test_plant_may_be_another_model_with_parameters_of_its_own(robot: Rti, driven: Simulation) -> None:
    slow = simulate(robot, pioneer_3dx().with_parameters(theta_1=0.5), arc, x0=driven.x[0], samples=60)
    same = simulate(robot, pioneer_3dx(), arc, x0=driven.x[0], samples=60)
    np.testing.assert_allclose(same.x, driven.x, rtol=0, atol=3e-4)  # ten steps of RK4 in a stage instead of one
    assert np.abs(slow.x - driven.x).max() > 0.01


def test_summary_has_cost_errors_with_their_units_and_what_went_wrong(driven: Simulation) -> None:
    summary = driven.summary()
    assert list(summary) == ["cost", "x off by [m]", "y off by [m]", "psi off by [rad]", "beyond bounds", "unusable"]
    assert summary["x off by [m]"] == np.abs(driven.error[30:, 0]).max() < 0.05
    assert summary["unusable"] == 0
    by_hand = 28.0 * ((driven.error[1:] ** 2) @ PAPER["Q"]).sum() + 0.8 * (np.diff(driven.u, axis=0, prepend=0.0) ** 2).sum()
    assert driven.cost == pytest.approx(by_hand)


def test_error_of_an_angle_is_less_than_half_a_turn(robot: Rti, driven: Simulation) -> None:
    def wrapped(t: Array) -> Array:
        y = arc(t)
        y[:, 2] = np.remainder(y[:, 2] + math.pi, math.tau) - math.pi + 10 * math.tau
        return y

    run = simulate(robot, robot.ocp.phi(), wrapped, x0=driven.x[0], samples=60)
    np.testing.assert_allclose(run.error, driven.error, rtol=0, atol=1e-6)  # rad, of ten turns in rounding


def test_comparison_is_a_table_with_a_line_for_each_run(run: Simulation, rti: Rti) -> None:
    other = simulate(rti, rti.ocp.phi(), [[2.0, 0.0]], samples=60)
    head, *lines = compare({"near": run, "far away": other}).splitlines()
    assert head.split("  ")[-1] == "unusable"
    assert [line.split("  ")[0] for line in lines] == ["near", "far away"]
    assert f"{run.cost:.4g}" in lines[0]
    assert len({len(line) for line in (head, *lines)}) == 1


def test_page_shows_the_path_every_output_and_every_input_between_its_bounds(driven: Simulation, run: Simulation) -> None:
    pytest.importorskip("matplotlib")
    path, *panels = plot(driven).axes
    assert (path.get_xlabel(), path.get_ylabel(), path.get_title()) == ("x [m]", "y [m]", "pioneer_3dx")
    assert [axes.get_ylabel() for axes in panels] == ["x [m]", "y [m]", "psi [rad]", "u_c [m/s]", "omega_c [rad/s]"]
    np.testing.assert_allclose(panels[0].lines[1].get_ydata(), driven.y[:, 0])
    assert [line.get_ydata()[0] for line in panels[3].lines[:2]] == [-0.5, 0.5]
    assert [axes.get_ylabel() for axes in plot(run).axes] == ["r [m]", "v [m/s]", "a [m/s^2]"], "no plane where there is no position"


def test_page_shows_names_and_units_as_they_are_written_dollar_signs_included(run: Simulation) -> None:
    """Two of them would begin and end a formula, which cannot be drawn where it is none."""
    pytest.importorskip("matplotlib")
    model = run.ocp.model
    named = replace(model, name=r"$\price$", outputs=[replace(signal, name=rf"$\{signal.name}$") for signal in model.outputs])
    ocp = Ocp(named, N=5, dt=0.1, Q=[1, 1], R=1)
    page = plot(simulate(Rti(ocp, compile=False), ocp.phi(), [[1.0, 0.0]] * 3))
    page.savefig(BytesIO())
    assert page.axes[0].get_ylabel() == r"\$\r\$ [m]", "a dollar sign behind a backslash is drawn as one"


def test_plot_without_matplotlib_says_how_to_get_it(run: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    with pytest.raises(RtiMpcError, match=r"matplotlib must be installed for a plot: pip install 'rti-mpc\[figure\]'"):
        plot(run)


WRONG = {
    "an Ocp": (lambda rti: simulate(rti.ocp, rti.ocp.phi(), [[1.0, 0.0]]), "rti must be of rti_mpc.rti.rti.Rti, got"),
    "a plant that is none": (lambda rti: simulate(rti, None, [[1.0, 0.0]] * 3), "plant must be a function of x, u and p, or a Model, got None"),
    "a plant of other states": (lambda rti: simulate(rti, arm(), [[1.0, 0.0]] * 3), "plant must have the 2 states and 1 inputs"),
    "a plant that returns too much": (lambda rti: simulate(rti, lambda x, u, p: np.zeros(3), [[1, 0]] * 3), "what plant returns must be an array of"),
    "a plant that diverges": (lambda rti: simulate(rti, lambda x, u, p: x + np.inf, [[1, 0]] * 3), "plant must return finite states, got [inf, inf]"),
    "a reference of text": (lambda rti: simulate(rti, rti.ocp.phi(), "eight"), "reference must be real numbers, got 'eight'"),
    "rows of three": (lambda rti: simulate(rti, rti.ocp.phi(), np.zeros((4, 3))), "reference must be an array of shape (4, 2), got float64 of shape"),
    "a function of three": (
        lambda rti: simulate(rti, rti.ocp.phi(), lambda t: np.zeros((len(t), 3)), samples=2),
        "what reference returns must be an array of shape (10, 2)",
    ),
    "no samples": (lambda rti: simulate(rti, rti.ocp.phi(), lambda t: t), "samples must be given where the reference is a function"),
    "one row": (
        lambda rti: simulate(rti, rti.ocp.phi(), [[1.0, 0.0]]),
        "reference must have at least 2 rows, the first at the start, or samples must",
    ),
    "no rows": (lambda rti: simulate(rti, rti.ocp.phi(), np.zeros((0, 2)), samples=3), "reference must have at least 1 rows, the first at the start"),
    "a start that is NaN": (lambda rti: simulate(rti, rti.ocp.phi(), [[1.0, 0.0]] * 2, x0=[np.nan, 0.0]), "x0 must be finite, got [nan, 0.0]"),
    "parameters that are numbers": (
        lambda rti: simulate(rti, rti.ocp.phi(), [[1.0, 0.0]] * 2, parameters=[1.0]),
        "parameters must be a function of a state, got [1.0]",
    ),
    "half a sample": (lambda rti: simulate(rti, rti.ocp.phi(), [[1.0, 0.0]], samples=0.5), "samples must be a whole number of at least 1, got 0.5"),
    "a start too short": (lambda rti: simulate(rti, rti.ocp.phi(), [[1.0, 0.0]] * 2, x0=[1.0]), "x0 must be an array of shape (2,)"),
    "a comparison of nothing": (lambda rti: compare({}), "runs must be simulations by name, at least one, got {}"),
    "a comparison of a list": (lambda rti: compare([1, 2]), "runs must be simulations by name"),
    "a comparison of numbers": (lambda rti: compare({"a": 1}), "the run a must be of rti_mpc.rti.simulation.Simulation, got 1"),
    "a plot of an array": (lambda rti: plot(np.zeros(3)), "run must be of rti_mpc.rti.simulation.Simulation, got array"),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_argument_of_a_simulation_is_one_line_that_names_it(rti: Rti, what: str) -> None:
    call, told = WRONG[what]
    with pytest.raises(RtiMpcError) as refusal:
        call(rti)
    assert told in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_runs_of_other_outputs_are_not_compared(run: Simulation, driven: Simulation) -> None:
    with pytest.raises(RtiMpcError, match="runs must have the same outputs to be compared, got others for eight"):
        compare({"line": run, "eight": driven})


def test_reference_of_one_output_may_be_a_vector() -> None:
    from tests.problems import cart

    ocp = Ocp(cart(), N=5, dt=0.2, Q=1, R=1e-6)
    rti = Rti(ocp, compile=False)
    rows = simulate(rti, ocp.phi(), [1.0] * 8)
    function = simulate(rti, ocp.phi(), lambda t: 0 * t + 1.0, samples=7)
    np.testing.assert_array_equal(rows.x, function.x)
