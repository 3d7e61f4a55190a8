# SPDX-License-Identifier: Apache-2.0
"""Standby controllers as processes: takeover when the leader is killed, stopped, resumed or ended."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.wire.cdr import decode
from rti_mpc_service.host.hold_up import Host
from tests.in_time import MS, explained, in_time, on_time
from tests.processes.system import ANSWERED, KEYS, heard, owner, rti_mpc, until
from tests.processes.watched import CONTROLLERS, Watched, configuration, half_period, relieved, within_limits


@pytest.fixture(params=[0.1, pytest.param(0.02, marks=pytest.mark.slow)], ids=["10Hz", "50Hz"])
def redundant(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Watched]:
    """A robot that is being driven by a leader, beside whom another stands by."""
    with Watched(tmp_path, request.param, more=half_period(request.param)) as system:
        system.drive()
        yield system


def test_standby_takes_over_in_time_and_the_old_leader_is_fenced(redundant: Watched, host: Host) -> None:
    """At 10 Hz the leader is stopped and resumed, at 50 Hz killed."""
    system = redundant
    epoch = system.tracking().epoch
    leader = system.process(epoch)  # a busy machine may have swapped them
    died_ns = system.fault(signal.SIGSTOP if system.dt_s == 0.1 else signal.SIGKILL, leader)
    second = system.led_by_another(epoch)
    assert second.mode is Mode.TRACKING
    took_s = 1e-9 * (system.answered_ns(second) - died_ns)
    print(f"dt = {system.dt_s} s: took over {1e3 * took_s:.1f} ms after the leader's death, {1e3 * max(3 * system.dt_s, 0.05):.0f} promised")
    if took_s < 0.0:  # the leader was late before its fault, and was relieved while it still answered: of that, nothing is promised
        silent_ms = 1e3 * max(3 * system.dt_s, 0.05)
        since_ns = system.fault_at_ns - round((silent_ms - 1e3 * took_s) * MS)
        assert explained(host, "the leader was relieved before its fault", silent_ms - 1e3 * system.dt_s, since_ns, system.fault_at_ns)
        return
    in_time(host, "the takeover", 1e3 * took_s, 1e3 * max(3 * system.dt_s, 0.05), system.fault_at_ns)
    if system.dt_s == 0.1:
        stepped_down = system.bus.subscriber(KEYS.event("standby"), capacity=64, history=False)
        system.running[leader].send_signal(signal.SIGCONT)
        until(lambda: "standby" in system.lives, "the old leader stands by")
        until(lambda: any(b"stepped_down" in received.payload for received in stepped_down.drain()), "it says so")
        system.answers(second, 20)
        system.interrupt(system.process(second.epoch))
        third = system.led_by_another(second.epoch)
        system.answers(third, 10)
        assert Mode.STOPPED not in {command.mode for command in system.commands if command.epoch == second.epoch}, "it was relieved in motion"
    else:
        system.answers(second, 20)
    epochs = [command.epoch for command in system.commands if command.epoch >= second.epoch or command.state_seq >= second.state_seq]
    assert epochs == sorted(epochs), "whoever has led once and was followed by another says nothing more"
    twice = [seq for seq in system.samples_of_two_epochs() if seq >= second.state_seq]
    assert twice == [] or relieved(host, system, system.fault_at_ns)
    within_limits(host, system)


@pytest.mark.slow
def test_orders_hold_whoever_leads_and_of_two_that_stand_by_the_lower_number_leads(tmp_path: Path, host: Host) -> None:
    with Watched(tmp_path, 0.1, live=True) as system:
        begun_ns = time.monotonic_ns()
        system.start("robot", "leader", "reference")
        system.tracking()
        assert rti_mpc("params", "set", system.config, "ocp.weights.Q.psi=0.0", "-e", system.endpoint, *ANSWERED).returncode == 0
        system.start("standby", "third")  # that hear of the change from the leader
        standby_telemetry = system.bus.subscriber(KEYS.standby_telemetry, capacity=64)
        sources = set()

        def both() -> bool:
            samples = [decode(Telemetry, received.payload) for received in standby_telemetry.drain()]
            sources.update(sample.seq for sample in samples if sample.parameter_version == 1 and sample.mode is Mode.TRACKING)
            return sum(role.startswith("standby.") for role in system.lives) == 2 and len(sources) > 20

        until(both, "two that stand by, with the change")
        first = system.tracking().epoch
        leading = system.process(first)  # a busy machine may have swapped them
        low, high = sorted(CONTROLLERS - {leading}, key=lambda role: owner(system.said(role)))
        killed_ns = time.monotonic_ns()
        system.kill(leading)
        second = system.led_by_another(first)
        sample = heard(system.bus.subscriber(KEYS.telemetry), Telemetry, lambda sample: sample.epoch == second.epoch)
        assert sample.parameter_version == 1
        system.answers(second, 10)
        if on_time(host, "which of the two leads", 1e3 * system.dt_s, killed_ns):
            assert {command.epoch for command in system.commands if command.epoch >= first} == {first, second.epoch}
            assert system.process(second.epoch) == low
            assert "leads from now on" not in system.said(high)

        answer = rti_mpc("stop", system.config, "-e", system.endpoint, *ANSWERED)
        assert (answer.returncode, json.loads(answer.stdout)["ok"]) == (0, True)
        system.state(lambda state: bool(np.abs(state.x[3:]).max() < 1e-3))
        system.kill(system.process(second.epoch))
        third = system.led_by_another(second.epoch)
        system.answers(third, 10)
        assert {command.mode for command in system.commands if command.epoch == third.epoch} == {Mode.STOPPED}
        assert rti_mpc("enable", system.config, "-e", system.endpoint, *ANSWERED).returncode == 0
        assert system.tracking().epoch == third.epoch
        assert system.samples_of_two_epochs() == [] or relieved(host, system, begun_ns)


@pytest.mark.slow
def test_standby_of_another_configuration_is_refused(tmp_path: Path) -> None:
    with Watched(tmp_path, 0.1) as system:
        system.start("robot", "leader")
        until(lambda: "controller" in system.lives, "a leader")
        info = json.loads(until(system.bus.subscriber(KEYS.info("controller")).try_recv, "its description").payload)
        other = tmp_path / "other"
        other.mkdir()
        done = rti_mpc("run", configuration(other, 0.05), "--standby", "-e", system.endpoint)
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1
        assert f"{info['config_hash']:016x}" in done.stderr
        assert "this standby's" in done.stderr


@pytest.mark.slow
def test_standby_without_a_leader_leads(tmp_path: Path) -> None:
    with Watched(tmp_path, 0.1) as system:
        system.start("robot", "standby", "reference")
        command = system.tracking()
        until(lambda: "controller" in system.lives and "standby" not in system.lives, "its new role")
        assert system.tracking().epoch == command.epoch
