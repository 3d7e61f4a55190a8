# SPDX-License-Identifier: Apache-2.0
"""Real processes: a controller whose samples fail on request, and one that is stopped for a while; `tests.control.test_ladder` holds the ladder."""

from __future__ import annotations

import csv
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Command, Event, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.wire.bus import Subscriber
from rti_mpc.wire.cdr import decode
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.shipped import SHIPPED
from tests.in_time import explained, on_time
from tests.processes.system import CONFIG, KEYS, PATIENCE_S, SPEED, System, heard

SLEW = np.array([0.25, 0.4]) / CONFIG.ocp.dt_s  # per s
STOPPED_S = 1.5
PERIOD_MS = 1e3 * CONFIG.ocp.dt_s / SPEED


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """A robot that is being driven by a controller that fails on request."""
    folder = tmp_path_factory.mktemp("driven")
    config = folder / "robot.toml"
    config.write_text(SHIPPED.read_text() + "\n[debug]\ninject = true\n")
    with System(folder, config) as system:
        system.start("robot", "controller", "reference")
        system.tracking()
        yield system


def inject(system: System, failure: str, samples: int) -> None:
    answer = system.bus.request(KEYS.request, {"request": "inject", "failure": failure, "samples": samples}, PATIENCE_S)
    assert answer == {"ok": True, "request": "inject", "failure": failure, "samples": samples}


def codes(events: Subscriber) -> list[str]:
    return [decode(Event, received.payload).code for received in events.drain()]


def recovered(system: System, samples: int = 10) -> Telemetry:
    """Telemetry of a controller that has been following the reference for some samples."""
    stream = system.bus.subscriber(KEYS.telemetry)
    start = heard(stream, Telemetry, lambda sample: sample.mode is Mode.TRACKING)
    return heard(stream, Telemetry, lambda sample: sample.seq > start.seq + samples and sample.mode is Mode.TRACKING)


@pytest.mark.slow
def test_other_solver_takes_over_without_anybody_noticing(driven: System, host: Host) -> None:
    before, begun_ns = recovered(driven), time.monotonic_ns()
    inject(driven, "solver", 10)
    heard(driven.bus.subscriber(KEYS.telemetry), Telemetry, lambda sample: sample.softened > before.softened)
    after = recovered(driven)
    assert after.softened > before.softened
    if on_time(host, "the other solver", PERIOD_MS, begun_ns):
        assert (after.softened - before.softened, after.fallbacks) == (10, before.fallbacks)


@pytest.mark.slow
@pytest.mark.parametrize(("failure", "samples"), [("qp", 8), ("nan_model", 8)])
def test_failures_lead_down_the_ladder_and_up_again(driven: System, host: Host, failure: str, samples: int) -> None:
    before, begun_ns = recovered(driven, 50), time.monotonic_ns()  # a second: no more often is one kind of fault published
    events = driven.bus.subscriber(KEYS.event("controller"), capacity=64, history=False)
    commands = driven.bus.subscriber(KEYS.command, capacity=4096)
    inject(driven, failure, samples)
    heard(driven.bus.subscriber(KEYS.telemetry), Telemetry, lambda sample: sample.fallbacks >= before.fallbacks + samples)
    after = recovered(driven)
    modes = [decode(Command, received.payload).mode for received in commands.drain()]
    assert after.fallbacks - before.fallbacks >= samples
    assert Mode.BRAKING in modes
    if not on_time(host, "the ladder", PERIOD_MS, begun_ns):
        return  # what the host made late is a fallback, too
    first = modes.index(Mode.FALLBACK)
    assert set(modes[first : modes.index(Mode.BRAKING)]) == {Mode.FALLBACK}
    assert modes.count(Mode.FALLBACK) == after.shifted - before.shifted <= 3
    assert after.braked + after.rested - before.braked - before.rested == modes.count(Mode.BRAKING)
    assert after.fallbacks - before.fallbacks <= samples + 2  # a NaN is forgotten within two samples
    assert {"qp_failed", "no_plan"} <= set(codes(events))


