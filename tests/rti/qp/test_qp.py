# SPDX-License-Identifier: Apache-2.0
"""QPs of real samples against other solvers, through qpsolvers."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import pytest
import qpsolvers

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.qp.transcription import INFINITY
from rti_mpc.rti.rti import Rti
from tests.problems import INF, arc, beacon, double_integrator, pioneer
from tests.slow import slow_but

TIGHT = SolverSettings(eps=1e-9, max_iter=200_000)
OTHERS = {  # with their own tolerances, and how far inputs may differ
    "daqp": ({"primal_tol": 1e-10, "dual_tol": 1e-12}, 1e-6),
    "clarabel": ({"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-11}, 5e-6),  # stays sqrt(mu) away from a weakly active bound
}
NARROW = {"lbx": [-INF, -INF, -INF, -0.3, -0.4], "ubx": [INF, INF, INF, 0.3, 0.4]}  # so that state bounds are active, and exceeded

PROBLEMS: dict[str, Callable[[], Ocp]] = {
    "pioneer_euler": lambda: pioneer(method="euler"),
    "pioneer_rk4_with_state_bounds": lambda: pioneer(**NARROW),
    "pioneer_with_held_inputs": lambda: pioneer(N=10, N_u=4, **NARROW),
    "pioneer_of_the_demo": lambda: pioneer(N=20),
    "beacon": beacon,
    "double_integrator": lambda: double_integrator(lbu=-1.0, ubu=1.0, lbdu=-0.5, ubdu=0.5, lbx=[-INF, -0.2], ubx=[0.5, INF]),
}


def sample(ocp: Ocp, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """A state near a reference, and a previous input, with bounds active."""
    if ocp.model.name == "pioneer_3dx":
        y_ref = arc(rng.uniform(0, 60) + ocp.dt * np.arange(1, ocp.N + 1))
        x0 = np.concatenate([y_ref[0] + rng.normal(size=3) * [0.2, 0.2, 0.4], rng.uniform([-0.6, -0.9], [0.6, 0.9])])
        return x0, y_ref, rng.uniform([-0.5, -0.745], [0.5, 0.745])
    y_ref = rng.normal(size=(ocp.N, ocp.model.ny)) + ([5.8, 0.5] if ocp.model.name == "beacon" else 0.0)
    return rng.normal(size=ocp.model.nx), y_ref, 0.3 * rng.normal(size=ocp.model.nu)


# Soft bounds that are far exceeded are slow without Ruiz scaling: their multipliers have a long way to go.
SETTINGS = {"double_integrator": SolverSettings(eps=1e-9, max_iter=200_000, scaling=10)}


@functools.cache
def built(name: str, formulation: str) -> Rti:
    return Rti(PROBLEMS[name](), SETTINGS.get(name, TIGHT), formulation=formulation, solver="osqp", iterations=1, compile=False)


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("solver", OTHERS)
@pytest.mark.parametrize("formulation", ["simultaneous", "sequential"])
@pytest.mark.parametrize("states", slow_but([2, 8], 2))
def test_qp_agrees_with_other_solvers_to_1e_6(name: str, solver: str, formulation: str, states: int) -> None:
    options, atol = OTHERS[solver]
    rti = built(name, formulation)
    rng = np.random.default_rng(1)
    for _ in range(states):
        x0, y_ref, u_prev = sample(rti.ocp, rng)
        rti.reset(x0, u_prev)
        for _ in range(3):
            rti.prepare(y_ref, shift=False)
            before = rti.u.copy()
            assert rti.feedback(x0) is QpStatus.SOLVED
            problem = rti.qp.to_problem()
            theirs = qpsolvers.solve_problem(problem, solver, **options)
            assert theirs.found
            objective = 0.5 * theirs.x @ problem.P @ theirs.x + problem.q @ theirs.x
            assert rti.solver.objective == pytest.approx(objective, abs=1e-6, rel=1e-7)
            first = rti.x.size if formulation == "simultaneous" else 0
            np.testing.assert_allclose(rti.u, before + theirs.x[first : first + rti.u.size].reshape(rti.u.shape), rtol=0, atol=atol)


def test_problem_for_others_splits_rows_by_which_bounds_are_there() -> None:
    ocp = double_integrator(N=2, lbu=-1.0, ubx=[0.5, INF])
    qp = Rti(ocp, formulation="simultaneous", solver="osqp", compile=False).solvers[1].qp
    problem = qp.to_problem()
    equal = qp.l == qp.u
    assert problem.A.shape == (equal.sum(), len(qp.q)) == (6, len(qp.q))  # initial state and two stages
    assert problem.G.shape[0] == 2 + 2 + 2  # inputs from below, states from above, slacks from below
    assert np.isfinite(problem.h).all()
    assert np.abs(problem.h).max() < INFINITY
    P = problem.P.toarray()
    np.testing.assert_array_equal(P, P.T)
    np.testing.assert_array_equal(np.triu(P), qp.P.toarray())


def test_problem_for_others_is_a_copy() -> None:
    qp = Rti(double_integrator(lbu=-1.0), solver="osqp", compile=False).qp
    problem = qp.to_problem()
    problem.q[:] = 7.0
    problem.P.data[:] = 7.0
    assert not np.any(qp.q == 7.0)
    assert not np.any(qp.P.data == 7.0)
