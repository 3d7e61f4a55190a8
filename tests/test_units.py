# SPDX-License-Identifier: Apache-2.0
"""Generated code in several translation units: the same numbers as in one."""

from __future__ import annotations

import shutil
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from rti_mpc import codegen
from rti_mpc import units as division
from rti_mpc.codegen import bind, compiled, with_bodies
from rti_mpc.units import units

pytestmark = pytest.mark.usefixtures("optimizing")
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler on this machine")
STAGES = 3
LONG = 50  # of a unit in these tests, so that the compiler is soon done


@pytest.fixture(autouse=True)
def short_units(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(division, "LONG", LONG)


def stage(terms: int) -> ca.Function:
    """A stage of so many products of a state and parameters."""
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p", terms)
    after = ca.sum1(p * ca.sin(x[0])) + ca.fmax(x[1], 0), ca.dot(p, x[1] * p) / terms + 1
    return ca.Function("stage", [x, p], [ca.vertcat(*after)], ["x", "p"], ["after"])


def recursion(terms: int) -> ca.Function:
    """Such stages, called in a loop."""
    x, p = ca.MX.sym("x", 2, STAGES), ca.MX.sym("p", terms)
    return ca.Function("stages", [x, p], [stage(terms).map(STAGES)(x, p)], ["x", "p"], ["after"])


def generated(function: ca.Function) -> str:
    generator = ca.CodeGenerator("functions", {"with_header": False})
    generator.add(function)
    return with_bodies(generator.dump())


def test_long_function_without_loops_is_a_unit_of_its_own_and_short_ones_stay_as_they_are() -> None:
    short, long = generated(recursion(3)), generated(recursion(LONG))
    assert units(short) == [short]
    rest, alone = units(long)
    assert all("sin(" in source for source in (long, alone)) and "sin(" not in rest
    assert "for (" in rest.split("/* stages:")[1] and len(rest) < len(long) / 2
    assert "arg[1]? arg[1][5] : 0;" in long and "arg[1]?" not in alone


@needs_compiler
@pytest.mark.parametrize("refuses", [False, True], ids=["spared passes", "a compiler that cannot spare them"])
def test_units_give_the_numbers_of_the_expressions_to_the_last_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refuses: bool) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if refuses:
        monkeypatch.setattr(codegen, "resolved", lambda *_: "")
    interpreted, rng = recursion(LONG), np.random.default_rng(1)
    (fast,) = compiled(interpreted)
    assert fast.class_name() == "External"
    x, p, results = rng.normal(size=(STAGES, 2)), rng.normal(size=LONG), [np.zeros((STAGES, 2)) for _ in range(2)]
    for function, after in zip((interpreted, fast), results, strict=True):
        bind(function, {"x": x, "p": p}, {"after": after})()
    assert np.all(results[0] != 0.0) and np.array_equal(*results)


@needs_compiler
def test_argument_of_a_unit_that_is_not_given_counts_as_zeros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (fast,) = compiled(stage(LONG))
    x, after = np.array([1.0, 2.0]), np.zeros(2)
    buffer, evaluate = fast.buffer()
    buffer.set_arg(0, x.data)
    buffer.set_res(0, after.data)
    evaluate()
    assert after.tolist() == [2.0, 1.0]
