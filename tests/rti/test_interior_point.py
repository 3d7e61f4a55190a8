# SPDX-License-Identifier: Apache-2.0
"""Interior point behind the active set: against QPs solved by DAQP, its limits, and the families whose places do not settle."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.rti import active_set
from rti_mpc.rti.active_set import ActiveSet
from rti_mpc.rti.rti import Rti
from rti_mpc_service.bench.families import FAMILIES, Family
from tests.problems import pioneer
from tests.rti.test_active_set import PROBLEMS, samples

MOST = (
    active_set.MAX_ROLL_OUTS + active_set.MAX_MOVES + 6 + active_set.MAX_STEPS * 3
)  # roll-outs and steps of a QP: the first, a cold one, and four handed back


@pytest.fixture
def no_roll_outs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave every QP whose first roll-out changes places to the interior point."""
    monkeypatch.setattr(active_set, "MAX_ROLL_OUTS", 0)
    monkeypatch.setattr(active_set, "MAX_CHANGES", 0)


@pytest.mark.usefixtures("no_roll_outs")
@pytest.mark.parametrize("name", [name for name in PROBLEMS if name != "beacon"])  # whose bounds do not act at the start
def test_plan_is_that_of_the_qp_solved_by_another_solver(name: str) -> None:
    ocp = PROBLEMS[name]()
    rti, exact = (Rti(ocp, solver=solver, formulation="sequential", iterations=1, compile=False) for solver in ("riccati", "daqp"))
    stepped = solved = 0
    for x0, y_ref, u_prev in samples(ocp, 30):
        for one in (rti, exact):
            one.reset(x0, u_prev)
            one.prepare(y_ref, shift=False)
            assert one.feedback(x0).usable
        if rti.solver is rti.active_set and rti.solver.iterations > 1:
            stepped += 1
            solved += rti.status is QpStatus.SOLVED
            # A gap of 1e-6 of the cost leaves inputs open that hardly matter to it.
            np.testing.assert_allclose(rti.u, exact.u, rtol=0, atol=1e-3)
    assert stepped >= 10
    assert solved >= 0.95 * stepped


@pytest.mark.usefixtures("no_roll_outs")
@pytest.mark.parametrize("limit", [0, 3])
def test_without_enough_steps_no_plan_is_told_as_solved(limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rti_mpc.rti.active_set.MAX_STEPS", limit)
    ocp = PROBLEMS["pioneer"]()
    rti = Rti(ocp, compile=False)
    one = rti.active_set
    assert isinstance(one, ActiveSet)
    limited = 0
    for x0, y_ref, u_prev in samples(ocp, 10):
        rti.reset(x0, u_prev)
        rti.prepare(y_ref, shift=False)
        status = rti.feedback(x0)
        assert one.steps <= limit * rti.iterations
        if one.steps == limit * rti.iterations and rti.solver is not one:
            limited += 1
            assert status is not QpStatus.SOLVED
        assert np.all(rti.u <= ocp.ubu + 1e-3)  # OSQP's tolerance
    assert limited > 0


def driven(family: Family, rti: Rti, numbers: Iterable[int]) -> Iterator[Array]:
    """Drive through samples of a family, each of which is SOLVED; yield the command of each."""
    x, u = np.zeros(family.ocp.model.nx), family.u0
    for k in numbers:
        if (start := family.start(k)) is not None:
            x, u = start, family.u0
            rti.reset(x, u)
        y_ref, p = family.at(k)
        rti.prepare(y_ref, p, shift=start is None, u_prev=u)
        assert rti.feedback(x) is QpStatus.SOLVED
        u = rti.u[0].copy()
        x = family.plant(x, u)
        yield u


def test_row_that_no_free_input_moves_leaves_no_plan_to_the_interior_point() -> None:
    """With both inputs at bounds, a state is at its bound as well after the first stage of a robot in front of discs that block its way."""
    family = FAMILIES["discs_blocked"][0](20)
    rti = Rti(family.ocp, formulation="simultaneous", compile=False)
    one = rti.active_set
    assert one is not None
    assert sum(one.steps for _ in driven(family, rti, range(82))) == 0


def test_interior_point_ends_where_its_places_settle() -> None:
    """From a cold start with many bounds, whose first two QPs are left to it."""
    family = FAMILIES["tight"][0](50)
    rti = Rti(family.ocp, formulation="simultaneous", compile=False)
    one = rti.active_set
    assert one is not None
    called: list[str] = []

    def watched(name: str) -> None:
        call = getattr(one, name)

        def watch() -> None:
            call()
            called.append("settled" if name == "roll_out_again" and one._changes[0] == 0.0 else name)

        setattr(one, name, watch)

    for name in ("linearize", "step", "roll_out_again"):
        watched(name)
    for _ in driven(family, rti, range(1)):
        after = [called[i + 1] for i, name in enumerate(called[:-1]) if name == "settled" and called[i - 1] == "step"]
        assert after == ["linearize", "linearize"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "N", "most_changes"), [("slalom", 20, 0), ("tight", 50, 0), ("restarts", 20, 0), ("slalom", 50, active_set.MAX_CHANGES)]
)
def test_families_whose_places_do_not_settle_are_solved_in_a_bounded_number_of_roll_outs_and_steps(
    name: str, N: int, most_changes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the homotopy, which settles nearly all of their places, and where it does not."""
    monkeypatch.setattr(active_set, "MAX_CHANGES", most_changes)
    family = FAMILIES[name][0](N)
    rti = Rti(family.ocp, formulation="simultaneous")
    one = rti.active_set
    assert one is not None
    most, stepped = 0, 0
    for _ in driven(family, rti, range(family.samples)):
        assert rti.solver is one
        most = max(most, one.iterations)
        stepped += one.steps > 0
    assert most <= MOST
    assert stepped > 0


@pytest.mark.parametrize(("limit", "after_a_start", "later"), [(active_set.ROLL_OUTS_TO_GO_ON, 3, 3), (-1.0, 3, 1)])
def test_sample_begins_no_other_qp_after_more_roll_outs_than_the_limit_unless_it_follows_a_start(
    limit: float, after_a_start: int, later: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A limit below the roll-outs that these samples take, so that nothing else decides; a jump of the reference moves the plan far."""
    monkeypatch.setattr(active_set, "ROLL_OUTS_TO_GO_ON", limit)
    rti = Rti(pioneer(), compile=False)
    x0, near, far = np.zeros(5), np.zeros((rti.ocp.N, 3)), np.tile([0.3, 0.4, 0.5], (rti.ocp.N, 1))
    rti.reset(x0, np.zeros(2))

    def taken(y_ref: Array) -> int:
        rti.prepare(y_ref, shift=False)
        assert rti.feedback(x0) is QpStatus.SOLVED
        return rti.taken

    assert taken(far) == after_a_start
    settling = [taken(near) for _ in range(20)]
    assert settling[-1] == 1, "no sample has ended with a small step"
    assert taken(far) == later
