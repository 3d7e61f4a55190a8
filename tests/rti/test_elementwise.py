# SPDX-License-Identifier: Apache-2.0
"""Elementwise functions of vectors: the loop in C against CasADi's virtual machine, and against numpy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from rti_mpc.codegen import compiled, function
from rti_mpc.rti.elementwise import IN_C, elementwise, largest, total
from tests.test_codegen import needs_compiler

COUNTS = [1, 2, 3, 4, 5, 33]  # below, at and above the length of a vector, with remainders


def every_operation(count: int) -> ca.Function:
    """Of two vectors and a number that is the same for all elements; each operation of the table is in it."""
    a, b, c = (ca.SX.sym(name) for name in "abc")
    sums = (a + b - c) * (a / b) + (-a) + a**2 + 2 * b + 1 / b
    ordered = ca.fmin(a, b) + ca.fmax(b, c) + (a < c) + ca.sqrt(ca.fabs(a))
    found = elementwise("every", {"a": a, "b": b, "c": c}, {"sums": sums, "ordered": ordered}, count, shared=("c",))
    given = {"a": ca.MX.sym("a", count), "b": ca.MX.sym("b", count), "c": ca.MX.sym("c")}
    return function("of_vectors", given, found(**given))


@needs_compiler
@pytest.mark.parametrize("count", COUNTS)
def test_each_element_is_what_the_expressions_give_compiled_or_not(count: int) -> None:
    rng = np.random.default_rng(count)
    a, b, c = rng.normal(size=count), rng.normal(size=count), 0.3
    sums = (a + b - c) * (a / b) - a + a**2 + 2 * b + 1 / b
    ordered = np.minimum(a, b) + np.maximum(b, c) + (a < c) + np.sqrt(np.abs(a))
    interpreted = every_operation(count)
    for one in (interpreted, *compiled(interpreted)):
        found = one(a=a, b=b, c=c)
        np.testing.assert_allclose(np.array(found["sums"]).ravel(), sums, rtol=1e-13)  # rounding of a sum whose terms may cancel
        np.testing.assert_allclose(np.array(found["ordered"]).ravel(), ordered, rtol=1e-13)


@needs_compiler
@pytest.mark.parametrize("taken", ["once", "twice"])
def test_results_that_nobody_takes_may_be_left(taken: str) -> None:
    """CasADi passes a null pointer for them."""
    a, vector = ca.SX.sym("a"), ca.MX.sym("a", 5)
    both = elementwise("both", {"a": a}, {"once": a + 1, "twice": 2 * a}, 5)
    interpreted = function("one_of_both", {"a": vector}, {"found": both(a=vector)[taken]})
    numbers = np.arange(5.0)
    for one in (interpreted, *compiled(interpreted)):
        np.testing.assert_array_equal(np.array(one(numbers)).ravel(), {"once": numbers + 1, "twice": 2 * numbers}[taken])


def test_function_of_no_elements_is_empty() -> None:
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    assert elementwise("none", {"a": a, "b": b}, {"sum": a + b}, 0, shared=("b",))(a=ca.DM(0, 1), b=1.0)["sum"].shape == (0, 1)


def test_operation_without_a_form_in_c_is_refused() -> None:
    a = ca.SX.sym("a")
    assert ca.OP_ATAN2 not in IN_C
    with pytest.raises(KeyError):
        elementwise("turned", {"a": a}, {"angle": ca.atan2(a, 1)}, 3)


@needs_compiler
@pytest.mark.parametrize("count", COUNTS)
def test_total_and_largest_take_every_number(count: int) -> None:
    x = ca.MX.sym("x", count)
    interpreted = function("reduced", {"x": x}, {"total": total(x), "largest": largest(x)})
    for one in (interpreted, *compiled(interpreted)):
        for i in range(count):
            numbers = np.where(np.arange(count) == i, 5.0, -1.0)
            found = one(x=numbers)
            assert float(found["total"]) == 5.0 - (count - 1)
            assert float(found["largest"]) == 5.0
