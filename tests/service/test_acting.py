# SPDX-License-Identifier: Apache-2.0
"""Bounds that act in a plan, whatever unit its signals have."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from rti_mpc.model.model import Model
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc_service.acting import DISTANCE, at_bounds, unit
from rti_mpc_service.config.config import load
from rti_mpc_service.replay.plan import acting_bounds
from rti_mpc_service.shipped import ROBOTS


def test_a_plan_that_lies_at_its_only_bound_along_all_of_it_is_at_it() -> None:
    values = np.array([0.0, 0.5, 0.9, 2.0]) * DISTANCE
    below, above = at_bounds(values, 0.0, np.inf, unit(0.0, np.inf))
    assert below.tolist() == [True, True, True, False]
    assert not above.any()


@pytest.mark.parametrize("of", [1e-6, 1.0, 1e6])
def test_why_names_the_stages_of_an_input_with_one_bound_in_any_unit(of: float) -> None:
    """A cart that may only be pushed ahead, to a place behind it after one in front."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    model = Model(name="cart", x=x, u=u, f_expl_expr=ca.vertcat(x[1], u / of - x[1]), y_expr=x[0], states=("r", "v"), inputs="F", outputs="r")
    rti = Rti(Ocp(model, N=8, dt=0.1, Q=1.0, R=1e-3 / of**2, lbu=0.0, ubu=np.inf), compile=False)
    rti.reset(np.zeros(2), np.array([0.4 * of]))
    rti.prepare(np.concatenate([np.full((3, 1), 0.1), np.full((5, 1), 0.02)]))
    assert rti.feedback(np.zeros(2)).usable
    assert 0.0 < rti.u[0, 0] < 10.0 * of
    (found,) = acting_bounds(rti, load(ROBOTS["pioneer_3dx"]))
    assert (found["kind"], found["side"]) == ("input", "lower")
    assert found["stages"] == np.flatnonzero(rti.u[:, 0] < 1e-9 * of).tolist()
