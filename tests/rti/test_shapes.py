# SPDX-License-Identifier: Apache-2.0
"""Problems of every small shape, one-row matrices among them: they are built, and the solvers agree."""

from __future__ import annotations

from itertools import product
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.model.model import Model, Signal
from rti_mpc.model.obstacle import with_obstacles
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from tests.problems import INF, PAPER
from tests.slow import slow_but

SHAPES = [shape for shape in product((1, 2, 3), (1, 2, 3), (0, 1, 2), ((1, 1), (3, 1), (4, 2))) if sum(map(hash, shape[:3])) % 2]
FEWER = 7  # of which `make test` takes one; horizons change with each


def sparse(matrix: Array, vector: ca.SX) -> ca.SX:
    return ca.mtimes(ca.sparsify(ca.DM(matrix)), vector)


def random_ocp(nx: int, nu: int, nh: int, N: int, N_u: int) -> Ocp:
    """A problem whose matrices have structural zeros at random places, and bounds of every kind or none."""
    rng = np.random.default_rng((nx, nu, nh, N, N_u))
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    ny = int(rng.integers(1, nx + 1))
    A, B, C, D, H = ((rng.random(shape) < 0.5) * rng.normal(size=shape) for shape in ((nx, nx), (nx, nu), (nh, nx), (nh, nu), (ny, nx)))
    signals: list[tuple[Signal, ...]] = [
        tuple(Signal(f"{name}{i}", "1") for i in range(n)) for name, n in (("x", nx), ("u", nu), ("y", ny), ("h", nh))
    ]
    model = Model(
        name="random",
        x=x,
        u=u,
        f_expl_expr=ca.densify(sparse(A - np.eye(nx), x) + sparse(B, u) + 0.1 * ca.sin(x)),
        y_expr=ca.densify(sparse(H, x)),
        states=signals[0],
        inputs=signals[1],
        outputs=signals[2],
        h_expr=ca.densify(sparse(C, x) + sparse(D, u)) if nh else ca.SX(0, 1),
        constraints=signals[3],
    )
    bounds: dict[str, Any] = {"lbu": -1.0, "ubu": 1.0, "uh": np.full(nh, 0.2), "lh": np.where(rng.random(nh) < 0.5, -0.3, -INF)}
    if rng.random() < 0.5:
        bounds |= {"ubx": np.where(np.arange(nx) == 0, 0.3, INF), "lbdu": -0.4, "ubdu": 0.5}
    return Ocp(model, N=N, N_u=N_u, dt=0.2, Q=np.ones(ny), R=np.full(nu, 0.1), z=20.0, zh=20.0, **bounds)


def solved(ocp: Ocp, solver: str, formulation: str) -> Array:
    """Return the plan of one QP, shape ``(N_u, nu)``."""
    rti = Rti(ocp, solver=solver, formulation=formulation, iterations=1, compile=False)
    rti.reset(np.full(ocp.model.nx, 0.2), np.zeros(ocp.model.nu))
    rti.prepare(np.ones((ocp.N, ocp.model.ny)), shift=False)
    assert rti.feedback(np.full(ocp.model.nx, 0.25)) is QpStatus.SOLVED
    return rti.u.copy()


@pytest.mark.parametrize(
    ("nx", "nu", "nh", "horizons"), [pytest.param(*shape, marks=[pytest.mark.slow] * (number % FEWER > 0)) for number, shape in enumerate(SHAPES)]
)
def test_problem_of_any_shape_is_built_and_solved_alike(nx: int, nu: int, nh: int, horizons: tuple[int, int]) -> None:
    ocp = random_ocp(nx, nu, nh, *horizons)
    plan = solved(ocp, "riccati", "auto")
    for formulation in ("sequential", "simultaneous"):
        theirs = solved(ocp, "piqp", formulation)
        np.testing.assert_allclose(theirs, plan, rtol=0, atol=1e-4)  # what a gap of 1e-6 in the cost allows


@pytest.mark.parametrize(("discs", "speed_bound"), slow_but(product((1, 2), (INF, 0.5)), (1, INF), (2, 0.5)))
def test_the_shipped_robot_has_any_number_of_discs_with_and_without_bounds_on_states(discs: int, speed_bound: float) -> None:
    model = with_obstacles(pioneer_3dx(), [(1.0, 0.5, 0.3), (3.0, 3.0, 0.3)][:discs])
    ocp = Ocp(model, **PAPER | {"lh": 0.0, "lbx": -INF, "ubx": [INF, INF, INF, speed_bound, INF]})
    plan = solved(ocp, "riccati", "auto")
    np.testing.assert_allclose(solved(ocp, "daqp", "simultaneous"), plan, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("solver", "formulation"), [("riccati", "auto"), ("daqp", "sequential"), ("daqp", "simultaneous")])
def test_numbers_by_stage_and_input_of_a_single_stage_are_those_of_its_inputs(solver: str, formulation: str) -> None:
    """A row for the only stage is one column, as is a number for each stage."""
    alike = {"R_u": [0.1, 0.2], "lbu": [-0.4, -0.6], "ubu": [0.4, 0.6], "lbdu": [-0.2, -0.3], "ubdu": [0.2, 0.3]}
    by_stage: dict[str, Any] = {name: [numbers] for name, numbers in alike.items()}
    plan = solved(Ocp(pioneer_3dx(), **PAPER | {"N_u": 1, "lambda_": 0.8} | alike), solver, formulation)
    same = solved(Ocp(pioneer_3dx(), **PAPER | {"N_u": 1, "lambda_": [[0.8, 0.8]]} | by_stage), solver, formulation)
    np.testing.assert_allclose(same, plan, rtol=0, atol=1e-9)  # rounding
    assert np.abs(plan).max() > 0.1, "the robot is driven"
