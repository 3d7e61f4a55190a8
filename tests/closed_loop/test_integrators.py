# SPDX-License-Identifier: Apache-2.0
"""A stiff model and one in discrete time, in lockstep: the same integrator in problem, prediction, delay, observer, way to rest and plant."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from rti_mpc.contract.message import End, Reference
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.observer import Disturbance, Observer, ObserverSettings
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rest import find_stop_law
from rti_mpc.rti.rti import Rti
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, drive
from tests.rti.test_problem_class import lagging_car, sampled_car
from tests.slow import slow_but

CARS = {"stiff": lagging_car(method="irk", lbx=-np.inf, ubx=np.inf), "sampled": sampled_car(lbx=-np.inf, ubx=np.inf)}
SETTINGS = ObserverSettings({"v_c": Disturbance(drift=0.05, limit=0.2)})


@pytest.mark.parametrize(("name", "delay_s"), slow_but(product(CARS, (0.0, None)), ("stiff", None), ("sampled", 0.0)))
def test_car_follows_a_line_with_what_its_model_leaves_out_estimated_and_stops_at_its_end(name: str, delay_s: float | None) -> None:
    own = CARS[name]
    observer = Observer(own.model, SETTINGS, compile=False)
    ocp = Ocp(observer.model, N=10, dt=0.1, Q=own.Q, R=own.R, lbu=own.lbu, ubu=own.ubu, lbdu=own.lbdu, ubdu=own.ubdu)
    assert ocp.method == ("irk" if name == "stiff" else "discrete")
    assert find_stop_law(ocp) is None, "its inputs at rest stop it"
    controller = Controller(Rti(ocp, compile=False), Timing(delay_s=delay_s), observer=observer, compile=False)
    t = 0.1 * np.arange(100)
    y = np.column_stack([0.3 * t, 0.0 * t, 0.0 * t])
    controller.receive_reference(Reference(1, 1, 0, 100 * MS, End.STOP, y, np.zeros((len(y), 0))))
    plant = observer.model.with_parameters(d_v_c=-0.05)
    late_s = 0.0 if delay_s == 0.0 else 0.05
    body = Lockstep(RobotSettings(plant, np.array([0.0, 0.1, 0.2, *np.zeros(own.model.nx - 3)]), state_period_s=0.1, actuator_delay_s=late_s))
    run = drive(controller, body, 13.0)
    x = np.array(run.x)
    at = np.array(run.t_s)
    on_line = (at > 6.0) & (at < 9.5)
    np.testing.assert_allclose(x[on_line, 0], 0.3 * at[on_line], rtol=0, atol=3e-3)  # m: 1 % of a second's way
    np.testing.assert_allclose(x[on_line, 1], 0.0, rtol=0, atol=3e-3)
    np.testing.assert_allclose(run.u[-1], 0.0, rtol=0, atol=1e-9)
    assert not run.refused


def test_lag_of_10_ms_settles_within_one_percent_at_stages_of_100_ms() -> None:
    """On a plant that is the exact motion of the lag; RK4 is refused there."""
    ocp = lagging_car(method="irk", lbx=-np.inf, ubx=np.inf)
    exact = replace(ocp.model, method="rk4")
    rti = Rti(ocp, compile=False)
    body = Lockstep(RobotSettings(exact, np.zeros(5), state_period_s=0.1, substeps=100))
    x = body.x
    rti.reset(x, np.zeros(2))
    for _ in range(100):
        rti.prepare(np.tile([1.0, 0.0, 0.0], (ocp.N, 1)))
        assert rti.feedback(x).usable
        body._plant.advance(rti.u[0], 0.1)
    np.testing.assert_allclose(x[:3], [1.0, 0.0, 0.0], rtol=0, atol=0.01)
    np.testing.assert_allclose(x[3:], 0.0, rtol=0, atol=1e-3)
