# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.errors import OcpError
from rti_mpc.model.robots.quadrotor import quadrotor
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.terminal import lqr_weight
from rti_mpc.si import read
from tests.problems import double_integrator, pioneer
from tests.units import with_units

TIGHT = SolverSettings(eps=1e-9, max_iter=200_000)


def first_input(ocp: Ocp) -> float:
    rti = Rti(ocp, TIGHT)
    x0 = np.array([0.3, -0.2])
    rti.reset(x0, np.zeros(1))
    rti.prepare(np.zeros(rti.y_ref.shape), shift=False)
    rti.feedback(x0)
    return float(rti.u[0, 0])


@pytest.mark.slow
def test_a_short_horizon_with_the_regulators_weight_commands_what_a_long_one_does() -> None:
    """All states are outputs, so that only the previous input is taken at its best: close, and far closer than without."""
    long, short = first_input(double_integrator(N=200)), double_integrator(N=8)
    weight = lqr_weight(short, np.zeros(2), np.zeros(1))
    with_weight = first_input(double_integrator(N=8, Q_e=weight))
    assert abs(with_weight - long) < 0.1 * abs(first_input(short) - long)


def test_the_weight_is_symmetric_and_positive() -> None:
    weight = lqr_weight(pioneer(), np.array([0.0, 0.0, 0.3, 0.25, 0.1]), np.array([0.25, 0.1]))
    np.testing.assert_array_equal(weight, weight.T)
    assert np.linalg.eigvalsh(weight).min() > 0.0


def test_the_weight_is_the_same_in_any_units() -> None:
    """Of a hovering quadrotor whose y is in mm: what y costs was left out of the inverse as rounding, and its weight was four times as large."""
    plain = quadrotor()
    units = {"x": "km", "y": "mm", "z": "cm", "v_x": "km/h", "v_y": "mm/s", "phi": "deg", "theta": "deg"}
    found = []
    for model in (with_units(plain, {}), with_units(plain, units)):
        sizes = np.array([read(output.unit).size for output in model.outputs])
        ocp = Ocp(model, N=10, dt=0.01, Q=np.array([1.0, 1.0, 1.0, 0.1]) * sizes**2, R=[0.002] * 4)
        found.append(lqr_weight(ocp, np.zeros(12), np.array(model.u_rest)) / np.outer(sizes, sizes))
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-8)  # of weights of 0.4 to 2; 1e-11 is found


def test_a_wheeled_robot_at_rest_is_refused_because_it_cannot_be_stabilized() -> None:
    with pytest.raises(OcpError, match="must be stabilizable where a terminal weight is wanted"):
        lqr_weight(pioneer(), np.zeros(5), np.zeros(2))
