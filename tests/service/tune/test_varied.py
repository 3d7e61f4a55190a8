# SPDX-License-Identifier: Apache-2.0
"""Keys that a study varies, checked at the door."""

from __future__ import annotations

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc_service.config.build import build_model
from rti_mpc_service.config.config import load
from rti_mpc_service.tune.varied import Varied, find_varied, with_values
from tests.robots import SHIPPED


def varied(*asked: str) -> tuple[Varied, ...]:
    config = load(SHIPPED, with_model=False)
    return find_varied(config, build_model(config), asked)


def test_weights_of_the_position_stay_unless_they_are_asked_for() -> None:
    assert [each.key for each in varied()] == ["ocp.weights.Q.psi", "ocp.weights.R.u_c", "ocp.weights.R.omega_c"]
    (psi, *_) = varied()
    assert (psi.low, psi.high, psi.today) == pytest.approx((0.0005, 5.0, 0.05))
    assert varied("ocp.weights.Q.x=0.1:10") == (Varied("ocp.weights.Q.x", 0.1, 10.0, 1.0),)
    assert varied("ocp.weights.delta", "ocp.N", "timing.delay_s") == (
        Varied("ocp.weights.delta", 0.28, 2800.0, 28.0),
        Varied("ocp.N", 10.0, 40.0, 20.0),
        Varied("timing.delay_s", 0.0, 0.2, 0.0),
    )


@pytest.mark.parametrize(
    ("asked", "complaint"),
    [
        ("ocp.dt_s", "--vary must name one of ocp.weights.Q.NAME, "),
        ("sim.actuator_lag_s=0:1", "--vary must name one of"),
        ("ocp.weights.Q.phi", "--vary ocp.weights.Q.phi must name one of x, y, psi, got 'phi'"),
        ("ocp.weights.Q.psi=1", "--vary must be KEY or KEY=LOW:HIGH, two numbers with LOW < HIGH, got 'ocp.weights.Q.psi=1'"),
        ("ocp.weights.Q.psi=2:1", "two numbers with LOW < HIGH"),
        ("ocp.weights.Q.psi=nan:1", "two numbers with LOW < HIGH"),
        ("ocp.weights.Q.psi=0:1", "must have a range above 0, got '0:1'"),
        ("ocp.weights.Q.psi=1:1e16", "ocp.weights.Q.psi .* at most"),
        ("ocp.N=5.5:10", "must have a range of whole numbers, got '5.5:10'"),
        ("ocp.N=5:5000", "ocp.N .* at most 1000, got 5000"),
        ("timing.delay_s=-1:1", "timing.delay_s"),
    ],
)
def test_range_that_does_not_fit_is_refused_in_one_line(asked: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as refusal:
        varied(asked)
    assert "\n" not in str(refusal.value)


def test_key_that_is_named_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"must name each key once, got ocp\.N twice"):
        varied("ocp.N", "ocp.N=5:10")


def test_values_that_are_tried_have_three_digits_and_stay_in_their_range() -> None:
    weight = Varied("ocp.weights.Q.psi", 0.12345, 0.98765, 0.5)
    assert [weight.rounded(value) for value in (0.12345, 0.333333, 0.98765)] == [0.12345, 0.333, 0.98765]
    config = with_values(load(SHIPPED, with_model=False), {"ocp.weights.Q.psi": 0.333, "ocp.weights.lambda": 2.0, "ocp.N": 12})
    assert (config.ocp.weights.Q["psi"], config.ocp.weights.lambda_, config.ocp.N) == (0.333, (2.0,), 12)
