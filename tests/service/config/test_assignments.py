# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc_service.config.assignments import assigned, assigned_numbers
from rti_mpc_service.config.build import with_initial_state
from rti_mpc_service.config.config import load
from rti_mpc_service.request import parse_assignments
from rti_mpc_service.shipped import SHIPPED

RULE = "--x0 must be NAME=VALUE, the value a finite number in the state's unit"


def test_each_key_has_its_value() -> None:
    assert assigned(RULE, ["x=1", " y = -2e-3 ", "z=a=b"]) == {"x": "1", "y": "-2e-3", "z": "a=b"}
    assert assigned_numbers(RULE, ["x=1", " y = -2e-3 "]) == {"x": 1.0, "y": -2e-3}


@pytest.mark.parametrize("assignment", ["x=nan", "x=inf", "x=-inf", "x=1e999", "x=", "x", "=3", "", "x=1=2", "x=one"])
def test_initial_state_that_is_no_finite_number_is_refused_with_the_assignment(assignment: str) -> None:
    with pytest.raises(ConfigError) as refused:
        with_initial_state(load(SHIPPED), ["y=0.5", assignment])
    assert str(refused.value) == f"{RULE}, got {assignment!r}"


def test_initial_state_is_that_of_the_file_but_for_what_is_assigned() -> None:
    config = with_initial_state(load(SHIPPED), ["x=0.5", "psi=-1"])
    assert config.sim.x0 == {**load(SHIPPED).sim.x0, "x": 0.5, "psi": -1.0}


@pytest.mark.parametrize("parse", [parse_assignments, lambda given: with_initial_state(load(SHIPPED), given)], ids=["params", "x0"])
def test_key_that_is_assigned_twice_is_refused(parse: object) -> None:
    assert callable(parse)
    with pytest.raises(ConfigError, match="each key once, got x twice"):
        parse(["x=1", "y=2", "x=1"])


def test_parameter_without_a_key_is_refused() -> None:
    with pytest.raises(ConfigError, match="params must be set by KEY=VALUE, the value as in the file, got '=3'"):
        parse_assignments(["=3"])
    assert parse_assignments(["ocp.bounds.states.u=[-inf, 1.0]"]) == {"ocp.bounds.states.u": [-math.inf, 1.0]}


def test_decimal_comma_of_a_parameter_is_told() -> None:
    with pytest.raises(ConfigError, match=r"got 'ocp\.weights\.Q\.x=0,5': decimals take a point"):
        parse_assignments(["ocp.weights.Q.x=0,5"])


@pytest.mark.parametrize(("given", "meant"), [("phi=1", "perhaps psi [rad] is meant, got 1"), ("q=2", "known: x [m], y [m], psi [rad], u [m/s]")])
def test_initial_state_that_the_model_lacks_is_told_by_the_option_as_it_was_typed(given: str, meant: str) -> None:
    with pytest.raises(ConfigError) as refused:
        with_initial_state(load(SHIPPED), ["x=1", given])
    assert str(refused.value).startswith(f"--x0 {given.partition('=')[0]} is no state of the model, {meant}")
