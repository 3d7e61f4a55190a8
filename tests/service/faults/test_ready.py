# SPDX-License-Identifier: Apache-2.0
"""When a robot is ready for a fault, and how long it lasts, by an invented clock."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from rich.console import Console

from rti_mpc.contract.status import Mode
from rti_mpc_service.faults import run
from rti_mpc_service.faults.report import MatrixReport
from rti_mpc_service.faults.system import System
from rti_mpc_service.faults.table import FAULTS

BY_NAME = {fault.name: fault for fault in FAULTS}
POLL_S = 0.05


@pytest.mark.parametrize(
    ("name", "error_m", "known_s", "near", "ready_s"),
    [
        ("viewer_killed", lambda t: 0.1 * np.exp(-t), 0.0, True, np.log(100.0) + run.NEAR_S),  # comes to its reference
        ("viewer_killed", lambda t: 0.05 * abs(np.sin(t)), 0.0, False, run.SETTLING_S),  # swings about it
        ("controller_killed", lambda t: 0.1, 0.0, True, 0.0),
        ("controller_killed", lambda t: 0.1, 3.0, True, 3.0),  # its current is known by then
    ],
)
def test_robot_is_ready_when_it_stays_on_its_path_if_it_must_and_knows_what_to_balance(
    name: str, error_m: Callable[[float], float], known_s: float, near: bool, ready_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    t = [0.0]

    def wait(condition: Callable[[], object], what: str) -> None:
        while not condition():
            t[0] += POLL_S

    system = SimpleNamespace(
        ensure=lambda *_: None,
        witness=SimpleNamespace(begun=False),
        driven=lambda most_m=np.inf: error_m(t[0]) < most_m,
        estimated=lambda: t[0] >= known_s,
        wait=wait,
    )
    monkeypatch.setattr(run.time, "monotonic_ns", lambda: round(1e9 * t[0]))
    report = MatrixReport(Console(file=io.StringIO()), 1)
    assert run.make_ready(cast("System", system), BY_NAME[name], report) == near
    assert t[0] == pytest.approx(ready_s, abs=3 * POLL_S)


@pytest.mark.parametrize(
    ("mode", "answered", "speed_m_s", "driven"),
    [(Mode.TRACKING, {7}, 0.25, True), (Mode.BRAKING, {7}, 0.25, False), (Mode.TRACKING, set(), 0.25, False), (Mode.TRACKING, {7}, 0.05, False)],
)
def test_robot_that_drifts_at_speed_is_not_driven_nor_one_that_was_before_it_was_restarted(
    mode: Mode, answered: set[int], speed_m_s: float, driven: bool
) -> None:
    witness = SimpleNamespace(begun=True, telemetry=[SimpleNamespace(mode=mode)])
    witness.listen = lambda: witness
    observer, motion = SimpleNamespace(speed_m_s=lambda: speed_m_s, answered=answered), SimpleNamespace(driven_speed=0.1)
    system = SimpleNamespace(witness=witness, observer=observer, motion=motion, error_m=lambda: 1.0)
    assert System.driven(cast("System", system)) == driven


@pytest.mark.parametrize("begins_s", [None, -0.1, 1.0])  # at once, at the last good state, with the last row of a reference
def test_fault_lasts_as_long_as_it_should_from_its_beginning_on(begins_s: float | None) -> None:
    t_ns = [10**9]

    def pause(duration_s: float) -> None:
        t_ns[0] += round(1e9 * duration_s)

    system = SimpleNamespace(now_ns=lambda: t_ns[0], pause=pause)
    begins_ns = t_ns[0] if begins_s is None else t_ns[0] + round(1e9 * begins_s)
    fault = replace(BY_NAME["reference_ends_stop"], inject=lambda _: None if begins_s is None else begins_ns, hold_s=5.0)
    fault_ns, mend_ns = run.endure(cast("System", system), fault)
    assert fault_ns == begins_ns
    assert mend_ns - max(fault_ns, 10**9) == 5 * 10**9
