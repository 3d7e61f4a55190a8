# SPDX-License-Identifier: Apache-2.0
"""Default tolerance of OSQP, judged by closed-loop cost and not by residuals."""

from __future__ import annotations

import pytest

from rti_mpc.rti.construction import FORMULATIONS
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import Rti
from rti_mpc_service.bench.bench import closed_loop_cost
from rti_mpc_service.bench.families import paper_ocp
from tests.slow import slow_but

pytestmark = pytest.mark.usefixtures("interpreted")


@pytest.mark.parametrize("formulation", slow_but(FORMULATIONS, "sequential"))
def test_default_tolerance_of_osqp_costs_the_robot_no_more_than_one_ten_times_tighter(formulation: str) -> None:
    """Eight and positioning, every sample of both; both stop at the default limit of iterations."""
    default, tighter = (
        closed_loop_cost(7, False, Rti(paper_ocp(7), settings, formulation=formulation, solver="osqp"))
        for settings in (SolverSettings(), SolverSettings(eps=SolverSettings().eps / 10))
    )
    assert default <= tighter * (1 + 1e-4)
