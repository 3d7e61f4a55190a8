# SPDX-License-Identifier: Apache-2.0
"""
The guard among real processes: real signals, measured in the robot's own record, by its own clock, at speed 1.

Braking begins within 300 ms of a fault, the command is zero within 500 ms, the
robot stands within 2.5 s, and it stays so.
"""

from __future__ import annotations

import itertools
import os
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Command, End, Reference, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.wire.bus import new_epoch
from rti_mpc.wire.cdr import decode
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.shipped import SHIPPED
from tests.command import command
from tests.guarded import write_robot
from tests.in_time import explained, in_time
from tests.processes.record import FAST_STATES, MS, Record, recorded, within_slew
from tests.processes.system import CONFIG, KEYS, System, heard, rti_mpc, until

SPEED_M_S = 0.5
LINE_S, PERIOD_S = 400.0, 0.1  # of a reference, and between its rows
AHEAD_M = 0.2  # at most, of the robot on a line that has just begun
EPOCH, NUMBERS = new_epoch(), itertools.count(1)  # of the references
LINK_MS = 100.0  # a link drops a message of the guard only where it was held up for longer: two wait there, one each 70 ms


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """A robot and its guard."""
    folder = tmp_path_factory.mktemp("guarded")
    write_robot(folder / "robot.toml", FAST_STATES)
    with System(folder, folder / "robot.toml", robot=("sim",)) as system:
        system.start("robot", "guard", "controller")
        yield system


@pytest.fixture
def driven(system: System) -> System:
    """The system, when the robot is at its full speed, along a line that begins where the robot is and that this process publishes."""
    begin = system.state(lambda _: True)
    times_s = np.arange(0.0, LINE_S, PERIOD_S)
    y = begin.x[:3] * [1.0, 1.0, 0.0] + np.outer(times_s, [SPEED_M_S, 0.0, 0.0])
    system.bus.publisher(KEYS.reference).put(
        Reference(EPOCH, next(NUMBERS), begin.stamp_ns, round(1e9 * PERIOD_S), End.HOLD, y, np.empty((len(y), 0)))
    )

    def follows(sample: Telemetry) -> bool:  # this line, not the one of the test before
        ahead_m = sample.y_ref[0, 0] - begin.x[0] - 1e-9 * SPEED_M_S * (sample.stamp_ns - begin.stamp_ns)
        return sample.mode is Mode.TRACKING and abs(ahead_m) < AHEAD_M

    heard(system.bus.subscriber(KEYS.telemetry), Telemetry, follows)
    system.state(lambda state: bool(state.x[3] > 0.95 * SPEED_M_S))
    return system


def braked_in_time(host: Host, system: System, record: Record) -> None:
    in_time(host, "braking", record.braking_ms, 300.0, system.fault_at_ns)
    in_time(host, "the command zero", record.zero_ms, 500.0, system.fault_at_ns)


def stopped_in_time(host: Host, system: System, record: Record) -> None:
    braked_in_time(host, system, record)
    in_time(host, "standing", record.standing_ms, 2500.0, system.fault_at_ns)
    assert not record.inputs[record.times >= record.zero_ms].any()
    within_slew(record)


@pytest.mark.parametrize(
    "killed", [*(pytest.param((role,), marks=pytest.mark.slow) for role in ("controller", "guard")), ("controller", "guard")], ids="+".join
)
def test_robot_stops_in_time_when_somebody_is_killed_and_is_driven_again_after_a_restart(driven: System, host: Host, killed: tuple[str, ...]) -> None:
    """Without a guard by the robot's own watchdog, which still has the plan."""
    fault_ns = driven.fault(signal.SIGKILL, *killed)
    for role in killed:
        driven.kill(role)
    record = recorded(driven, fault_ns, 2700)
    print(f"\n{'+'.join(killed)} killed: braking {record.braking_ms:.0f}, zero {record.zero_ms:.0f}, standing {record.standing_ms:.0f} ms")
    stopped_in_time(host, driven, record)
    driven.start(*killed)
    driven.state(lambda state: bool(state.x[3] > 0.9 * SPEED_M_S))


