# SPDX-License-Identifier: Apache-2.0
"""The certificate of a plan: a bound on its cost above the optimum, from the problem's own data, which wrong plans do not pass."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.active_set import ActiveSet
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
    assert one._verdict[1][0] >= more > 0.0


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


def test_a_penalty_that_gives_way_is_refined_or_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """With far too small a penalty a hard bound is exceeded: the status must not be SOLVED."""
    ocp = double_integrator(N=20, lbu=-1.0, ubu=1.0, lbx=[-np.inf, -0.3], ubx=[np.inf, 0.3])
    monkeypatch.setattr("rti_mpc.rti.active_set.PENALTY", 10.0)
    rti = Rti(ocp, iterations=1, compile=False)
    rti.reset(np.zeros(2), np.zeros(1))
    rti.prepare(np.tile([3.0, 0.0], (20, 1)), shift=False)
    monkeypatch.setattr("rti_mpc.rti.active_set.MAX_REFINEMENTS", 0)
    assert rti.feedback(np.zeros(2)) is not QpStatus.SOLVED
