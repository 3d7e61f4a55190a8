# SPDX-License-Identifier: Apache-2.0
"""Homotopy of the active set: against QPs solved by DAQP, one place at a time, and where changing all places at once goes in circles."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled
from rti_mpc.rti import active_set
from rti_mpc.rti.homotopy import MAX_STILL, move
from rti_mpc.rti.rti import Rti
from rti_mpc_service.bench.families import paper, quadrotor
from tests.rti.test_active_set import PROBLEMS, samples
from tests.rti.test_interior_point import driven
from tests.rti.test_recursion import needs_compiler


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let places change by the homotopy only, as often as they have to."""
    monkeypatch.setattr(active_set, "MAX_ROLL_OUTS", 0)
    monkeypatch.setattr(active_set, "MAX_CHANGES", np.inf)
    monkeypatch.setattr(active_set, "MAX_MOVES", 500)


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("name", PROBLEMS)
def test_homotopy_ends_at_the_plan_of_the_qp_solved_by_another_solver(name: str) -> None:
    ocp = PROBLEMS[name]()
    rti, exact = (Rti(ocp, solver=solver, formulation="sequential", iterations=1, compile=False) for solver in ("riccati", "daqp"))
    moved = 0
    for x0, y_ref, u_prev in samples(ocp, 30):
        for one in (rti, exact):
            one.reset(x0, u_prev)
            one.prepare(y_ref, shift=False)
            assert one.feedback(x0).usable
        assert rti.active_set is not None
        assert rti.solver is rti.active_set
        assert rti.active_set.steps == 0, "no way goes in circles"
        moved += rti.active_set.roll_outs > 0
        np.testing.assert_allclose(rti.u, exact.u, rtol=0, atol=1e-5)
    assert moved >= (10 if name != "beacon" else 0), "whose bounds hardly act at the start"


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("name", ["pioneer", "fenced"])
def test_each_move_leads_to_the_next_segment_of_one_row_and_leaves_all_others_on_theirs(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[Array, Array]] = []
    ocp = PROBLEMS[name]()
    rti = Rti(ocp, iterations=1, compile=False)
    one = rti.active_set
    assert one is not None
    move_on = one.move_on

    def watched() -> None:
        move_on()
        seen.append((one._places.copy(), one._point.copy()))

    monkeypatch.setattr(one, "move_on", watched)
    for x0, y_ref, u_prev in samples(ocp, 10):
        rti.reset(x0, u_prev)
        rti.prepare(y_ref, shift=False)
        before = np.zeros(0)
        seen.clear()
        assert rti.feedback(x0).usable
        for places, point in seen:
            assert np.isfinite(point).all()
            assert (point[np.abs(places) == 1] >= 0.0).all(), "a multiplier has its sign on the whole way"
            if before.size:
                changed = places != before
                assert 1 <= changed.sum() <= 3, "rows that come to their ends at once change at once"
                assert (np.abs(places - before)[changed] == 1).all(), "segments meet their neighbours only"
            before = places


@needs_compiler
def test_compiled_move_is_that_of_the_expressions() -> None:
    rng, rows = np.random.default_rng(3), 40
    way = move(rows)
    (fast,) = compiled(way)
    for trial in range(200):  # into the memory of the places, of the point and of the count, as on the way
        places = rng.choice([-2.0, -1.0, 0.0, 1.0, 2.0], rows)
        found = np.where(rng.random(rows) < 0.1, places + np.where(places == 0, rng.choice([-1.0, 1.0], rows), -np.sign(places)), places)
        numbers = {name: rng.normal(size=rows) for name in ("point", "targets")}
        if trial % 2:  # rows that are at their ends already, which change together
            at_end = (places == 0) & (found != 0)
            numbers["point"][at_end], numbers["targets"][at_end] = found[at_end], 2.0 * found[at_end]
        numbers["still"] = np.array([float(rng.integers(2 * MAX_STILL))])
        given = {"places": places, "places_found": found, **numbers, "lower": -np.ones(rows), "upper": np.ones(rows), "most": np.full(rows, 2.0)}
        expected = way(**given)
        bind(fast, given, {"places_next": places, "point_next": numbers["point"], "still_next": numbers["still"]})()
        np.testing.assert_array_equal(places, np.array(expected["places_next"]).ravel())
        np.testing.assert_array_equal(numbers["point"], np.array(expected["point_next"]).ravel())
        np.testing.assert_array_equal(numbers["still"], np.array(expected["still_next"]).ravel())


