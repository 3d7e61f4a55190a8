# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.errors import OcpError
from rti_mpc.model.disturbance import with_disturbances
from rti_mpc.model.robots.pioneer_3dx import NOMINAL_PARAMETERS, pioneer_3dx

X = np.array([0.1, -0.2, 0.7, 0.3, -0.4])
U = np.array([0.2, 0.5])


def slope(names: tuple[str, ...], u: Array, d: Array) -> Array:
    model = with_disturbances(pioneer_3dx(), names)
    f = ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr])
    return np.array(f(X, u, [*NOMINAL_PARAMETERS.values(), *d])).ravel()


def test_disturbance_of_an_input_is_added_to_it() -> None:
    np.testing.assert_array_equal(slope(("omega_c",), U, np.array([0.1])), slope((), U + np.array([0.0, 0.1]), np.zeros(0)))


def test_disturbance_of_a_state_is_added_to_its_derivative() -> None:
    expected = slope((), U, np.zeros(0)) + np.array([0.0, 0.03, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(slope(("u_c", "y"), U, np.array([0.0, 0.03])), expected, rtol=0, atol=1e-15)  # rounding


def test_disturbances_are_parameters_with_names_and_units() -> None:
    model = with_disturbances(pioneer_3dx(), ["u_c", "y"])
    assert [(s.name, s.unit) for s in model.parameters[-2:]] == [("d_u_c", "m/s"), ("d_y", "m/s")]
    assert model.p_nominal[-2:] == (0.0, 0.0)


def test_unknown_disturbance_is_refused_with_what_there_is() -> None:
    with pytest.raises(OcpError, match=r"of an input \(u_c, omega_c\) or of a state \(x, y, psi, u, omega\), got v"):
        with_disturbances(pioneer_3dx(), ["u_c", "v"])
