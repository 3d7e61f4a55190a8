# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.rti import Rti
from rti_mpc_service.warm_up import WARM_UP_SOLVES, warm_up
from tests.problems import double_integrator


class Watched(Rti):
    """Real-time iteration that notes each state it is given, and what it predicts."""

    def feedback(self, x0: Array) -> QpStatus:
        status = super().feedback(x0)
        self.seen = [*getattr(self, "seen", []), (x0.copy(), self.x[1].copy())]
        return status


def test_robot_of_the_warm_up_does_what_the_plan_says() -> None:
    """For a robot held in place, successive plans would fall further and further, out of all range."""
    rti = Watched(double_integrator(lbu=1.0, ubu=2.0), compile=False)
    warm_up(rti)
    assert len(rti.seen) == WARM_UP_SOLVES
    for (_, predicted), (x0, _) in zip(rti.seen, rti.seen[1:], strict=False):
        np.testing.assert_array_equal(x0, predicted)
