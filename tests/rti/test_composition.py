# SPDX-License-Identifier: Apache-2.0
"""Functions in turn, as one call: compiled against the virtual machine, and results in the memory of arguments."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from rti_mpc.codegen import bind, compiled, function, with_bodies
from rti_mpc.rti.composition import compose
from tests.rti.test_recursion import needs_compiler

SYMBOLS = {name: ca.MX.sym(name, 2) for name in "xyz"}
ALL = ca.MX.sym("all", 6)
SUM = function("sum_of_two", {"x": SYMBOLS["x"], "y": SYMBOLS["y"]}, {"sum": SYMBOLS["x"] + SYMBOLS["y"]})
PRODUCT = function("product_of_two", {"y": SYMBOLS["y"], "z": SYMBOLS["z"]}, {"product": SYMBOLS["y"] * SYMBOLS["z"]})
COLUMN = function("column", {"all": ALL}, {"total": ca.sum1(ALL)})
IN_TURN = (COLUMN, {}), (SUM, {"x": ("all", 1), "y": ("all", 4)}), (PRODUCT, {"y": "sum", "z": "before", "product": "after"})


@pytest.mark.parametrize("machine", ["virtual", pytest.param("own", marks=needs_compiler)])
def test_each_function_takes_parts_of_arguments_and_results_of_those_before(machine: str) -> None:
    """And the last result may lie where an argument lies that only its function takes."""
    whole = compose("whole", IN_TURN, ["after", "total"])
    (call,) = compiled(whole) if machine == "own" else [whole]
    column, before, total = np.arange(6.0), np.array([2.0, -1.0]), np.zeros(1)
    bind(call, {"all": column, "before": before}, {"after": before, "total": total})()
    assert total == 15
    np.testing.assert_array_equal(before, [2 * (1 + 4), -1 * (2 + 5)])


def test_all_results_are_returned_if_none_are_chosen() -> None:
    assert compose("whole", IN_TURN).name_out() == ["total", "sum", "after"]


@needs_compiler
def test_code_of_functions_in_turn_is_that_of_each_once() -> None:
    generator = ca.CodeGenerator("functions", {"with_header": False})
    for one in (SUM, compose("whole", IN_TURN), compose("twice", [(SUM, {}), (SUM, {"x": "sum", "sum": "twice"})])):
        generator.add(one)
    assert with_bodies(generator.dump()).count("/* sum_of_two:") == 1


def test_argument_of_another_pattern_is_refused() -> None:
    diagonal = ca.MX.sym("y", ca.Sparsity.diag(2))
    other = function("other", {"y": diagonal}, {"trace": ca.trace(diagonal)})
    with pytest.raises(ValueError, match=r"^whole: y of other must be 2x2,2nz, got 2x2$"):
        compose("whole", [(function("full", {"y": ca.MX.sym("y", 2, 2)}, {"z": ca.MX(1)}), {}), (other, {})])