@pytest.mark.slow
def test_samples_over_budget_are_not_sent_and_leave_the_loop_in_phase(driven: System, host: Host) -> None:
    before, begun_ns = recovered(driven, 50), time.monotonic_ns()  # a second: no more often is one kind of fault published
    events = driven.bus.subscriber(KEYS.event("controller"), capacity=64, history=False)
    commands = driven.bus.subscriber(KEYS.command, capacity=4096)
    inject(driven, "over_budget", 4)
    heard(driven.bus.subscriber(KEYS.telemetry), Telemetry, lambda sample: sample.fallbacks >= before.fallbacks + 4)
    recovered(driven)
    if not on_time(host, "the phase of the loop", PERIOD_MS, begun_ns):
        return  # the host leaves samples out, and starts the loop anew
    assert "over_budget" in codes(events)
    sent = [decode(Command, received.payload) for received in commands.drain()]
    assert np.all(np.diff([command.seq for command in sent]) == 1)
    dt_ns = round(1e9 * CONFIG.ocp.dt_s)
    tracked = np.array([command.stamp_ns for command in sent if command.mode is Mode.TRACKING])
    assert np.diff(tracked).min() >= 0.9 * dt_ns  # no burst
    offset = (tracked - tracked[0]) % dt_ns
    assert np.minimum(offset, dt_ns - offset).max() < 0.1 * dt_ns  # in phase


def test_controller_that_was_stopped_acts_on_nothing_that_has_waited(driven: System, host: Host) -> None:
    """SIGSTOP, 1.5 s, SIGCONT: it notices the gap, starts cold, and re-enters softly."""
    before = recovered(driven, 50)  # a second: no more often is one kind of fault published
    events = driven.bus.subscriber(KEYS.event("controller"), capacity=64, history=False)
    commands = driven.bus.subscriber(KEYS.command, capacity=4096)
    process = driven.running["controller"]
    driven.tracking()
    process.send_signal(signal.SIGSTOP)
    try:
        time.sleep(STOPPED_S)  # the fault itself
        stood = driven.state(lambda state: bool(np.abs(state.x[3:]).max() < 1e-2))
        last = [decode(Command, received.payload) for received in commands.drain()][-1]
    finally:
        process.send_signal(signal.SIGCONT)
    resumed_ns = time.monotonic_ns()
    after = recovered(driven)
    sent = [decode(Command, received.payload) for received in commands.drain()]
    later = [command for command in sent if command.seq > last.seq + 1]  # it may have been about to send one when it was stopped
    assert later[0].stamp_ns > stood.stamp_ns
    assert after.mode is Mode.TRACKING
    if on_time(host, "the re-entry", PERIOD_MS, resumed_ns):
        assert after.fallbacks - before.fallbacks <= 3  # the sample it was stopped in, and the first ones
    assert {"state_old", "state_stale", "gap", "clock_jumped"} & set(codes(events))  # the last where the first state heard again was the newest


def test_inputs_stayed_inside_bounds_and_slew_limits_through_all_of_it(driven: System, host: Host) -> None:
    recovered(driven)
    with (driven.folder / "robot.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    t = np.array([float(row["stamp_ns"]) for row in rows])
    u = np.array([[float(row["u_c"]), float(row["omega_c"])] for row in rows])
    assert np.all(np.abs(u) <= [0.5, 0.745])
    late = np.array([int(row["late"]) for row in rows])  # by more than a period, where the host is: that is the guard's to answer
    in_time = late[3:] == late[:-3]
    beyond = np.abs(np.diff(u, axis=0)) - SLEW * np.diff(t)[:, None] / 1e9
    late_ms = 0.5 * PERIOD_MS * np.count_nonzero(~in_time)  # half a period each, at least
    assert np.count_nonzero(in_time) > 0.5 * len(in_time) or explained(host, "most commands came late", late_ms, 0, time.monotonic_ns())
    assert beyond[2:][in_time].max() <= 1e-9, rows[2 + int(beyond[2:].max(axis=1).argmax())]


@pytest.mark.slow
@pytest.mark.parametrize("request_", [{"request": "inject", "failure": "flood"}, {"request": "inject", "failure": "qp", "samples": 0}])
def test_failure_that_cannot_be_injected_is_refused_with_what_can(driven: System, request_: dict[str, object]) -> None:
    answer = driven.bus.request(KEYS.request, request_, PATIENCE_S)
    assert answer["ok"] is False
    assert "must be" in answer["error"]


@pytest.mark.slow
def test_nothing_fails_on_request_unless_the_configuration_says_so(tmp_path: Path) -> None:
    with System(tmp_path) as system:
        system.start("robot", "controller")
        answer = system.bus.request(KEYS.request, {"request": "inject", "failure": "qp", "samples": 3}, PATIENCE_S)
    assert answer == {"ok": False, "error": "inject must be enabled in the configuration, with debug.inject = true, got false"}
