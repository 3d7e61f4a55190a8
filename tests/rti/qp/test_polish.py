# SPDX-License-Identifier: Apache-2.0
"""Polishing: exact also where rows that act depend on each other, which OSQP's own is not."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.qp.polish import polished
from rti_mpc.rti.qp.qp import QpData
from rti_mpc.rti.rti import Rti
from tests.oracle import nlp
from tests.problems import pioneer
from tests.rti.test_problem_class import EXACT, PROBLEMS, around_a_bend


def corner(gradient: list[float]) -> QpData:
    """Two variables in a corner of three half-planes, x <= 0, y <= 0 and x + y <= 0: one of them says nothing."""
    qp = QpData()
    qp.P, qp.A = sp.csc_matrix(np.eye(2)), sp.csc_matrix(np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]))
    qp.q, qp.l, qp.u = np.array(gradient), np.full(3, -1e30), np.zeros(3)
    return qp


def test_multipliers_of_rows_that_depend_on_each_other_keep_their_signs() -> None:
    """The least ones would be 2/3, -1/3 and 1/3."""
    x, y = polished(corner([-1.0, 0.0]), np.array([1e-4, -2e-4]), np.array([0.999, 3e-4, 2e-4]))
    np.testing.assert_allclose(x, 0.0, rtol=0, atol=1e-12)  # rounding, which the regularization magnifies
    np.testing.assert_allclose(y, [1.0, 0.0, 0.0], rtol=0, atol=1e-3)  # not unique: next to those given
    assert y.min() > -1e-12


def test_rows_on_the_wrong_side_change_it() -> None:
    """The rough solution has x at its bound and y off its own; it is the other way round."""
    x, y = polished(corner([1.0, -0.5]), np.array([0.0, -0.3]), np.array([0.2, 0.0, 0.0]))
    np.testing.assert_allclose(x, [-1.0, 0.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(y, [0.0, 0.5, 0.0], rtol=0, atol=1e-12)


def test_rough_solution_stays_where_no_step_is_better(monkeypatch: pytest.MonkeyPatch) -> None:
    """One step is not enough here."""
    monkeypatch.setattr("rti_mpc.rti.qp.polish.STEPS", 1)
    x, y = np.array([0.0, -0.3]), np.array([0.2, 0.0, 0.0])
    same_x, same_y = polished(corner([1.0, -0.5]), x, y)
    np.testing.assert_array_equal(same_x, x)
    np.testing.assert_array_equal(same_y, y)


def test_a_refusal_of_an_earlier_sample_polishes_no_later_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """OSQP keeps what it said until it polishes again, which it is not asked for where no row acts."""
    calls = []
    monkeypatch.setattr("rti_mpc.rti.qp.osqp.polished", lambda qp, x, y: calls.append(1) or (x, y))
    monkeypatch.setattr("rti_mpc.rti.qp.osqp.POLISH_REFUSED", 0)  # what it says of a solve without
    rti = Rti(pioneer(N=5), SolverSettings(polish=5), formulation="sequential", solver="osqp", compile=False)
    rti.reset(np.zeros(5), np.zeros(2))
    for _ in range(3):
        rti.prepare(np.zeros((5, 3)))
        assert rti.feedback(np.zeros(5)) is QpStatus.SOLVED
    assert not calls


@pytest.mark.parametrize(
    ("name", "formulation", "place"), [("blocks", "simultaneous", 5), ("implicit integrator of three stages in two steps", "sequential", 3)]
)
def test_plan_at_bounds_that_depend_on_each_other_costs_what_ipopts_does(name: str, formulation: str, place: int) -> None:
    """A held input keeps a speed at its bound over several stages, which two of them determine. A slack costs 1000 a unit: 1e-9 of it would show."""
    ocp = PROBLEMS[name]()
    x0, y_ref, u_prev = around_a_bend(ocp, place + 1)[place]
    rti = Rti(ocp, EXACT, formulation=formulation, solver="osqp", compile=False)
    rti.reset(x0, u_prev)
    _, _, cost = nlp(ocp)(x0, u_prev, y_ref, rti.x, rti.u)
    for _ in range(20):
        rti.prepare(y_ref, shift=False)
        assert rti.feedback(x0) is QpStatus.SOLVED
    assert rti.cost == pytest.approx(cost, rel=1e-7)  # OSQP's residuals of 1e-9 at some stages, times the penalty
