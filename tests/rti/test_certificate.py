# SPDX-License-Identifier: Apache-2.0
"""The certificate of a plan: a bound on its cost above the optimum, from the problem's own data, which wrong plans do not pass."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.active_set import MAX_STEPS, ActiveSet
from rti_mpc.rti.rti import Rti
from tests.problems import double_integrator, pioneer
from tests.rti.test_active_set import PROBLEMS, samples


def active(rti: Rti) -> ActiveSet:
    assert rti.active_set is not None
    return rti.active_set


@pytest.mark.parametrize("name", PROBLEMS)
def test_plan_that_is_solved_has_a_gap_below_a_millionth(name: str) -> None:
    rti = Rti(PROBLEMS[name](), iterations=1, compile=False)
    solved = 0
    for x0, y_ref, u_prev in samples(rti.ocp, 20):
        rti.reset(x0, u_prev)
        rti.prepare(y_ref, shift=False)
        if rti.feedback(x0) is QpStatus.SOLVED:
            solved += 1
            assert rti.solver.res_prim <= 1e-9
            assert -1e-15 <= rti.solver.res_dual <= 1e-6  # rounding below
    assert solved >= 19


@pytest.mark.parametrize("by", [1e-3, 1e-2])
def test_gap_is_at_least_what_a_worse_plan_costs_more(by: float) -> None:
    """A linear problem whose plan and states are moved together; the multipliers are those of the optimum, or 1.5 times as large."""
    ocp = double_integrator(lbu=-1.0, ubu=1.0, lbdu=-0.5, ubdu=0.4)
    rti = Rti(ocp, iterations=1, compile=False)
    x0, y_ref = np.array([0.5, -0.3]), np.tile([2.0, 0.0], (ocp.N, 1))
    rti.reset(x0, np.zeros(1))
    rti.prepare(y_ref, shift=False)
    assert rti.feedback(x0) is QpStatus.SOLVED
    least = rti.cost
    inside = rti.u - by * np.sign(rti.u)
    phi = ocp.phi()
    rti.u[:] = inside
    for k in range(ocp.N):
        rti.x[k + 1] = np.array(phi(rti.x[k], rti.u[k], [])).ravel()
    more = 0.5 * rti.cost_scale * (rti.cost - least)  # the QP is half the cost, normalised
    one = active(rti)
    one._judged()
    assert one._verdict[1] >= more > 0.0


def test_plan_that_breaks_dynamics_or_a_bound_is_not_certified() -> None:
    rti = Rti(pioneer(), iterations=1, compile=False)
    for x0, y_ref, u_prev in samples(rti.ocp, 3):
        rti.reset(x0, u_prev)
        rti.prepare(y_ref, shift=False)
        assert rti.feedback(x0) is QpStatus.SOLVED
        one = active(rti)
        for array in (rti.x, rti.u):
            kept = array.copy()
            array[3] += 1e-7
            assert one._judged() is not QpStatus.SOLVED
            array[:] = kept
            assert one._judged() is QpStatus.SOLVED


def test_multiplier_toward_a_bound_that_does_not_exist_is_none() -> None:
    """A roll-out whose places have not settled makes such ones; the gap of its plan is what an interior point starts with."""
    rti = Rti(double_integrator(ubdu=0.4), iterations=1, compile=False)
    rti.reset(np.zeros(2), np.zeros(1))
    rti.prepare(np.tile([0.01, 0.0], (10, 1)), shift=False)
    assert rti.feedback(np.zeros(2)) is QpStatus.SOLVED
    one = active(rti)
    certify, verdict = one.certify, one._verdict
    certify()
    before = verdict[1]
    multipliers = np.asarray(one._best[-1][1])
    multipliers[:] = -1.0  # toward a lower bound
    certify()
    assert verdict[1] == pytest.approx(before, abs=1e-12), "rounding of the gap of an optimum"


@pytest.mark.parametrize("steps", [0, MAX_STEPS])
def test_plan_of_a_penalty_that_gives_way_is_made_by_the_interior_point_or_told(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With far too small a penalty a roll-out exceeds a hard bound: such a plan must not be SOLVED."""
    ocp = double_integrator(N=20, lbu=-1.0, ubu=1.0, lbx=[-np.inf, -0.3], ubx=[np.inf, 0.3])

    def status(rti: Rti) -> QpStatus:
        rti.reset(np.zeros(2), np.zeros(1))
        rti.prepare(np.tile([3.0, 0.0], (20, 1)), shift=False)
        return rti.feedback(np.zeros(2))

    exact = Rti(ocp, iterations=1, compile=False)
    assert status(exact) is QpStatus.SOLVED
    monkeypatch.setattr("rti_mpc.rti.places.PENALTY", 10.0)
    monkeypatch.setattr("rti_mpc.rti.active_set.MAX_MOVES", 0)
    monkeypatch.setattr("rti_mpc.rti.active_set.MAX_REFINEMENTS", 0)
    monkeypatch.setattr("rti_mpc.rti.active_set.MAX_STEPS", steps)
    rti = Rti(ocp, iterations=1, compile=False)
    assert (status(rti) is QpStatus.SOLVED) == (steps > 0)
    if steps:
        np.testing.assert_allclose(rti.u, exact.u, rtol=0, atol=2e-3)  # a gap of 1e-6 of the cost leaves inputs open that hardly matter to it
