# SPDX-License-Identifier: Apache-2.0
"""Solvers of qpsolvers: chosen by name, judged by status, without memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import qpsolvers

from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import OcpError
from rti_mpc.rti.construction import FORMULATIONS
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.qp.qpsolvers import indexed_problem
from rti_mpc.rti.rti import Rti
from tests.problems import INF, beacon, double_integrator, fenced, solve

NAMES = ("clarabel", "daqp", "piqp")


def rti(name: str = "daqp", formulation: str = "simultaneous", **changes: Any) -> Rti:
    return Rti(double_integrator(lbu=-1.0, ubu=1.0, **changes), formulation=formulation, solver=name, iterations=1, compile=False)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("build", [beacon, fenced])
def test_matrices_updated_in_place_are_those_of_the_problem_written_anew(build: Any, name: str, formulation: str) -> None:
    """Hessian and constraints change from sample to sample; dense for a solver of dense problems alone."""
    one = Rti(build(), formulation=formulation, solver=name, iterations=1, compile=False)
    for seed in (1, 2):
        assert solve(one, seed) is QpStatus.SOLVED
        ours, anew = one.solver._problem, one.solver._scaled.to_problem()
        for part in "PGA":
            mine, theirs = getattr(ours, part), getattr(anew, part).toarray()
            np.testing.assert_array_equal(mine if name == "daqp" else mine.toarray(), theirs)
        for part in "qhb":
            np.testing.assert_array_equal(getattr(ours, part), getattr(anew, part))


def test_numbering_the_matrices_leaves_them_as_they_were() -> None:
    one = rti()
    solve(one, 1)
    before = one.qp.P.toarray(), one.qp.A.toarray()
    numbers = indexed_problem(one.qp)
    assert np.abs(numbers.A.data).max() <= one.qp.A.nnz
    np.testing.assert_array_equal(one.qp.P.toarray(), before[0])
    np.testing.assert_array_equal(one.qp.A.toarray(), before[1])


@pytest.mark.parametrize("name", NAMES)
def test_same_sample_gives_the_same_bits_whatever_was_solved_before(name: str) -> None:
    one = rti(name)
    solve(one, 1)
    first = one.u.copy()
    solve(one, 2)
    assert np.abs(one.u - first).max() > 0.01
    solve(one, 1)
    np.testing.assert_array_equal(one.u, first)


def test_softened_bounds_come_last_here_too() -> None:
    one = rti(lbx=[-INF, -0.1], ubx=[INF, 0.1])
    one.prepare(np.zeros((10, 2)), shift=False)
    assert one.feedback(np.zeros(2)) is QpStatus.SOLVED
    assert one.solver is one.solvers[0]
    assert solve(one, 1) is QpStatus.SOLVED
    assert one.violation > 0.0
    assert one.solver is one.solvers[1]


@pytest.mark.parametrize("name", NAMES)
def test_nan_never_reaches_the_solver_and_the_next_sample_is_solved(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    one = rti(name)
    solve(one, 1)
    plan = one.u.copy()
    solver, asked = one.solver, []
    monkeypatch.setattr(solver, "call", lambda inner=solver.call: asked.append(1) or inner())
    y_ref, x0 = np.zeros((10, 2)), np.zeros(2)
    one.prepare(y_ref * np.nan, shift=False)
    assert one.feedback(x0) is QpStatus.FAILED
    one.prepare(y_ref, shift=False)
    assert one.feedback(x0 * np.nan) is QpStatus.FAILED
    assert not asked
    np.testing.assert_array_equal(one.u, plan)
    one.prepare(y_ref, shift=False)
    assert one.feedback(x0) is QpStatus.SOLVED
    assert asked


@pytest.mark.parametrize(("name", "status"), [("clarabel", QpStatus.INFEASIBLE), ("daqp", QpStatus.FAILED), ("piqp", QpStatus.INFEASIBLE)])
def test_infeasible_problem_is_told_by_its_status_and_its_iterate_not_taken(name: str, status: QpStatus) -> None:
    """DAQP tells qpsolvers only that there is no solution."""
    one = rti(name)
    solve(one, 1)
    plan = one.x.copy(), one.u.copy()
    one.prepare(np.zeros((10, 2)), shift=False)
    below = one.solver._problem.G
    below[:] = 0.0 if isinstance(below, np.ndarray) else below * 0.0  # 0 z <= h, and h negative
    one.qp.l[one.solver._below] = 1.0
    assert one.feedback(np.zeros(2)) is status
    np.testing.assert_array_equal(one.x, plan[0])
    np.testing.assert_array_equal(one.u, plan[1])


def test_whatever_a_solver_raises_is_a_failed_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    one = rti()
    solve(one, 1)

    def fail() -> None:
        raise ValueError("not for me")

    monkeypatch.setattr(one.solver, "call", fail)
    assert solve(one, 2) is QpStatus.FAILED
    monkeypatch.undo()
    assert solve(one, 2) is QpStatus.SOLVED


def test_solver_that_cannot_solve_is_refused_when_it_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("no licence")

    monkeypatch.setattr(qpsolvers, "solve_problem", fail)
    with pytest.raises(OcpError, match="solver daqp must be able to solve, it raised RuntimeError: no licence"):
        rti("daqp")


@pytest.mark.parametrize("name", ["dapq", "gurobi"])
def test_solver_that_is_not_here_is_refused_with_those_that_are_and_how_to_get_others(name: str) -> None:
    with pytest.raises(OcpError) as refusal:
        rti(name)
    line = str(refusal.value)
    assert "\n" not in line
    for words in ("riccati, osqp", "daqp", f"got '{name}'", "pip install 'qpsolvers[NAME]'", "gurobi", "proxqp"):
        assert words in line


def test_settings_of_osqp_are_refused_for_another_solver() -> None:
    with pytest.raises(OcpError, match=r"settings are OSQP's.* for 'daqp'"):
        Rti(double_integrator(), SolverSettings(), solver="daqp", compile=False)


@pytest.mark.parametrize("name", NAMES)
def test_residuals_are_those_of_the_solution(name: str) -> None:
    one = rti(name)
    solve(one, 1)
    qp, z = one.qp, one.qp.z
    Az = qp.A @ z
    assert np.maximum(qp.l - Az, Az - qp.u).max() == pytest.approx(one.solver.res_prim, abs=1e-12)
    assert one.solver.res_prim < 1e-8
    assert one.solver.res_dual < 1e-8
    assert (one.solver.iterations > 0) is (name == "piqp")  # the others do not tell
