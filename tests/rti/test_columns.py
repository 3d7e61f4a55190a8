# SPDX-License-Identifier: Apache-2.0
"""Map over columns: the compiled one to the last bit that of CasADi, and which functions are left to CasADi."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from rti_mpc import codegen
from rti_mpc.codegen import bind, compiled
from rti_mpc.rti import columns
from rti_mpc.rti.columns import KNOWN, LEAST_COUNT, LEAST_SIZE, MOST_SIZE, over_columns
from tests.rti.test_recursion import needs_compiler

x, p = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
OF_NUMBERS = [ca.sin, ca.cos, ca.tan, ca.asin, ca.acos, ca.atan, ca.sinh, ca.cosh, ca.tanh, ca.exp, ca.log, ca.sqrt, ca.fabs]
EVERYTHING = ca.vertcat(
    *(f(x[0] / (1 + p[0]) * 0.5) for f in OF_NUMBERS),
    ca.atan2(x[1], p[1]),
    x[1] ** p[0],
    x[2] ** 1.7,
    1 / x[0] - x[1] * x[1] + (p[0] + p[0]) - 3.25,
    -x[2],
    x[2],
    1.5,
)


def one(found: ca.SX) -> ca.Function:
    return ca.Function("one", [x, p], [ca.densify(found)])


def long(count: int) -> ca.SX:
    """Return an expression of so many additions."""
    found = ca.SX(0)
    for k in range(count):
        found = found * x[k % 3] + 1.0 / (k + 1)
    return found


@needs_compiler
@pytest.mark.parametrize("long_vectors", [True, False], ids=["the longest vectors", "vectors of two"])
@pytest.mark.parametrize("count", [LEAST_COUNT, 5, 6, 7, 8, 21])
def test_each_column_is_to_the_last_bit_what_the_function_makes_of_it_alone(count: int, long_vectors: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """By all operations that a vector has, on numbers that are no multiple of its length as well."""
    monkeypatch.setattr(columns, "LEAST_SIZE", 0)
    if not long_vectors:
        monkeypatch.setattr(codegen, "longer_vectors", lambda: ())
    function = one(EVERYTHING)
    assert {function.instruction_id(k) for k in range(function.n_instructions())} == KNOWN - {ca.OP_ASSIGN}
    rng, found = np.random.default_rng(count), []
    given = [rng.uniform(0.1, 1.0, (count, size)) for size in (3, 2)]
    whole = over_columns(function, count)
    assert "over_columns" in whole.name()
    for each in (function.map(count), whole):
        symbols = [ca.MX.sym(f"a{k}", *each.size_in(k)) for k in range(2)]
        (fast,) = compiled(ca.Function(f"of_{count}", symbols, [each(*symbols)], ["a0", "a1"], ["y"]))
        found.append(np.zeros((count, EVERYTHING.numel())))
        bind(fast, {"a0": given[0], "a1": given[1]}, {"y": found[-1]})()
    np.testing.assert_array_equal(*found)
    assert np.isfinite(found[0]).all()


@pytest.mark.parametrize(
    ("function", "count"),
    [
        (one(long(LEAST_SIZE)), LEAST_COUNT - 1),
        (one(long(3)), LEAST_COUNT),
        (one(long(MOST_SIZE)), LEAST_COUNT),
        (one(long(LEAST_SIZE) + ca.floor(x[0])), LEAST_COUNT),
        (one(long(LEAST_SIZE) + np.inf * x[0]), LEAST_COUNT),
        (ca.Function("one", [y := ca.MX.sym("y", 3)], [ca.sin(y)]), LEAST_COUNT),
    ],
    ids=["few columns", "few instructions", "many instructions", "an operation that is not known", "an infinite constant", "no scalar expression"],
)
def test_map_is_that_of_casadi_where_vectors_gain_nothing_or_cannot_be_made(function: ca.Function, count: int) -> None:
    assert "over_columns" not in over_columns(function, count).name()


def test_map_of_a_long_function_is_in_columns() -> None:
    assert "over_columns" in over_columns(one(long(LEAST_SIZE)), LEAST_COUNT).name()
