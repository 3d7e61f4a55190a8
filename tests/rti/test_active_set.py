# SPDX-License-Identifier: Apache-2.0
"""Active-set solver on the recursion, against QPs solved by other solvers to 1e-9 or better."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.active_set import ActiveSet
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import Rti
from tests.problems import arc, beacon, double_integrator, fenced, pioneer
from tests.slow import slow_but
from tests.test_codegen import needs_compiler

TIGHT = SolverSettings(eps=1e-9, max_iter=200_000, scaling=10)

PROBLEMS: dict[str, Callable[[], Ocp]] = {
    "double_integrator": lambda: double_integrator(lbu=-1.0, ubu=1.0, lbdu=-0.5, ubdu=0.4, lbx=[-np.inf, -0.5], ubx=[np.inf, 0.6], z=3.0, Z=2.0),
    "beacon": beacon,
    "pioneer": lambda: pioneer(N=15),
    "pioneer_with_held_inputs": lambda: pioneer(N=15, N_u=4, lbdu=-np.inf, ubdu=np.inf),
    "pioneer_in_blocks": lambda: pioneer(N=15, blocks=[1, 2, 1, 3, 8]),
    "fenced": lambda: fenced(N=10),
}


def samples(ocp: Ocp, count: int) -> list[tuple[Array, Array, Array]]:
    """States, references and previous inputs, such that every kind of bound is active in many of them."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(count):
        if ocp.model.nx == 5:
            y_ref = arc(rng.uniform(0, 60) + ocp.dt * np.arange(1, ocp.N + 1))
            x0 = np.concatenate([y_ref[0] + rng.normal(size=3) * [0.2, 0.2, 0.4], rng.uniform([-0.4, -0.6], [0.4, 0.6])])
            u_prev = rng.uniform([-0.5, -0.745], [0.5, 0.745])
        else:
            y_ref = rng.normal(size=(ocp.N, ocp.model.ny)) + ([5.8, 0.5] if ocp.model.nx == 3 else 0.0)
            x0, u_prev = rng.normal(size=ocp.model.nx), 0.3 * rng.normal(size=ocp.model.nu)
        found.append((x0, y_ref, u_prev))
    return found


@pytest.mark.parametrize("name", slow_but(PROBLEMS, "double_integrator", "beacon", "pioneer_with_held_inputs"))
def test_plan_is_that_of_the_qp_solved_to_1e_9(name: str) -> None:
    ocp = PROBLEMS[name]()
    rti, exact = (Rti(ocp, solver=solver, formulation="sequential", iterations=1, compile=False) for solver in ("riccati", "daqp"))
    assert isinstance(rti.active_set, ActiveSet)
    found = 0
    for x0, y_ref, u_prev in samples(ocp, 40):
        for one in (rti, exact):
            one.reset(x0, u_prev)
        for _ in range(2):
            for one in (rti, exact):
                one.prepare(y_ref, shift=False)
                assert one.feedback(x0).usable
            if rti.solver is rti.active_set:
                found += 1
                assert exact.status is QpStatus.SOLVED
                np.testing.assert_allclose(rti.u, exact.u, rtol=0, atol=1e-5)
                np.testing.assert_allclose(rti.x, exact.x, rtol=0, atol=1e-5)
            for array, same in ((rti.x, exact.x), (rti.u, exact.u)):
                array[:] = same
    assert found >= 76  # of 80; a QP solver did the others


def test_bounds_that_act_are_remembered() -> None:
    """The next sample, a stage later, needs fewer roll-outs than a cold start."""
    ocp = double_integrator(N=20, lbu=-0.5, ubu=0.5)
    used, new = Rti(ocp, iterations=1, compile=False), Rti(ocp, iterations=1, compile=False)
    y_ref, x0 = np.tile([3.0, 0.0], (20, 1)), np.zeros(2)
    used.reset(x0, np.zeros(1))
    for _ in range(3):
        used.prepare(y_ref)
        assert used.feedback(x0) is QpStatus.SOLVED
        x0 = used.x[1].copy()
    assert np.count_nonzero(used.u == 0.5) > 2
    new.reset(x0, used.u[0])
    for rti in (used, new):
        rti.prepare(y_ref)
        assert rti.feedback(x0) is QpStatus.SOLVED
    assert used.solver.iterations < new.solver.iterations
    np.testing.assert_allclose(used.u, new.u, rtol=0, atol=1e-7)


