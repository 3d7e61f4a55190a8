# SPDX-License-Identifier: Apache-2.0
"""The paper's own experiments in lockstep: Euler, N = N_u = 7, tangent heading, no bounds on increments; costs as converged solvers reach them."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.model.integrator import integrator
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.trajectory import Trajectory, eight, positioning, rows
from rti_mpc.rti.construction import FORMULATIONS
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import Rti
from tests.problems import INF, pioneer
from tests.slow import slow_but

SETTINGS = SolverSettings(eps=1e-6, max_iter=4000)


def closed_loop_cost(trajectory: Trajectory, duration_s: float, formulation: str) -> float:
    """
    Drive the continuous plant, and sum 28 ||e||_Q^2 + 0.8 ||dv||^2.

    The true state at k + 1 counts against the reference at k + 1, the heading
    unwrapped to the start, increments from 0. The first sample may iterate.
    """
    ocp = pioneer(method="euler", lbdu=-INF, ubdu=INF)
    model = pioneer_3dx()
    plant, p = integrator(model, "rk4", 20), np.array(model.p_nominal)
    rti = Rti(ocp, SETTINGS, formulation=formulation, compile=False)
    x: Array = np.array([*trajectory.pose0, 0.0, 0.0])
    samples = round(duration_s / 0.1)
    y = rows(trajectory.lasting(duration_s + 1.0), 0.1, "tangent")
    y[:, 2] += 2 * np.pi * np.round((x[2] - y[0, 2]) / (2 * np.pi))
    rti.reset(x, np.zeros(2))
    last, total = np.zeros(2), 0.0
    for k in range(samples):
        for i in range(30 if k == 0 else 1):
            rti.prepare(y[k + 1 : k + 8], shift=k > 0 and i == 0)
            assert rti.feedback(x).usable
        u = rti.u[0].copy()
        x = np.array(plant(x, u, p, 0.1)).ravel()
        e, du = x[:3] - y[k + 1], u - last
        total += 28.0 * (e * e) @ np.array([1.0, 1.0, 0.05]) + 0.8 * du @ du
        last = u
    return float(total)


@pytest.mark.parametrize("formulation", slow_but(FORMULATIONS, "sequential"))
def test_positioning_costs_what_converged_solvers_reach(formulation: str) -> None:
    assert closed_loop_cost(positioning(), 40.0, formulation) == pytest.approx(324.33, rel=0.005)


@pytest.mark.parametrize("formulation", slow_but(FORMULATIONS, "sequential"))
def test_eight_costs_no_more_than_one_exact_iteration_a_sample(formulation: str) -> None:
    """IPOPT, converged at every sample: 292.925; a plain real-time iteration with exact QPs: 293.63."""
    assert 285.0 < closed_loop_cost(eight(), 80.0, formulation) <= 294.4
