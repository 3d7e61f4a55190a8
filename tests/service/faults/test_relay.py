# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import deque
from dataclasses import astuple

import numpy as np
import pytest

from rti_mpc.contract.message import State
from rti_mpc_service.faults.relay import STATE_CHANGES

PERIOD_NS = 10_000_000
SENT = [State(7, seq, seq * PERIOD_NS, np.array([0.1 * seq, 1.0, 2.0])) for seq in range(1, 81)]


def relayed(change: str) -> list[State]:
    held: deque[State] = deque()
    return [state for sent in SENT for state in STATE_CHANGES[change](sent, held)]


@pytest.mark.parametrize(
    ("change", "seqs", "stamps"),
    [
        ("none", [1, 2, 3, 4], [1, 2, 3, 4]),
        ("frozen", [1, 2, 3, 4], [1, 1, 1, 1]),
        ("duplicated", [1, 1, 1, 2], [1, 1, 1, 2]),
        ("reordered", [2, 1, 4, 3], [2, 1, 4, 3]),
        ("late", [1, 2, 3, 4], [1, 2, 3, 4]),
    ],
)
def test_states_come_as_the_name_of_the_fault_says(change: str, seqs: list[int], stamps: list[int]) -> None:
    first = relayed(change)[:4]
    assert [state.seq for state in first] == seqs
    assert [state.stamp_ns // PERIOD_NS for state in first] == stamps


def test_late_states_are_late_by_more_than_a_command_is_valid() -> None:
    assert len(SENT) - len(relayed("late")) == 40


def test_a_change_of_content_leaves_the_rest_as_it_is() -> None:
    for change in ("nan", "short"):
        assert [astuple(state)[:3] for state in relayed(change)] == [astuple(state)[:3] for state in SENT], change
    assert np.isnan(relayed("nan")[0].x).tolist() == [True, False, False]
    assert len(relayed("short")[0].x) == 2
    assert np.isfinite(SENT[0].x).all()
