# SPDX-License-Identifier: Apache-2.0
"""When the way counts as blocked: which plans, and how many of them in a row."""

from __future__ import annotations

from typing import Any

import numpy as np

from rti_mpc.control.blockage import Blockage
from rti_mpc.rti.rti import Rti
from tests.problems import INF, double_integrator

N = 10
WALL = {"ubx": [0.0, INF]}  # at r = 0, where the mass stands


def looked(rti: Rti, blockage: Blockage, target: float, samples: int) -> list[bool]:
    """Plan from rest at r = 0 to a target, again and again."""
    changes = []
    for _ in range(samples):
        rti.prepare(np.tile([target, 0.0], (N, 1)), shift=False)
        assert rti.feedback(np.zeros(2)).usable
        changes.append(blockage.look())
    return changes


def prepared(**changes: Any) -> tuple[Rti, Blockage]:
    rti = Rti(double_integrator(N=N, **changes), compile=False)
    return rti, Blockage(rti)


def test_way_is_blocked_after_a_horizon_of_plans_that_get_nowhere_and_free_after_one_of_others() -> None:
    rti, blockage = prepared(**WALL)
    assert looked(rti, blockage, 1.0, N) == [False] * (N - 1) + [True]
    assert blockage.blocked
    assert not any(looked(rti, blockage, 1.0, 2 * N)), "said once"
    assert looked(rti, blockage, -1.0, N) == [False] * (N - 1) + [True]
    assert not blockage.blocked


def test_a_plan_that_hesitates_for_less_than_a_horizon_is_not_blocked() -> None:
    rti, blockage = prepared(**WALL)
    for _ in range(3):
        assert not any(looked(rti, blockage, 1.0, N - 1) + looked(rti, blockage, -1.0, 1))


def test_a_robot_that_no_softened_bound_holds_is_slow_and_not_blocked() -> None:
    rti, blockage = prepared(lbu=-1e-6, ubu=1e-6, **WALL | {"ubx": [0.5, INF]})
    assert not any(looked(rti, blockage, 1.0, 2 * N))


def test_a_robot_at_a_bound_that_has_arrived_is_not_blocked() -> None:
    rti, blockage = prepared(**WALL)
    assert not any(looked(rti, blockage, -1e-5, 2 * N))


def test_another_life_of_the_robot_begins_free() -> None:
    rti, blockage = prepared(**WALL)
    looked(rti, blockage, 1.0, N)
    blockage.clear()
    assert not blockage.blocked
    assert looked(rti, blockage, 1.0, N)[-1]
