# SPDX-License-Identifier: Apache-2.0
"""Lives of one publisher in quick succession: each has an epoch that receivers take for a newer one."""

from __future__ import annotations

import time

import numpy as np
import pytest

from rti_mpc.adapter.planner import PlannerAdapter
from rti_mpc.contract.message import Reference
from rti_mpc.wire import bus as bus_module
from rti_mpc.wire.bus import Received
from rti_mpc.wire.cdr import encoding
from rti_mpc.wire.intake import Intake
from tests.test_architecture import every_file
from tests.wire.fake_session import FakeSession

MS = 1_000_000


def test_reference_of_a_planner_that_was_restarted_within_a_second_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    session, intake, now_ns = FakeSession(), Intake(Reference, 60.0), 1_700_000_000_100 * MS
    monkeypatch.setattr(bus_module, "ZenohSession", lambda *_, **__: session)
    for life in range(3):
        monkeypatch.setattr(time, "time_ns", lambda now_ns=now_ns + 200 * life * MS: now_ns)
        with PlannerAdapter("robot") as planner:
            planner.send(np.full((2, 3), life), 0.1)
        (payload,) = session.put.values()
        taken = intake.accept(Received(payload, encoding(Reference), "reference"), 200 * life * MS)
        assert taken is not None
        assert taken.y[0, 0] == life


def test_epochs_are_taken_from_the_clock_in_one_place() -> None:
    """In `new_epoch`; beside it, `unix_s` limits epochs, and controllers and guards shift it."""
    assert {path.name for path in every_file() if "time_ns() //" in path.read_text(encoding="utf-8")} == {"bus.py"}