def test_without_bounds_one_roll_out_is_exact() -> None:
    ocp = double_integrator()
    rti, exact = Rti(ocp, iterations=1, compile=False), Rti(ocp, TIGHT, solver="osqp", iterations=1, compile=False)
    for x0, y_ref, u_prev in samples(ocp, 10):
        for one in (rti, exact):
            one.reset(x0, u_prev)
            one.prepare(y_ref, shift=False)
            one.feedback(x0)
        assert rti.solver.iterations == 1
        np.testing.assert_allclose(rti.u, exact.u, rtol=0, atol=1e-7)


def held(refine: Callable[[Rti], None] | None = None) -> tuple[Rti, int]:
    """Solve one QP with increments at their bounds, perhaps with another refinement; return the solver and how often that was called."""
    ocp, calls = pioneer(N=15), 0
    rti = Rti(ocp, iterations=1, compile=False)
    assert rti.active_set is not None
    own = rti.active_set.refine

    def counted() -> None:
        nonlocal calls
        calls += 1
        if refine is None:
            own()
        else:
            refine(rti)

    rti.active_set.refine = counted
    x0, u_prev = np.array([0.1, 0.2, 0.2, 0.45, -0.7]), np.zeros(2)
    rti.reset(x0, u_prev)
    rti.prepare(arc(np.linspace(0.1, 1.5, 15)), shift=False)
    assert rti.feedback(x0) is QpStatus.SOLVED
    assert np.isclose(np.abs(np.diff(rti.u, axis=0, prepend=u_prev[None])), ocp.ubdu, rtol=0, atol=1e-12).any()
    return rti, calls


def test_plan_with_bounds_that_are_held_is_exact_to_rounding() -> None:
    """Its certificate would be content with 1e-6 of the cost."""
    rti, _ = held()
    assert rti.active_set is not None
    assert rti.active_set.res_dual < 1e-14


def test_refinement_that_makes_the_plan_worse_is_taken_back() -> None:
    def spoil(rti: Rti) -> None:
        rti.u += 0.01

    rti, calls = held(spoil)
    assert calls == 1
    planned = rti.u.copy(), rti.x.copy()
    assert rti.active_set is not None
    rti.active_set.roll_out()
    np.testing.assert_array_equal(planned[0], rti.u)
    np.testing.assert_array_equal(planned[1], rti.x)


HOLDING: dict[str, dict[str, Any]] = {"none held": {}, "the last held": {"N_u": 3}, "one alone": {"N_u": 1}, "blocks": {"blocks": [1, 3, 2]}}
NONE: dict[str, Any] = {"lbx": -np.inf, "ubx": np.inf, "lbdu": -np.inf, "ubdu": np.inf}
BOUNDED: dict[str, dict[str, Any]] = {
    "inputs": NONE,
    "nothing": NONE | {"lbu": -np.inf, "ubu": np.inf},
    "increments": NONE | {"lbdu": [-0.25, -0.4], "ubdu": [0.25, 0.4]},
    "all": {},
}


@needs_compiler
@pytest.mark.parametrize("holding", slow_but(HOLDING, "the last held"))
@pytest.mark.parametrize("bounded", slow_but(BOUNDED, "inputs"))
def test_compiled_code_has_the_plans_of_the_virtual_machine_whatever_is_held_and_bounded(holding: str, bounded: str) -> None:
    """Without softened bounds, stages that hold an input have no place, and no call of their own."""
    ocp = pioneer(N=6, **HOLDING[holding], **BOUNDED[bounded])
    assert (ocp.ng == 0) is (bounded != "all")
    compiled, interpreted = (Rti(ocp, compile=compile) for compile in (True, False))
    x = np.array([0.0, 0.3, 0.8, 0.0, 0.0])
    for rti in (compiled, interpreted):
        rti.reset(x, np.zeros(2))
    for k in range(20):
        for rti in (compiled, interpreted):
            rti.prepare(arc(0.1 * np.arange(k + 1, k + 7, dtype=float)))
            assert rti.feedback(x) is QpStatus.SOLVED
        np.testing.assert_allclose(compiled.u, interpreted.u, rtol=0.0, atol=1e-9)  # rounding, which a plan refined at held bounds may multiply
        x = interpreted.x[1].copy()
