# SPDX-License-Identifier: Apache-2.0
"""When a robot is ready for a fault, and how long it lasts, by an invented clock."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Event
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
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.rig.company import Failed

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

    def wait(condition: Callable[[], object], what: str, missing: Callable[[], str]) -> None:
        while not condition():
            t[0] += POLL_S

    system = SimpleNamespace(
        ensure=lambda *_: None,
        witness=SimpleNamespace(begun=False),
        observer=SimpleNamespace(epoch=0),
        driven=lambda most_m=np.inf: error_m(t[0]) < most_m,
        undriven=lambda: "",
        estimated=lambda: t[0] >= known_s,
        wait=wait,
    )
    monkeypatch.setattr(run.time, "monotonic_ns", lambda: round(1e9 * t[0]))
    report = MatrixReport(Console(file=io.StringIO()), 1)
    assert run.make_ready(cast("System", system), BY_NAME[name], report) == near
    assert t[0] == pytest.approx(ready_s, abs=3 * POLL_S)


@pytest.mark.parametrize(
    ("begun", "mode", "answered", "speed_m_s", "undriven"),
    [
        (True, Mode.TRACKING, {7}, 0.25, ""),
        (False, Mode.TRACKING, {7}, 0.25, "the controller has sent no plan in time yet"),
        (True, Mode.BRAKING, {7}, 0.25, "the controller is braking"),
        (True, Mode.TRACKING, set(), 0.25, "no state of the robot is answered"),
        (True, Mode.TRACKING, {7}, 0.05, "the robot moves by 0.05 m/s, and must by 0.1"),
    ],
)
def test_robot_that_drifts_at_speed_is_not_driven_nor_one_that_was_before_it_was_restarted(
    begun: bool, mode: Mode, answered: set[int], speed_m_s: float, undriven: str
) -> None:
    witness = SimpleNamespace(begun=begun, reference=object(), telemetry=[SimpleNamespace(mode=mode)])
    witness.listen = lambda: witness
    observer, motion = SimpleNamespace(speed_m_s=lambda: speed_m_s, answered=answered), SimpleNamespace(driven_speed=0.1, unit="m")
    system = cast("System", SimpleNamespace(witness=witness, observer=observer, motion=motion, error_m=lambda: 1.0))
    assert System.undriven(system) == undriven
    assert System.undriven(system, 0.5) == (undriven or "the robot is 1 m from its reference, and must be within 0.5")


def test_wait_tells_what_is_missing_while_it_lasts_and_when_it_was_in_vain(tmp_path: Path) -> None:
    told = list[str]()
    system = SimpleNamespace(children=SimpleNamespace(ended=lambda: None, folder=tmp_path), _stop=Event(), _tell=told.append)
    with pytest.raises(Failed, match=r"waited 0 s for the robot to be driven in vain, see .*: the controller is braking"):
        System.wait(cast("System", system), lambda: False, "the robot to be driven", 0.0, lambda: "the controller is braking")
    assert set(told) == {"waiting for the robot to be driven: the controller is braking"}


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


class SlowHost(SimpleNamespace):
    """A system in invented time, whose controller is driving the robot from `drives_s` on, as long as its reference of 60 s lasts."""

    def __init__(self, drives_s: float) -> None:
        super().__init__(t=0.0, ends_s=[60.0])
        witness = SimpleNamespace(begun=True)
        witness.listen = lambda: witness
        self.witness, self.observer = witness, SimpleNamespace(epoch=1)
        self.reference_left_s = lambda: self.ends_s[-1] - self.t
        self.driven = lambda most_m=np.inf: drives_s <= self.t < self.ends_s[-1]
        self.undriven = lambda: "" if self.driven() else "the controller is braking"
        self.estimated, self.ensure = lambda: True, lambda *_: None
        self.last_sample_ns = lambda: round(1e9 * self.t)

    def restart(self, role: str) -> None:
        assert role == "reference"
        self.ends_s.append(self.t + 60.0)

    def wait(self, condition: Callable[[], object], what: str, patience_s: float = 300.0, missing: Callable[[], str] = lambda: "") -> None:
        until_s = self.t + patience_s
        while not condition():
            self.t += POLL_S
            if self.t > until_s:
                raise Failed(what)


@pytest.mark.parametrize(("drives_s", "references"), [(1.0, 1), (50.0, 2), (100.0, 3)])
def test_robot_that_a_slow_host_lets_be_driven_late_has_a_reference_for_all_of_the_fault(
    drives_s: float, references: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = SlowHost(drives_s)
    monkeypatch.setattr(run.time, "monotonic_ns", lambda: round(1e9 * system.t))
    fault = BY_NAME["controller_killed"]
    assert run.make_ready(cast("System", system), fault, MatrixReport(Console(file=io.StringIO()), 1))
    assert system.t == pytest.approx(drives_s, abs=3 * POLL_S)
    assert system.reference_left_s() >= fault.hold_s + run.RECOVERY_TIMEOUT_S
    assert len(system.ends_s) == references


@pytest.mark.parametrize(
    ("drives_s", "held_up_share", "ends_s"),
    [
        (5.0, 0.0, 5.0),
        (90.0, 0.9, 90.0),  # past the end of the reference that was there when it was mended
        (90.0, 0.0, run.RECOVERY_TIMEOUT_S),  # the host explains nothing
        (1e3, 0.5, 2 * run.RECOVERY_TIMEOUT_S),
        (1e3, 3.0, 300.0),  # three threads without a core, for ever
    ],
)
def test_robot_has_its_time_to_recover_less_what_the_host_held_it_up(
    drives_s: float, held_up_share: float, ends_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = SlowHost(drives_s)
    monkeypatch.setattr(run.time, "monotonic_ns", lambda: round(1e9 * system.t))
    host = SimpleNamespace(held_up_ms=lambda from_ns, to_ns: 1e-6 * held_up_share * (to_ns - from_ns))
    run.recovered(cast("System", system), -1, cast("Host", host))
    assert system.t == pytest.approx(ends_s, abs=0.5)
    assert system.driven() == (drives_s == ends_s)


@pytest.mark.parametrize(("share", "said"), [(0.4, ""), (1.5, f": {run.HELD_UP} for 450 s in 300 s")])
def test_robot_that_is_never_driven_is_not_judged_where_the_host_held_it_up(share: float, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run.time, "monotonic_ns", lambda: 300 * 10**9)
    host = SimpleNamespace(held_up_ms=lambda from_ns, to_ns: 1e-6 * share * (to_ns - from_ns))
    assert run.held_up(cast("Host", host), 0) == said
