# SPDX-License-Identifier: Apache-2.0
"""Journal of a controller that runs: caught on the bus, it replays without a differing bit, twice."""

from __future__ import annotations

import signal
from itertools import chain
from pathlib import Path
from typing import Any

import pytest

from rti_mpc.contract.message import Command, Journal, JournalKind, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.journal.replay import Replay, ReplayOutcome, replay
from rti_mpc.wire.bus import Subscriber
from rti_mpc.wire.cdr import decode
from rti_mpc_service.cli import SHIPPED
from rti_mpc_service.config.build import build_controller, build_rti
from rti_mpc_service.config.config import load
from rti_mpc_service.config.fit import check_stop
from tests.processes.system import System, handles, heard, rti_mpc, until

pytestmark = pytest.mark.slow


class Catch:
    """Messages of a journal, as they come."""

    def __init__(self, subscriber: Subscriber) -> None:
        self._subscriber = subscriber
        self.messages: list[Journal] = []

    def snapshots(self) -> int:
        self.messages += [decode(Journal, received.payload) for received in self._subscriber.drain()]
        return sum(message.kind is JournalKind.SNAPSHOT for message in self.messages)


def replayed(config_path: Path, messages: list[Journal], **override: Any) -> ReplayOutcome:
    config = load(config_path)
    rti = build_rti(config)
    on = Replay(build_controller(config, rti, check_stop(config)), rti)
    steps = replay(on, messages)
    if override:
        first = next(steps)
        on.override(**override)
        steps = chain([first], steps)
    for _ in steps:
        pass
    return on.outcome


def ask(system: System, **request: object) -> None:
    assert system.bus.request(system.keys.request, request, 5.0)["ok"]


def asked(system: System, *request: object) -> None:
    done = rti_mpc(*request, system.config, "-e", system.endpoint)
    assert done.returncode == 0, done.stderr


def test_journal_of_a_run_with_whatever_an_operator_and_a_link_do_replays_without_a_differing_bit_twice(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(SHIPPED.read_text().replace("live = false", "live = true") + "\n[debug]\ninject = true\n")
    with System(tmp_path, path) as system:
        caught = Catch(system.bus.subscriber(system.keys.journal, capacity=1024))
        commands = system.bus.subscriber(system.keys.command, capacity=4096)
        system.start("robot", "controller", "reference")
        system.tracking()
        asked(system, "stop")
        heard(system.bus.subscriber(system.keys.command), Command, lambda command: command.mode is Mode.STOPPED)
        asked(system, "enable")
        system.tracking()
        done = rti_mpc("params", "set", system.config, "ocp.weights.R.u_c=2.0", "-e", system.endpoint)
        assert done.returncode == 0, done.stderr
        ask(system, request="inject", failure="qp", samples=6)
        telemetry = system.bus.subscriber(system.keys.telemetry)
        heard(telemetry, Telemetry, lambda sample: sample.fallbacks >= 5)
        system.fault(signal.SIGSTOP, "robot")
        heard(system.bus.subscriber(system.keys.command), Command, lambda command: command.mode is Mode.BRAKING)
        system.running["robot"].send_signal(signal.SIGCONT)
        system.tracking()
        before = caught.snapshots()
        ask(system, request="snapshot")
        until(lambda: caught.snapshots() > before, "a snapshot on request")
        heard(telemetry, Telemetry, lambda sample: sample.mode is Mode.TRACKING)
        assert handles(system.running["controller"].pid, signal.SIGTERM)
        system.interrupt("controller")
        last = [decode(Command, received.payload) for received in commands.drain()][-1]
        until(lambda: caught.snapshots() and caught.messages[-1].seq > 0, "the end of the journal")
        sent = last.seq
    for _ in range(2):
        outcome = replayed(path, caught.messages)
        assert outcome.samples >= sent
        assert not outcome.gaps
        assert not outcome.differences, str(outcome.differences[0])
    print(f"{outcome.samples} samples, {outcome.entries} entries, {len(outcome.snapshots)} snapshots, 0 differing bits, twice")
    problem = load(path)
    weight = problem.ocp.weights.R["u_c"]
    nudged = replayed(path, caught.messages, R=[weight * (1 + 1e-9), problem.ocp.weights.R["omega_c"]])
    assert nudged.differences
    print(nudged.differences[0])