@pytest.mark.parametrize("role", ["controller", "guard"])
def test_nothing_stale_acts_when_somebody_was_stopped_and_goes_on(driven: System, host: Host, role: str) -> None:
    """``kill -STOP; sleep 1.5; kill -CONT``"""
    actuation = driven.bus.subscriber(KEYS.actuation, capacity=4096)
    fault_ns = driven.fault(signal.SIGSTOP, role)
    stopped_at_ns, stopped_ns = driven.fault_at_ns, driven.state(lambda _: True).stamp_ns
    try:
        driven.state(lambda state: state.stamp_ns >= fault_ns + 1500 * MS)
    finally:
        resumed_ns = driven.fault(signal.SIGCONT, role)
    driven.state(lambda state: bool(state.x[3] > 0.9 * SPEED_M_S))
    record = recorded(driven, fault_ns, (resumed_ns - fault_ns) // MS + 500)
    print(f"\n{role} stopped: braking {record.braking_ms:.0f}, zero {record.zero_ms:.0f} ms")
    driven.fault_at_ns = stopped_at_ns
    braked_in_time(host, driven, record)
    resumed_ms = (resumed_ns - fault_ns) / MS
    assert not record.inputs[(record.times >= record.zero_ms) & (record.times < resumed_ms)].any()
    within_slew(record)
    told = [decode(Command, received.payload) for received in actuation.drain()]
    stale = [c for c in told if c.u.any() and stopped_ns < c.state_stamp_ns < resumed_ns - 300 * MS and c.mode.name != "BRAKING"]
    assert not stale


def test_guard_says_why_it_intervened(driven: System) -> None:
    events = driven.bus.subscriber(KEYS.event("guard"), capacity=64, history=False)
    driven.running["controller"].send_signal(signal.SIGSTOP)
    try:
        until(lambda: any(b"guard_braking" in received.payload for received in events.drain()), "the guard says that it brakes")
    finally:
        driven.running["controller"].send_signal(signal.SIGCONT)
    until(lambda: any(b"guard_passing" in received.payload for received in events.drain()), "the guard says that commands pass again")


def test_guard_process_loads_no_solver_and_no_model(system: System) -> None:
    maps = Path(f"/proc/{system.running['guard'].pid}/maps").read_text()
    assert "numpy" in maps
    for package in ("casadi", "osqp", "scipy"):
        assert f"/{package}/" not in maps, package


def test_second_guard_refuses_to_start_beside_a_live_one(system: System) -> None:
    done = rti_mpc("guard", system.config, "-e", system.endpoint)
    assert (done.returncode, "pioneer already has a guard" in done.stderr) == (1, True), done.stderr


def test_configuration_without_a_guard_is_one_line_and_exit_status_2() -> None:
    done = command("guard", SHIPPED)
    assert (done.returncode, done.stderr) == (2, "rti-mpc: guard.enabled must be true for the robot to take what a guard passes on, got false\n")


def test_ctrl_c_ends_the_guard_with_a_ramp_to_rest(driven: System, host: Host) -> None:
    """The last test: the robot stays where it is."""
    actuation = driven.bus.subscriber(KEYS.actuation, capacity=4096)
    stopped_ns = driven.state(lambda _: True).stamp_ns
    assert driven.interrupt("guard", 1000.0, asked=["robot"]) == 0, "it waits for the robot to have heard of braking"
    until(lambda: "guard" not in driven.lives, "the guard is gone")
    last = decode(Command, actuation.drain()[-1].payload)
    assert last.mode is Mode.BRAKING
    told = not last.u[-1].any()
    assert told or explained(host, "the guard's last command was lost", LINK_MS, driven.fault_at_ns, time.monotonic_ns())
    stopped_in_time(host, driven, recorded(driven, stopped_ns, 2700))
    assert "Traceback" not in driven.said("guard")
    assert CONFIG.guard.enabled is False, "the quickstart needs none"


@pytest.mark.slow
def test_terminals_that_hang_keep_nobody_from_driving_the_robot(tmp_path: Path) -> None:
    """Nothing reads their output from the first line on, as after Ctrl-S or a lost connection."""
    write_robot(tmp_path / "robot.toml", FAST_STATES)
    roles = ("robot", "guard", "controller", "reference")
    with System(tmp_path, tmp_path / "robot.toml") as system, ExitStack() as stack:
        for role in roles:
            os.mkfifo(tmp_path / f"{role}.log")
            terminal = os.open(tmp_path / f"{role}.log", os.O_RDWR | os.O_NONBLOCK)
            stack.callback(os.close, terminal)
            with suppress(BlockingIOError):
                while True:
                    os.write(terminal, bytes(4096))
        system.start(*roles)
        system.tracking()
        system.state(lambda state: abs(state.x[3]) > 0.03)
        assert [system.interrupt(role) for role in roles] == [0, 0, 0, 0]
