# SPDX-License-Identifier: Apache-2.0
"""Other weights and bounds for a running real-time iteration: equal to one built with them, and reached without a jump of the inputs."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.control.envelope import Envelope
from rti_mpc.control.tuning import Tuning
from rti_mpc.errors import OcpError
from rti_mpc.rti.construction import FORMULATIONS
from rti_mpc.rti.ocp import WEIGHTS_AND_BOUNDS, Ocp
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import BUILT_IN_SOLVERS, Rti
from tests.problems import INF, arc, double_integrator, fenced, pioneer
from tests.slow import slow_but

TIGHT = SolverSettings(eps=1e-9, max_iter=200_000)
OTHER: dict[str, Any] = {
    "Q": [2.0, 0.5, 0.0],
    "R": [0.3, 3.0],
    "delta": np.linspace(10.0, 40.0, 7),
    "lambda_": 1.7,
    "lbu": [-0.2, -0.5],
    "ubu": [0.3, 0.4],
    "lbdu": [-0.1, -0.2],
    "ubdu": [0.15, 0.1],
    "lbx": [-INF, -INF, -INF, -0.1, -0.3],
    "ubx": [INF, INF, INF, 0.2, 0.3],
    "z": 50.0,
}


def values(ocp: Ocp) -> dict[str, Array]:
    return {name: getattr(ocp, name) for name in WEIGHTS_AND_BOUNDS}


def plan(rti: Rti, samples: int = 12) -> tuple[Array, Array, float]:
    """The plan after some samples from a cold start, in which bounds on inputs, increments and states act."""
    model, N, dt = rti.ocp.model, rti.ocp.N, rti.ocp.dt
    x0 = np.zeros(model.nx)
    rti.reset(x0, np.array(model.u_rest))
    for k in range(samples):
        t = 3.0 + dt * (k + np.arange(1, N + 1))
        rti.prepare(arc(t) if model.ny == 3 else np.column_stack([np.sin(t), np.cos(t)]))
        assert rti.feedback(x0).usable
        x0 = rti.x[1] + 0.003 * np.cos(k)
    return rti.x.copy(), rti.u.copy(), rti.cost


@pytest.mark.parametrize(
    ("formulation", "solver"), slow_but(product(FORMULATIONS, BUILT_IN_SOLVERS), ("simultaneous", "riccati"), ("sequential", "osqp"))
)
def test_retuned_iteration_plans_like_one_built_so(formulation: str, solver: str) -> None:
    """Nearly: it keeps the scales it was built with, and with them how stiffly bounds hold, when it iterates once more, and where OSQP stops."""
    how: dict[str, Any] = {"formulation": formulation, "solver": solver, "compile": False}
    wanted = pioneer(**OTHER)
    retuned = Rti(pioneer(), TIGHT, **how)
    before = plan(retuned)
    retuned.retune(values(wanted))
    x, u, cost = plan(Rti(wanted, TIGHT, **how))
    assert np.abs(before[1] - u).max() > 0.1
    tolerance = 1e-5 if solver == "riccati" else 1e-4
    for ours, built in zip(plan(retuned), (x, u, cost), strict=True):
        np.testing.assert_allclose(ours, built, rtol=tolerance, atol=tolerance)
    retuned.retune(values(retuned.ocp))
    for ours, built in zip(plan(retuned), before, strict=True):
        np.testing.assert_allclose(ours, built, rtol=tolerance, atol=tolerance)


def test_weights_that_no_sample_changes_reach_the_solver_too() -> None:
    """A linear problem: its matrices are filled once."""
    wanted = double_integrator(Q=[0.2, 3.0], R=[0.5])
    how: dict[str, Any] = {"formulation": "simultaneous", "solver": "osqp", "compile": False}
    retuned = Rti(double_integrator(), TIGHT, **how)
    retuned.retune(values(wanted))
    np.testing.assert_allclose(plan(retuned)[1], plan(Rti(wanted, TIGHT, **how))[1], rtol=0, atol=1e-6)  # OSQP stops at a residual


def test_terminal_and_general_weights_are_taken_over() -> None:
    wanted = fenced(Q_e=[1.0, 2.0, 3.0], lh=[0.1, -INF], uh=[INF, 0.3], zh=1.0, Zh=0.5)
    retuned = Rti(fenced(), TIGHT, compile=False)
    retuned.retune(values(wanted))
    np.testing.assert_allclose(plan(retuned)[1], plan(Rti(wanted, TIGHT, compile=False))[1], rtol=0, atol=1e-6)  # how stiffly bounds hold


# Without a bump.


def drive(rti: Rti, tuning: Tuning, samples: int, seed: int = 1) -> Array:
    """Inputs of some samples along a fast reference, from the state the rti holds, shape ``(samples, nu)``."""
    rng = np.random.default_rng(seed)
    sent = []
    x0 = rti.x[1].copy()
    u_prev = rti.u[0].copy()
    for k in range(samples):
        tuning.begin()
        tuning.follow(u_prev)
        rti.prepare(arc(20.0 + 0.3 * (k + np.arange(1, 8))), u_prev=u_prev)
        assert rti.feedback(x0).usable
        u_prev = rti.u[0].copy()
        sent.append(u_prev)
        x0 = rti.x[1] + 0.002 * rng.standard_normal(5)
    return np.array(sent)


def test_bound_below_the_present_input_is_approached_within_the_slew_limits_old_and_new() -> None:
    rti = Rti(pioneer(), compile=False)
    tuning = Tuning(rti)
    rti.reset(np.zeros(5), np.zeros(2))
    before = drive(rti, tuning, 15)
    assert before[-1, 0] > 0.45
    slow = pioneer(ubu=[0.1, 0.745], lbdu=[-0.06, -0.4])
    tuning.change(slow, 7)
    assert tuning.version == 0, "nothing acts before the next sample"
    after = drive(rti, tuning, 15)
    assert tuning.version == 7
    steps = np.diff(np.vstack([before[-1:], after]), axis=0)
    assert steps[:, 0].min() >= -0.06 - 1e-12  # rounding
    reached = int(np.argmax(after[:, 0] <= 0.1 + 1e-12))
    assert reached == np.ceil((before[-1, 0] - 0.1) / 0.06) - 1, "no slower than the limits allow"
    assert after[reached:, 0].max() <= 0.1 + 1e-12


def test_bounds_by_stage_yield_to_an_input_outside_those_of_the_first_and_come_back_as_fast_as_it_may() -> None:
    """Such an input is left by a plan that was sent again, whose later rows had wider bounds."""
    ubu = np.column_stack([[0.1, 0.1, 0.3, 0.3, 0.5, 0.5, 0.5], np.full(7, 0.745)])
    rti = Rti(pioneer(ubu=ubu), compile=False)
    envelope = Envelope(rti.ocp, compile=False)
    tuning = Tuning(rti, envelope)
    rti.reset(np.zeros(5), np.array([0.45, 0.0]))
    rti.u[0] = rti.u_prev
    sent = drive(rti, tuning, 1)
    np.testing.assert_allclose(envelope.bounds["ubu"][:3, 0], [0.2, 0.1, 0.3], rtol=0, atol=1e-12)
    sent = np.vstack([[0.45, 0.0], sent, drive(rti, tuning, 6)])
    np.testing.assert_allclose(sent[:3, 0], [0.45, 0.2, 0.1], rtol=0, atol=1e-9)
    assert sent[2:, 0].max() <= 0.1 + 1e-12
    np.testing.assert_array_equal(envelope.bounds["ubu"], ubu)


def test_weights_and_bounds_keep_their_shape() -> None:
    tuning = Tuning(Rti(pioneer(), compile=False))
    with pytest.raises(
        OcpError, match=r"lbu must keep its shape \(2,\), got \(7, 2\): whether it differs from stage to stage is part of the compiled"
    ):
        tuning.change(pioneer(ubu=[[0.4, 0.7]] * 7), 1)


def test_first_increment_keeps_the_old_slew_limits_and_the_next_the_new_ones() -> None:
    rti = Rti(pioneer(lbdu=[-0.02, -0.1], ubdu=[0.02, 0.1]), compile=False)
    tuning = Tuning(rti)
    rti.reset(np.zeros(5), np.zeros(2))
    before = drive(rti, tuning, 4)
    tuning.change(pioneer(), 1)
    steps = np.diff(np.vstack([before[-1:], drive(rti, tuning, 3)]), axis=0)
    assert np.abs(steps[0]).max() <= 0.1 + 1e-12
    assert steps[0, 0] == pytest.approx(0.02, abs=1e-12)
    assert steps[1, 0] > 0.1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"N": 8}, "N must stay 7, got 8"),
        ({"dt": 0.05}, "dt must stay 0.1"),
        ({"method": "euler"}, "method must stay rk4"),
        ({"ubu": [0.5, INF]}, "ubu must be finite exactly where it was when compiled"),
        ({"ubx": [9.0, INF, INF, 0.5, 0.745]}, "ubx must be finite exactly where it was when compiled"),
    ],
    ids=["N", "dt", "integrator", "bound_gone", "bound_new"],
)
def test_structure_is_refused(changes: dict[str, Any], words: str) -> None:
    tuning = Tuning(Rti(pioneer(), compile=False))
    with pytest.raises(OcpError, match=words.replace(".", r"\.")):
        tuning.change(pioneer(**changes), 1)
