# SPDX-License-Identifier: Apache-2.0
"""Robot on a bus with TLS that drives on, and changes its controller, while all those try that must not: real router, real processes."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.status import Mode
from rti_mpc_service.host.hold_up import Host
from tests.guarded import GUARDED
from tests.in_time import in_time, on_time
from tests.processes.record import FAST_STATES, MS, recorded, within_slew
from tests.processes.system import until
from tests.processes.watched import Watched

pytest.importorskip("cryptography", reason="the extra certs is not installed: intruders were NOT tried")

from tests.processes.intruders import Intruders
from tests.processes.secured import Secured

pytestmark = pytest.mark.slow

DT_S = 0.1
PROMISE_MS = 300.0  # three periods
ROUNDS = 2  # in which each intruder tries, before the leader dies and after


def test_robot_drives_on_and_a_standby_takes_over_while_intruders_try_and_nothing_of_theirs_arrives(tmp_path: Path, host: Host) -> None:
    (folder := tmp_path / "robot").mkdir()
    with Secured(tmp_path) as bus, Watched(folder, DT_S, more=GUARDED + FAST_STATES, tls=bus.tls) as system:
        system.drive("guard")
        with Intruders(bus) as intruders:
            since_ns = system.state(lambda _: True).stamp_ns
            intruders.again(ROUNDS)
            epoch = system.tracking().epoch
            leader = system.process(epoch)
            died_ns = system.fault(signal.SIGKILL, leader)
            second = system.led_by_another(epoch)
            took_ms = (system.answered_ns(second) - died_ns) / MS
            print(f"\nthe standby's command reached the robot through the guard after {took_ms:.0f} ms, {PROMISE_MS:.0f} promised")
            in_time(host, "the takeover", took_ms, PROMISE_MS, system.fault_at_ns)
            system.kill(leader)
            intruders.again(ROUNDS)
            system.answers(second, 10)
        print(f"{sum(intruders.tried.values())} attempts of {len(intruders.tried)} kinds")
        assert (intruders.joined, intruders.listen()) == (set(), set())
        drives_on(system, host, since_ns)
        assert all(process.poll() is None for process in (*system.running.values(), *bus.running.values()))

        stolen = bus.join("controller").publisher(bus.keys.command)
        until(lambda: stolen.put_bytes(intruders.command()) or intruders.listen(), "the same command with the controller's own certificate arrives")


def drives_on(system: Watched, host: Host, since_ns: int) -> None:
    """Check that commands of a controller alone acted, in tracking, without a longer gap than a takeover may have."""
    system.listen()
    acted = [command for command in system.actuation if command.state_stamp_ns >= since_ns]
    punctual = on_time(host, "what acts", 1e3 * DT_S, system.driven_ns)  # else commands are fallbacks, and the guard changes those that come late
    assert {command.mode for command in acted} <= {Mode.TRACKING, Mode.BRAKING} or not punctual
    answered = {(command.state_seq, command.u.tobytes()) for command in system.commands}
    passed = [command for command in acted if command.mode is Mode.TRACKING]
    assert all((command.state_seq, command.u.tobytes()) in answered for command in passed) or not punctual
    gap_ms = np.diff([command.state_stamp_ns for command in passed]).max() / MS
    assert gap_ms <= PROMISE_MS or not punctual, gap_ms
    within_slew(recorded(system, since_ns, (passed[-1].state_stamp_ns - since_ns) // MS))
