# SPDX-License-Identifier: Apache-2.0
"""Blockage: which plans count as blocked, and how many of them in a row."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from rti_mpc.control.blockage import MIN_PROGRESS_RATIO, Blockage
from rti_mpc.model.model import Model, Signal
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from tests.problems import INF, double_integrator

N = 10
WALL = {"ubx": [0.0, INF]}  # at r = 0, where the mass stands
STANDING = {"lbx": [-INF, -INF, -INF, 0.0, -0.5], "ubx": [INF, INF, INF, 2.0, 0.5]}  # a car that cannot reverse


def looked(rti: Rti, blockage: Blockage, target: float, samples: int) -> list[bool]:
    """Plan from rest at r = 0 to a target, again and again."""
    changes = []
    for _ in range(samples):
        rti.prepare(np.tile([target, 0.0], (N, 1)), shift=False)
        assert rti.feedback(np.zeros(2)).usable
        changes.append(blockage.judge())
    return changes


def prepared(**changes: Any) -> tuple[Rti, Blockage]:
    rti = Rti(double_integrator(N=N, **changes), compile=False)
    return rti, Blockage(rti)


def bicycle() -> Model:
    """A car driven by its acceleration, steered by the rate of its front wheels."""
    x, u = ca.SX.sym("x", 5), ca.SX.sym("u", 2)
    pose = (Signal("x", "m"), Signal("y", "m"), Signal("psi", "rad", angle=True))
    f = ca.vertcat(x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), x[3] * ca.tan(x[4]) / 0.3, u[0], u[1])
    inputs = (Signal("a", "m/s^2"), Signal("rate", "rad/s"))
    return Model(
        name="bicycle", x=x, u=u, f_expl_expr=f, y_expr=x[:3], states=(*pose, Signal("v", "m/s"), Signal("delta", "rad")), inputs=inputs, outputs=pose
    )


def test_way_is_blocked_after_a_horizon_of_plans_that_get_nowhere_and_free_after_one_of_others() -> None:
    rti, blockage = prepared(**WALL)
    assert looked(rti, blockage, 1.0, N) == [False] * (N - 1) + [True]
    assert blockage.blocked
    assert not any(looked(rti, blockage, 1.0, 2 * N)), "said once"
    assert looked(rti, blockage, -1.0, N) == [False] * (N - 1) + [True]
    assert not blockage.blocked


def test_reason_names_the_state_beyond_whose_bounds_the_reference_lies() -> None:
    rti, blockage = prepared(**WALL)
    looked(rti, blockage, 1.0, 1)
    assert blockage.cause == "the reference lies beyond the bounds of r"


def test_reason_is_a_constraint_where_one_holds_the_plan() -> None:
    model = double_integrator().model
    rti = Rti(Ocp(model, N=N, dt=0.1, Q=[1, 0.1], R=[0.05], h_expr=model.x[0], uh=0.0), compile=False)
    blockage = Blockage(rti)
    assert looked(rti, blockage, 1.0, N)[-1]
    assert blockage.cause == "an obstacle or constraint holds it"


def test_a_bicycle_that_cannot_reverse_and_stands_beside_its_goal_is_not_blocked() -> None:
    """Standing touches the bound of its speed; nothing is in its way."""
    rti = Rti(Ocp(bicycle(), N=N, dt=0.1, Q=[1, 1, 0.05], R=[0.1, 0.1], lbu=-1.0, ubu=1.0, **STANDING), compile=False)
    blockage = Blockage(rti)
    for _ in range(2 * N):
        rti.prepare(np.tile([-0.5, 0.3, 0.0], (N, 1)), shift=False)
        assert rti.feedback(np.zeros(5)).usable
        assert not blockage.judge()
    assert blockage._squares[0] < MIN_PROGRESS_RATIO**2 * blockage._squares[1], "it stands short of the reference"


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
