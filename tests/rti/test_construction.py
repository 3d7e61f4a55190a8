# SPDX-License-Identifier: Apache-2.0
"""Construction of a problem, which all of its `Rti` share."""

from __future__ import annotations

import gc
import time
import weakref

import numpy as np
import pytest

from rti_mpc.rti import construction, linearization
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from tests.problems import arc
from tests.problems import new_pioneer as pioneer

T = 0.1 * np.arange(1, 8)


def plans(rti: Rti) -> list[bytes]:
    """Plans of a few samples that start cold, away from the path."""
    x = np.array([0.1, -0.1, 1.0, 0.2, 0.0])
    rti.reset(x, np.zeros(2))
    found = []
    for k in range(10):
        rti.prepare(arc(T + 0.1 * k, 1.0), shift=k > 0)
        rti.feedback(x)
        x = rti.x[1].copy()
        found.append(rti.x.tobytes() + rti.u.tobytes())
    return found


@pytest.mark.parametrize("solver", ["riccati", "osqp"])
def test_further_rti_of_a_problem_gives_the_same_plans_bit_for_bit_and_shares_no_state(solver: str) -> None:
    ocp = pioneer()
    first, second = (Rti(ocp, solver=solver, compile=False) for _ in range(2))
    expected = plans(first)
    second.prepare(arc(T + 5.0))
    assert plans(second) == expected
    assert plans(Rti(pioneer(), solver=solver, compile=False)) == expected


def test_further_rti_of_a_problem_builds_no_expressions(monkeypatch: pytest.MonkeyPatch) -> None:
    built = []
    construct = construction.construct
    monkeypatch.setattr(construction, "construct", lambda *args: built.append(args) or construct(*args))
    ocp = pioneer()
    for further in (ocp, ocp, ocp.retuned(delta=2.0), ocp):
        Rti(further, compile=False)
    Rti(ocp, solver="osqp", compile=False)
    assert [args[0] is ocp for args in built] == [True, False, True], "once for the problem, once for the retuned one, once for another solver"


def test_problem_is_linearized_once_for_all_its_functions(monkeypatch: pytest.MonkeyPatch) -> None:
    built = []
    linearize = linearization.Linearization
    monkeypatch.setattr(linearization, "Linearization", lambda ocp: built.append(ocp) or linearize(ocp))
    ocp = pioneer()
    Rti(ocp, compile=False)
    Rti(ocp, solver="osqp", compile=False)
    assert [each is ocp for each in built] == [True]


def test_further_rti_of_a_problem_takes_less_than_a_tenth_of_the_first() -> None:
    """A thirtieth as measured, with compiled code in the cache, in CPU time."""
    ocp = pioneer(N=20)
    Rti(pioneer(N=20))
    took_s = []
    for _ in range(4):
        began_s = time.process_time()
        Rti(ocp)
        took_s.append(time.process_time() - began_s)
    assert min(took_s[1:]) < 0.1 * took_s[0]


def test_construction_is_forgotten_with_its_problem() -> None:
    ocp = pioneer()
    Rti(ocp, compile=False)
    gone: weakref.ref[Ocp] = weakref.ref(ocp)
    del ocp
    gc.collect()
    assert gone() is None
