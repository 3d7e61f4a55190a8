# SPDX-License-Identifier: Apache-2.0
"""Roles of signals: given by the model, and found whatever the names, units and places are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.errors import OcpError
from rti_mpc.model.model import Model, Signal
from rti_mpc.model.obstacle import discs_of, with_obstacles
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.signals import place, plane, quantity
from tests.robots import arm, glider, shuffled


def test_position_and_heading_are_found_wherever_they_are() -> None:
    model = shuffled()
    assert (plane(model.states), place(model.states, "heading")) == ((3, 4), 1)
    assert (plane(model.outputs), place(model.outputs, "heading")) == ((1, 2), 0)
    assert plane(arm().states) is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"outputs": (Signal("psi", "mm", role="x"), Signal("x", "m", role="y"))}, "the role x must be in m, got psi in mm"),
        ({"outputs": (Signal("psi", "m", role="x"), Signal("x", "m", role="x"))}, r"the role x must be one signal's of outputs, got \['psi', 'x'\]"),
        ({"states": (Signal("psi", "rad", role="heading"), Signal("x", "m"))}, "the role heading must be an angle, got psi without angle=True"),
        (
            {"states": (Signal("psi", "m", role="axle_offset"), Signal("x", "m"))},
            "the role of states must be x or y or heading or progress, got axle_offset for psi",
        ),
        ({"inputs": (Signal("u", "m/s", role="x"), Signal("v", "m/s"))}, "the role of inputs must be left out, got x for u"),
        ({"inputs": (Signal("u", "m/s", commands="speed"), Signal("v", "m/s"))}, "commands must be an input's, and name a state, got speed for u"),
    ],
)
def test_a_role_that_does_not_fit_is_refused_by_name(change: Any, said: str) -> None:
    with pytest.raises(OcpError, match=f"model glider: .*{said}"):
        replace(glider(), **change)


def test_state_that_an_input_commands_and_an_output_is_are_told() -> None:
    assert pioneer_3dx().counterparts() == {"inputs": ["u", "omega"], "outputs": ["x", "y", "psi"]}
    assert glider().counterparts() == {"inputs": ["", ""], "outputs": ["psi", "x"]}


def test_an_output_of_a_state_s_name_that_is_another_expression_is_not_taken_for_it() -> None:
    model = glider()
    ahead = replace(model, y_expr=model.x + ca.DM([0.1, 0.0]))
    assert ahead.counterparts()["outputs"] == ["", "x"]


def clearance(model: Model, x: list[float]) -> float:
    return float(ca.Function("h", [model.x, model.u, model.p], [model.h_expr])(x, np.zeros(model.nu), model.p_nominal))


def test_obstacles_are_kept_from_the_position_wherever_it_is_among_the_outputs() -> None:
    disc = [(1.0, 2.0, 0.5)]
    assert clearance(with_obstacles(shuffled(), disc), [0.0, 7.0, 0.0, 4.0, 6.0]) == pytest.approx(4.5)
    assert clearance(with_obstacles(glider(), disc), [4.0, 6.0]) == pytest.approx(4.5)


def test_obstacles_are_refused_where_no_outputs_are_a_position() -> None:
    with pytest.raises(OcpError, match=r"model arm: two outputs must be a position, with role x and role y, got .'x', 'elbow'."):
        with_obstacles(arm(), [(1.0, 2.0, 0.5)])


def test_a_parameter_of_a_disc_s_name_is_no_disc() -> None:
    named = replace(glider(), parameters=(Signal("disc_0_x", "1"),))
    assert discs_of(named) == []
    assert discs_of(with_obstacles(named, [])) == []
    assert discs_of(with_obstacles(glider(), [(1.0, 2.0, 0.5)])) == [(1, 1.0, 2.0, 0.5)]


def test_number_is_told_with_its_unit_unless_that_is_1() -> None:
    assert (quantity(0.12345, "m"), quantity(-2.0, "rad", "+.2f"), quantity(0.5, "1")) == ("0.123 m", "-2.00 rad", "0.5")