@pytest.mark.parametrize("compile", [pytest.param(True, marks=needs_compiler), False])
def test_rows_at_their_ends_change_together_until_some_moves_have_led_nowhere(compile: bool) -> None:
    """Then only the first of them does, until a move leads on again: together they may take turns for ever."""
    rows, still = 4, np.zeros(1)
    places, found, point, targets = (np.array(values) for values in ([0.0] * 4, [0, 1.0, 1, 1], [0, 1.0, 1, 0], [1.0, 2, 3, 4]))
    given = {"places": places, "places_found": found, "point": point, "targets": targets, "still": still}
    given |= {"lower": np.full(rows, -1.0), "upper": np.ones(rows), "most": np.full(rows, 2.0)}
    changed, after = np.zeros(rows), np.zeros(rows)
    way = compiled(move(rows))[0] if compile else move(rows)
    advance = bind(way, given, {"places_next": changed, "point_next": after, "still_next": still})
    seen = []
    for _ in range(MAX_STILL + 1):
        advance()
        seen.append(changed.tolist())
        assert after.tolist() == [0.0, *(0.0 if place else now for place, now in zip(changed[1:], point[1:], strict=True))], "nobody moves"
    assert seen == [[0.0, 1.0, 1.0, 0.0]] * MAX_STILL + [[0.0, 1.0, 0.0, 0.0]]
    assert still[0] == MAX_STILL + 1
    point[1:3] = 0.0
    advance()
    assert changed.tolist() == [0.0, 0.0, 0.0, 1.0], "the last one comes to its end after a quarter of the way, the others after more"
    assert still[0] == 0.0


def test_places_that_go_in_circles_when_all_change_at_once_settle_one_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The paper's second trajectory from its start, in a short horizon: without the homotopy these samples are left to the interior point."""
    family = paper(7)

    def steps() -> int:
        rti = Rti(family.ocp, compile=False)
        one = rti.active_set
        assert one is not None
        return sum(one.steps for _ in driven(family, rti, range(800, 830)))

    assert steps() == 0
    monkeypatch.setattr(active_set, "MAX_CHANGES", 0)
    assert steps() > 20


@pytest.mark.slow
@needs_compiler
def test_rows_of_a_quadrotor_that_come_to_their_bounds_together_do_not_take_turns() -> None:
    """Behind a jump of its reference, inputs without thrust left their bound and came back together in one QP of sample 362, in turns of three."""
    family = quadrotor(20, bounded=True)
    rti = Rti(family.ocp)
    one = rti.active_set
    assert one is not None
    steps = [one.steps for _ in driven(family, rti, range(364))]
    assert sum(steps[361:]) == 0
    assert sum(steps) > 0, "the QP of the jump itself has more changes than a way is followed with"


def test_places_change_one_at_a_time_as_soon_as_more_change_at_once_than_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """From rest, far off the path, 17 places change at once, then 14, 8 and 9; from there on they would go in circles."""
    family = paper(20)
    rti = Rti(family.ocp, compile=False)
    one = rti.active_set
    assert one is not None
    changed: list[list[float]] = []

    def watched(name: str) -> None:
        call = getattr(one, name)

        def watch() -> None:
            call()
            if name == "roll_out":
                changed.append([])
            changed[-1].append(one._changes[0])

        monkeypatch.setattr(one, name, watch)

    for name in ("roll_out", "roll_out_again"):
        watched(name)
    (_,) = driven(family, rti, [800])
    assert len(changed) >= 3, "roll-outs of each QP"
    for first, *later in changed:
        for before, now in zip([first, *later], later[:-1], strict=False):
            assert now <= before or now <= active_set.FEW * first, "a roll-out follows only while they settle"
