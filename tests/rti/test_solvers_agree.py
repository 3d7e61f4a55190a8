# SPDX-License-Identifier: Apache-2.0
"""Agreement of all solvers in both formulations on the same random problems."""

from __future__ import annotations

from collections import Counter

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.model.model import Model, Signal
from rti_mpc.rti.construction import FORMULATIONS
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import Rti

TIGHT = SolverSettings(eps=1e-9, max_iter=500_000, scaling=10)  # bounds that are far exceeded are slow without Ruiz scaling
SOLVERS: dict[str, SolverSettings | None] = {"osqp": TIGHT, "daqp": None, "clarabel": None}  # the others are as exact by themselves


def random_ocp(rng: np.random.Generator, *, of_inputs: bool) -> Ocp:
    """A random model, not linear, with outputs and a constraint that are not either; weights and bounds random, the control horizon shorter."""
    nx, nu, ny = (int(n) for n in rng.integers([2, 1, 1], [5, 3, 4]))
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    A, B, C = (ca.DM(0.5 * rng.normal(size=shape)) for shape in ((nx, nx), (nx, nu), (ny, nx)))
    E, F = ca.DM(rng.normal(size=(nx, nx))), ca.DM(rng.normal(size=(1, nx)))
    model = Model(
        name="random",
        x=x,
        u=u,
        f_expl_expr=A @ x + B @ u + 0.3 * ca.sin(E @ x),
        y_expr=C @ x + 0.2 * ca.sin(C @ x) + (0.5 * x[0] * u[0] + 0.3 * u[0] if of_inputs else 0),
        states=tuple(Signal(f"x{i}", "1") for i in range(nx)),
        inputs=tuple(Signal(f"u{i}", "1") for i in range(nu)),
        outputs=tuple(Signal(f"y{i}", "1") for i in range(ny)),
    )
    N = int(rng.integers(4, 9))
    N_u = int(rng.integers(2, N))
    wide, pace, room = rng.uniform(0.3, 1.0, nu), rng.uniform(0.1, 0.5, nu), rng.uniform(0.3, 1.0, nx)
    root = rng.normal(size=(ny, ny))
    return Ocp(
        model,
        N=N,
        N_u=N_u,
        dt=0.1,
        Q=root @ root.T + np.eye(ny),
        R=rng.uniform(0.1, 1.0, nu),
        delta=rng.uniform(0.5, 2.0, N),
        lambda_=rng.uniform(0.5, 2.0, N_u),
        Q_e=rng.uniform(0.0, 5.0, ny),
        lbu=-wide,
        ubu=wide,
        lbdu=-pace,
        ubdu=pace,
        lbx=np.where(rng.random(nx) < 0.5, -room, -np.inf),
        ubx=room,
        z=rng.uniform(0.5, 20.0, nx),
        Z=rng.uniform(0.5, 20.0, nx),
        h_expr=F @ x + 0.3 * u[0] * x[0] + 0.1 * ca.cos(x[0]),
        lh=-0.5,
        uh=0.5,
        zh=rng.uniform(0.5, 20.0),
        Zh=rng.uniform(0.5, 20.0),
    )


def at_bounds(ocp: Ocp, u: Array, u_prev: Array) -> dict[str, bool]:
    """Which kinds of hard bounds hold a plan."""
    du = np.diff(np.vstack([u_prev, u]), axis=0)
    return {
        "inputs": bool(np.any(np.minimum(u - ocp.lbu, ocp.ubu - u) < 1e-7)),
        "increments": bool(np.any(np.minimum(du - ocp.lbdu, ocp.ubdu - du) < 1e-7)),
    }


@pytest.mark.slow
def test_all_solvers_give_the_same_plan_in_either_formulation_on_random_problems() -> None:
    structures, samples = 8, 25
    rng = np.random.default_rng(3)
    seen: Counter[str] = Counter()
    for structure in range(structures):
        ocp = random_ocp(rng, of_inputs=structure % 2 == 1)
        recursion = Rti(ocp, TIGHT, iterations=1, compile=False)
        others = {
            (solver, formulation): Rti(ocp, settings, solver=solver, formulation=formulation, iterations=1, compile=False)
            for solver, settings in SOLVERS.items()
            for formulation in FORMULATIONS
        }
        for _ in range(samples):
            x0, u_prev = 0.7 * rng.normal(size=ocp.model.nx), rng.uniform(ocp.lbu, ocp.ubu)
            y_ref, defects = rng.normal(size=(ocp.N, ocp.model.ny)), 0.1 * rng.normal(size=recursion.x.shape)
            for rti in (recursion, *others.values()):
                rti.reset(x0, u_prev)
                rti.x[:] += defects  # and so another linearization at every stage
                rti.prepare(y_ref, shift=False)
                status = rti.feedback(x0)
                left = rti is recursion and rti.solver is not rti.active_set  # what the recursion leaves to OSQP is not certified
                assert status is (QpStatus.INACCURATE if left else QpStatus.SOLVED)
            for which, rti in others.items():
                for name in "xu":
                    np.testing.assert_allclose(getattr(rti, name), getattr(recursion, name), rtol=0, atol=1e-6, err_msg=str(which))
            seen["problems"] += 1
            seen["held inputs"] += ocp.N_u < ocp.N
            seen["recursion"] += recursion.solver is recursion.active_set
            seen["softened"] += recursion.violation > 1e-3
            seen.update(kind for kind, acts in at_bounds(ocp, recursion.u, u_prev).items() if acts)
    problems = structures * samples
    assert seen["problems"] == seen["held inputs"] == problems
    assert seen["recursion"] >= 0.9 * problems  # OSQP is there for the rest
    assert min(seen["inputs"], seen["increments"], seen["softened"]) >= 0.5 * problems
