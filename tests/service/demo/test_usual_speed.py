# SPDX-License-Identifier: Apache-2.0
"""How fast a demo drives a robot that is not told its speed."""

from __future__ import annotations

import pytest

from rti_mpc_service.demo.demo import usual_speed


@pytest.mark.parametrize(("dt_s", "speed"), [(0.1, 4.0), (0.05, 4.0), (0.02, 2.0), (0.01, 1.0), (0.002, 1.0)])
def test_robot_of_a_short_period_is_driven_more_slowly_yet_never_below_real_speed(dt_s: float, speed: float) -> None:
    """The quadrotor, 100 Hz, was never driven at 4 times real speed: its commands were ready after their stage of 2.5 ms."""
    assert usual_speed(dt_s) == pytest.approx(speed)
