# SPDX-License-Identifier: Apache-2.0
"""The same robot in kilometres, millimetres, degrees and revolutions per minute, through what a user runs of the service."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.rti.rest import assess
from rti_mpc_service.check.check import check
from rti_mpc_service.commands.robot import lockstep_robot
from rti_mpc_service.config.build import build_ocp, build_rti, operating_rates, robot_settings
from rti_mpc_service.config.schema import Config
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import SHIPPED
from rti_mpc_service.tune.closed_loop import ClosedLoop, Course
from tests.units import PIONEER_TEXTS, document_with_units, size

pytestmark = pytest.mark.usefixtures("interpreted")

MODEL = pioneer_3dx()
STATES, OUTPUTS = (np.array([size(signal, PIONEER_TEXTS) for signal in signals]) for signals in (MODEL.states, MODEL.outputs))


def robots(*, bounded: bool = True) -> list[Config]:
    """The paper's robot in SI units and in others, both without roles; its sensors are noisy, and an observer estimates what its inputs lose."""
    document: dict[str, Any] = tomllib.loads(SHIPPED.read_text())
    del document["ocp"]["bounds"]["soft_weight"]
    document["observer"] = {"disturbances": {"u_c": {"drift": 0.05, "limit": 0.2}}}
    document["sim"] = {"noise_std": {"x": 1e-3, "psi": 1e-3}, "x0": {"x": 0.2, "psi": 0.3}}
    if not bounded:
        del document["ocp"]["bounds"]["inputs"]
    return [robot(document, "pioneer", {}), robot(document, "pioneer_in_other_units", PIONEER_TEXTS)]


def robot(document: dict[str, Any], name: str, units: Mapping[str, str]) -> Config:
    return Config.model_validate(document_with_units(document, MODEL, units) | {"model": {"name": f"tests.robots:{name}"}})


@pytest.mark.parametrize("name", ["sines", "steps"])
def test_references_of_outputs_are_the_same(name: str) -> None:
    x = np.array([0.1, -0.2, 0.3, 0.1, 0.2])
    plain, other = (find_scenario(config, name).y(x / of) for config, of in zip(robots(), (1.0, STATES), strict=True))
    np.testing.assert_allclose(other * OUTPUTS, plain, rtol=0, atol=1e-9)  # of rounding, in m and rad


def test_check_drives_it_to_the_same_bounds_and_stops_it_from_the_same_states() -> None:
    configs = robots()
    plain, other = (check(config, build_rti(config)) for config in configs)
    assert (other.statuses, other.missed, len(other.opinions)) == (plain.statuses, plain.missed, len(plain.opinions))
    plain_moved, other_moved = (assess(build_ocp(config), None, 50, compile=False).moved for config in configs)
    np.testing.assert_allclose(other_moved * STATES, plain_moved, rtol=1e-6)  # the tolerance of the integrator, which is relative


def test_simulated_robot_stands_at_the_same_rates() -> None:
    plain, other = map(operating_rates, robots())
    np.testing.assert_allclose(other * STATES, plain, rtol=1e-9)
    plain_x0, other_x0 = (np.array(robot_settings(config)["x0"]) for config in robots())
    np.testing.assert_allclose(other_x0 * STATES, plain_x0, rtol=1e-12)


@pytest.mark.parametrize("bounded", [True, False])
def test_it_is_driven_the_same_way_and_tuned_by_the_same_numbers(bounded: bool) -> None:
    """Controller, observer and simulator in lockstep; the effort of inputs without bounds is relative to one SI unit."""
    plain, other = (ClosedLoop(config, Course("sines", duration_s=6.0), lockstep_robot).drive({}) for config in robots(bounded=bounded))
    assert other.effort == pytest.approx(plain.effort, rel=1e-8)  # 1e-13 is found
    np.testing.assert_allclose(np.array(other.outputs) * OUTPUTS, plain.outputs, rtol=1e-8)
    assert (other.fallbacks, plain.fallbacks) == (0, 0)
