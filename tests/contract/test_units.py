# SPDX-License-Identifier: Apache-2.0
"""Units of inputs: whoever judges a command does so alike in N, kN and uN. Factors are powers of two, so that nothing is rounded."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.contract.approach import Increments, approach, magnitudes
from rti_mpc.contract.belief import Belief
from rti_mpc.contract.guard import Guard
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command, State
from rti_mpc.contract.status import Mode, QpStatus

MS = 1_000_000
DT = 100 * MS
UNITS = [2.0**-20, 2.0**-10, 2.0**10, 2.0**20]
BOUND, STEP = np.array([0.5, 0.745]), np.array([0.25, 0.4])
units = pytest.mark.parametrize("unit", UNITS, ids=lambda unit: f"2^{np.log2(unit):g}")


def limits(unit: float) -> Limits:
    return Limits(np.zeros(2), -unit * BOUND, unit * BOUND, -unit * STEP, unit * STEP, 1e-9 * DT)


def plan(u: np.ndarray, stamp_ns: int = 0, seq: int = 1) -> Command:
    return Command(5, seq, stamp_ns, 1, seq, stamp_ns, stamp_ns + 250 * MS, 0, Mode.TRACKING, QpStatus.SOLVED, DT, u)


@units
@pytest.mark.parametrize(("over", "refused"), [(1e-8, ""), (3e-7, ""), (1e-5, "out_of_bounds"), (1e-2, "out_of_bounds")])
def test_input_is_refused_beyond_its_bound_by_the_same_share_of_it_in_any_unit(unit: float, over: float, refused: str) -> None:
    at_bound = np.tile((1.0 + over) * BOUND, (3, 1))
    for one in (1.0, unit):
        assert limits(one).objection(plan(one * at_bound)).partition(":")[0] == refused


@units
@pytest.mark.parametrize(("over", "refused"), [(1e-8, ""), (1e-5, "out_of_slew"), (1e-2, "out_of_slew")])
def test_rows_are_refused_beyond_their_slew_limits_by_the_same_share_in_any_unit(unit: float, over: float, refused: str) -> None:
    rows = np.vstack([np.zeros(2), (1.0 + over) * STEP])
    for one in (1.0, unit):
        assert limits(one).objection(plan(one * rows)).partition(":")[0] == refused


@units
@pytest.mark.parametrize("off", [1e-12, 1e-8, 1e-5, 0.3])
def test_rows_are_approached_alike_in_any_unit(unit: float, off: float) -> None:
    acted, rows = np.array([0.1, -0.1]), np.array([[0.35, 0.3], [0.1, 0.0], [-0.15, -0.4]])
    rows[0] += off

    def approached(one: float) -> np.ndarray:
        return approach(one * rows, 0, DT, 0, [(0, one * acted)], Increments(-one * STEP, one * STEP, DT))

    np.testing.assert_array_equal(approached(unit), unit * approached(1.0))
    assert (approached(1.0) is not rows) and np.array_equal(approached(1.0), rows) == (off < 1e-9)


@units
@pytest.mark.parametrize(("off", "believed"), [(1e-8, True), (1e-5, False), (0.1, False)])
def test_report_is_believed_to_be_what_was_sent_by_the_same_share_in_any_unit(unit: float, off: float, believed: bool) -> None:
    for one in (1.0, unit):
        belief = Belief(np.zeros(2), one * STEP / 0.1, Increments(-one * STEP, one * STEP, DT), (-one * BOUND, one * BOUND))
        belief.add(plan(one * np.tile(0.2, (3, 2))), 0, 250 * MS)
        assert belief.expects(50 * MS, one * (0.2 + np.array([off, 0.0])), (5, 1)) == believed


@units
@pytest.mark.parametrize("off", [1e-8, 1e-5, 0.1])
def test_guard_passes_approaches_and_brakes_alike_in_any_unit(unit: float, off: float) -> None:
    def lived(one: float) -> tuple[list[str], np.ndarray]:
        """Codes that were said, and all rows that were passed or told."""
        guard, rows = Guard(limits(one), epoch=9), []
        for k in range(30):
            now_ns = 10_000 * MS + 50 * k * MS
            guard.receive_state(State(1, k + 1, now_ns, np.zeros(5)), now_ns)
            u = one * (0.2 + off * (k % 2) + np.zeros((3, 2)))
            for passed in (guard.receive_command(plan(u, now_ns, k + 1), now_ns + MS) if k < 20 else None, guard.tick(now_ns + 2 * MS)):
                rows += [] if passed is None else [passed.u / one]
        return [notice.code for notice in guard.notices], np.vstack(rows)

    (said, rows), (others, other_rows) = lived(1.0), lived(unit)
    assert said == others
    np.testing.assert_array_equal(other_rows, rows)


def test_rounding_is_relative_to_the_largest_value_of_an_input_or_to_its_increments_where_it_has_no_bound() -> None:
    infinite = np.full(4, np.inf)
    lbu, ubu, step = np.array([-2.0, -np.inf, 0.0, 0.0]), np.array([1.0, np.inf, 0.0, np.inf]), np.array([1.0, 3.0, 5.0, np.inf])
    assert magnitudes(lbu, ubu, -step, step).tolist() == [2.0, 3.0, 5.0, 1.0]
    assert magnitudes(-np.inf, np.inf, -infinite, infinite).tolist() == [1.0] * 4
