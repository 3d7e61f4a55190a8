# SPDX-License-Identifier: Apache-2.0
"""Agreement of two plans of one QP, in inputs or in costs."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.rti import Rti
from rti_mpc_service.check.agreement import agreement, cost
from tests.problems import double_integrator


@pytest.fixture(scope="module")
def solved() -> Rti:
    """A mass above its speed bound, whose last three inputs count for next to nothing; a linear problem, so that its QP is the problem itself."""
    ocp = double_integrator(delta=[1.0] * 7 + [0.0] * 3, lambda_=[1.0] * 8 + [1e-9] * 2, lbu=-1.0, ubu=1.0, ubx=[np.inf, 0.2])
    rti = Rti(ocp, solver="daqp", formulation="sequential", iterations=1, compile=False)
    rti.reset(np.array([0.0, 0.5]), np.zeros(1))
    rti.prepare(np.tile([1.0, 0.0], (10, 1)), shift=False)
    assert rti.feedback(np.array([0.0, 0.5])) is QpStatus.SOLVED
    assert rti.violation > 0.1
    return rti


def test_cost_of_inputs_in_the_qp_is_that_of_their_motion_with_the_slacks_it_needs(solved: Rti) -> None:
    ocp, rng = solved.ocp, np.random.default_rng(1)
    phi = ocp.phi().mapaccum(ocp.N)

    def driven(u: Array) -> float:
        y, du = np.array(phi(solved.x0, u.T, [])).T, np.diff(u.ravel(), prepend=0.0)
        e, s = y - solved.y_ref, np.maximum(0.0, y[:, 1] - ocp.ubx[1])
        return float(ocp.delta @ (e**2 @ np.diag(ocp.Q)) + ocp.lambda_ @ (ocp.R[0, 0] * du**2) + np.sum(ocp.z[1] * s + 0.5 * ocp.Z[1] * s**2))

    others = solved.u + 0.1 * rng.standard_normal((4, *solved.u.shape))
    above = [2.0 * (cost(solved, u) - cost(solved, solved.u)) / solved.cost_scale for u in others]
    np.testing.assert_allclose(above, [driven(u) - driven(solved.u) for u in others], rtol=1e-8)  # differences of costs 1e3 times as large


def test_plans_agree_that_differ_in_inputs_that_cost_nothing_and_others_do_not(solved: Rti) -> None:
    scale = np.ones(1)
    last, early = np.zeros_like(solved.u), np.zeros_like(solved.u)
    last[-1], early[3] = -1e-3, 1e-3  # away from the bound of the speed, which both are at
    assert not agreement(solved.u, solved.u + 1e-3 * last, scale, solved).flat, "these agree by their inputs"
    assert agreement(solved.u, solved.u + last, scale, solved).flat
    assert agreement(solved.u, solved.u - last, scale, solved).costs > 1e-4, "a softened bound is exceeded"
    assert agreement(solved.u, solved.u + early, scale, solved).costs > 1e-4
