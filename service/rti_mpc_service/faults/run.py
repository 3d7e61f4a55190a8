# SPDX-License-Identifier: Apache-2.0
"""
Fault injection into real processes, one fault after another; the robot's reaction is compared with a promise.

Systems start as `demo` starts them, at real speed. The faults of one wiring are
injected into one system, each after the robot is driven again; after a broken promise
a new system is started.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from difflib import get_close_matches
from importlib.util import find_spec
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.limits import Limits
from rti_mpc.errors import ConfigError
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc_service.config.build import build_ocp, build_signals, guard_limits, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.fit import check_model, check_period, check_stop, check_tree
from rti_mpc_service.config.schema import Config
from rti_mpc_service.console import plain_console
from rti_mpc_service.entry import EXIT_FAILED, say
from rti_mpc_service.faults.excuse import excuses, explained
from rti_mpc_service.faults.measure import STANDSTILL_SPEED_M_S, Incident, measure, missed_ns
from rti_mpc_service.faults.motion import Motion
from rti_mpc_service.faults.relay import ROLE as RELAY
from rti_mpc_service.faults.report import MatrixReport, MatrixRow
from rti_mpc_service.faults.system import System, Wiring
from rti_mpc_service.faults.table import FAULTS, Fault
from rti_mpc_service.host.hold_up import Host, Unwitnessed
from rti_mpc_service.json_text import json_text
from rti_mpc_service.rig.company import Failed
from rti_mpc_service.rig.robot_log import RobotLog
from rti_mpc_service.rig.scenario import BEST_HEADINGS, configured, reference_options
from rti_mpc_service.scenario import Scenario, find_scenario

if TYPE_CHECKING:
    from rti_mpc.rti.way_to_rest import StopLaw

STATE_PERIOD_S = 0.01  # of the robot and of its record: the resolution of every measured time
ROLES_OF_WIRING = {
    Wiring.PEERS: ("controller", "guard", "reference", "robot"),
    Wiring.ROUTER: ("router", "controller", "guard", "reference", "robot"),
    Wiring.LINK: (RELAY, "controller", "guard", "reference", "robot"),
    Wiring.SENSOR: (RELAY, "controller", "guard", "reference", "robot"),
}
MAX_SETTLED_ERROR_M = 0.001
NEAR_S = 1.0  # for which it is then that near: one that swings about its reference passes it now and then
SETTLING_S = 20.0  # for a robot to come that near to its reference; one that does not is measured against its own error
BEFORE_NS = 5_000_000_000  # robot time before a fault in which that error is looked for
RECOVERY_TIMEOUT_S = 20.0
REFERENCE_DURATION_S = 120.0  # at most: 58 kB fit into one packet, so that a busy host cannot drop a part of it
MAX_REFERENCE_LEFT_S = 35.0  # duration of the reference that a fault needs, at most
MIN_REFERENCE_S = MAX_REFERENCE_LEFT_S + SETTLING_S + 5.0  # and to be driven at first
HELD_UP = "not judged, the host held the processes up"
AFTER_RECOVERY_S = 0.3  # how long the robot is recorded after it has recovered
AT_REST_S = 0.3  # how long a robot is seen with its inputs at rest after its ramp
STANDING_S = 1.0  # how long a robot is seen to stand after its way to rest
RECORD_TIMEOUT_S = 5.0  # for the robot to write its record; a line waits up to a second for an answer


def main(
    config_path: Path,
    only: Sequence[str],
    path: Path | None,
    scenario: str | None = None,
    waypoint_speed_m_s: float = 0.25,
    waypoint_smoothing_m: float | None = None,
    record: Path | None = None,
) -> int:
    """
    Inject faults, print the matrix, and write it to a file if asked to.

    Args:
        config_path: The robot's TOML file.
        only: Names of faults; empty: all.
        path: JSON file to write.
        scenario: What the robot follows, see `rti_mpc_service.scenario.find_scenario`; also of the other two.
        waypoint_speed_m_s: Speed along waypoints.
        waypoint_smoothing_m: Path that waypoints are averaged over.
        record: Folder for a recording of each system; None: nothing is recorded.

    Returns:
        Exit status: 0 if every promise was kept; 1 if one was not, or the host has no witness.

    Raises:
        ConfigError: A name is unknown, the robot cannot be guarded or has no pose to start from, a command does not last until the next, the
            scenario ends too early, or the folder cannot take recordings.
        ModuleNotFoundError: It is to be recorded, without the extra that does that.
    """
    faults = chosen(only)
    if record is not None:
        make_folder(record)
    config = load(config_path)
    check_period(config)
    heading = BEST_HEADINGS.get(scenario or "")
    followed = find_scenario(config, scenario, heading, REFERENCE_DURATION_S, waypoint_speed_m_s, waypoint_smoothing_m)
    config = prepared(config, followed)
    reference = reference_options(scenario, followed, moving_s(config, followed), waypoint_speed_m_s, waypoint_smoothing_m)
    with MatrixReport(console := plain_console(), len(faults)) as report:
        report.say(faults[0], "finding how the robot comes to rest")
        faults = of_robot(faults, config, check_stop(config))
        stop = stop_on_signals()
        try:
            with Host() as host:
                folder = Path(tempfile.mkdtemp(prefix="rti-mpc-faults-"))
                inject(config, faults, folder, report, stop, host, reference, record)
        except Unwitnessed as error:  # from the start
            say(str(error))
            return EXIT_FAILED
    report.conclude()
    if record is not None:
        console.print(f"recordings {record}, to be repeated by: rti-mpc replay {record}", soft_wrap=True)
    if report.complete and report.kept:
        shutil.rmtree(folder)
    else:
        console.print(f"what the processes said and the robot recorded: {folder}", soft_wrap=True)
    if path is not None:
        path.write_text(json_text([row.to_json() for row in report.rows]) + "\n", encoding="utf-8")
    return 0 if report.kept and not stop.is_set() else 1


def make_folder(record: Path) -> None:
    """
    Make the folder of the recordings.

    Raises:
        ConfigError: It cannot be made.
        ModuleNotFoundError: The extra that records is not installed.
    """
    if find_spec("mcap") is None:
        raise ModuleNotFoundError(name="mcap")
    try:
        record.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--record must be a folder that can be written, got {record}: {error.strerror}") from error


def chosen(only: Sequence[str]) -> list[Fault]:
    """
    Return faults by their names, in the order of the table.

    Raises:
        ConfigError: There is no fault of a name.
        ModuleNotFoundError: A named fault needs a viewer, which is not installed; without names, such faults are left out.
    """
    names = [fault.name for fault in FAULTS]
    if unknown := [name for name in only if name not in names]:
        near = get_close_matches(unknown[0], names, n=1)
        about = next((f"perhaps {fault.name} is meant ({fault.text})" for fault in FAULTS if fault.name in near), "")
        raise ConfigError(f"--only must be the name of a fault, {about or 'the names are in: rti-mpc faults --help'}, got {unknown[0]!r}")
    faults = [fault for fault in FAULTS if fault.name in only or not only]
    if find_spec("rerun") is not None:
        return faults
    if only and any(fault.viewer for fault in faults):
        raise ModuleNotFoundError(name="rerun")
    return [fault for fault in faults if not fault.viewer]


def prepared(config: Config, scenario: Scenario) -> Config:
    """Return the configuration of a run: from the scenario's pose, guarded, with states that come fast enough to measure by."""
    config = configured(config, scenario, guard=True)
    content = config.model_dump(by_alias=True, exclude_unset=True)
    content["debug"] = {"inject": True}
    content["sim"] = {**content.get("sim", {}), "state_period_s": min(STATE_PERIOD_S, config.ocp.dt_s)}
    config = Config.model_validate(content)
    check_tree(config)
    check_model(config)
    return config


def moving_s(config: Config, scenario: Scenario) -> float:
    """
    Return how long a scenario moves the robot, in s.

    Raises:
        ConfigError: Not for as long as a fault may need.
    """
    y = scenario.y(robot_settings(config)["x0"])
    rows = np.flatnonzero(np.diff(y, axis=0).any(axis=1))
    duration_s = scenario.period_s * float(rows[-1] + 1) if rows.size else 0.0
    if duration_s < MIN_REFERENCE_S:
        raise ConfigError(f"--scenario must move the robot for at least {MIN_REFERENCE_S:g} s, {scenario.name} does for {duration_s:.3g} s")
    return duration_s


def of_robot(faults: Sequence[Fault], config: Config, law: StopLaw | None) -> list[Fault]:
    """
    Return faults as a robot must bear them: one that ramps to rest, as fast as its slew limits allow; one that coasts; one that goes a way to rest.

    They last until that is over.
    """
    if law is None:
        ramp_s = guard_limits(config, build_signals(config)).ramp_s
        faults = [by_ramp(fault, ramp_s) for fault in faults]
    if config.model.stop == "coasts":
        return [replace(fault, promise=fault.promise.without_standstill()) for fault in faults]
    if law is None:
        return list(faults)
    from rti_mpc.rti.rest import standing_s

    ocp = build_ocp(config)
    within_s = config.timing.valid_s + standing_s(ocp, law, Motion(ocp.model).position, STANDSTILL_SPEED_M_S)
    return [by_way(fault, within_s, disturbed=law.disturbances.size > 0) for fault in faults]


def by_ramp(fault: Fault, ramp_s: float) -> Fault:
    """Return a fault as a robot must bear it whose slew limits take so long from its widest inputs to rest."""
    promise = fault.promise.by_ramp(ramp_s)
    return fault if promise == fault.promise else replace(fault, promise=promise, hold_s=max(fault.hold_s, promise.at_most["zero_s"] + AT_REST_S))


def by_way(fault: Fault, within_s: float, *, disturbed: bool) -> Fault:
    """Return a fault as a robot must bear it that stands so long after the fault, and before it is commanded only if nothing disturbs it."""
    if "brake_s" not in fault.promise.at_most:
        return replace(fault, promise=fault.promise.without_standstill()) if disturbed else fault
    stands = "still_s" in fault.promise.at_most
    return replace(fault, promise=fault.promise.by_way(within_s), hold_s=max(fault.hold_s, within_s + STANDING_S) if stands else fault.hold_s)


def inject(
    config: Config,
    faults: Sequence[Fault],
    folder: Path,
    report: MatrixReport,
    stop: Event,
    host: Host,
    reference: Sequence[object] = (),
    record: Path | None = None,
) -> None:
    """Inject all faults one after the other, or until stopped; `reference` are options of `rti-mpc reference`, `record` is a folder of recordings."""
    limits = guard_limits(config, build_signals(config))
    system: System | None = None
    with ExitStack() as stack:
        for number, fault in enumerate(faults):
            if stop.is_set():
                return
            begun_ns = time.monotonic_ns()
            try:
                if system is None or system.wiring is not fault.wiring:
                    stack.close()
                    report.say(fault, f"starting {fault.wiring.value}")
                    recording = None if record is None else record / f"{number:02}-{fault.wiring.value}.mcap"
                    system = stack.enter_context(System(config, fault.wiring, folder / f"{number}", stop, reference, recording, report.waiting))
                near = make_ready(system, fault, report)
                row = suffer(system, fault, limits, report, host, near)
            except Failed as error:
                row = MatrixRow(fault, None, [f"{error}{held_up(host, begun_ns)}"])
            except (ConfigError, Unwitnessed) as error:
                row = MatrixRow(fault, None, [str(error)])
            if stop.is_set():
                return
            report.add(row)
            if row.broken:
                stack.close()
                system = None


def held_up(host: Host, since_ns: int) -> str:
    """Return, in words, that the host has held the processes up for most of the time since an instant; else an empty string."""
    until_ns = time.monotonic_ns()
    took_s = 1e-9 * (until_ns - since_ns)
    try:
        held_up_s = 1e-3 * host.held_up_ms(since_ns, until_ns)
    except Unwitnessed:
        return ""
    return f": {HELD_UP} for {held_up_s:.0f} s in {took_s:.0f} s" if held_up_s > 0.5 * took_s else ""


def make_ready(system: System, fault: Fault, report: MatrixReport) -> bool:
    """
    Wait until the robot is driven; on its path if the fault's promise is about the distance from it, and knowing what a stop is to balance.

    Returns:
        Whether it stays as near to its reference as it should be; False after `SETTLING_S` without.

    Raises:
        Failed: The robot is not driven in time.
    """
    report.say(fault, "waiting for the robot to be driven")
    system.ensure(*ROLES_OF_WIRING[fault.wiring], *(("viewer",) if fault.viewer else ()))
    error_m, near_s = (MAX_SETTLED_ERROR_M, NEAR_S) if fault.promise.on_path else (np.inf, 0.0)
    begun_ns: int | None = None  # since when it follows this reference
    away_ns = 0
    near = False

    def ready() -> bool:
        nonlocal begun_ns, away_ns, near
        if renewed(system, min(fault.hold_s + RECOVERY_TIMEOUT_S, MAX_REFERENCE_LEFT_S)):
            begun_ns = None
        now_ns = time.monotonic_ns()
        if begun_ns is None:
            if not system.driven():
                return False
            begun_ns = away_ns = now_ns
        here = system.driven(error_m)
        away_ns = away_ns if here else now_ns
        near = here and now_ns - away_ns >= 1e9 * near_s
        return (near and system.estimated()) or (now_ns - begun_ns > 1e9 * SETTLING_S and system.driven())

    system.wait(ready, "the robot to be driven", missing=system.undriven)
    return near


def renewed(system: System, lasts_s: float) -> bool:
    """
    Let the reference begin anew if it ends sooner than in `lasts_s`: a robot is waited for longer than it lasts where the host is slow.

    Raises:
        Failed: Its source does not send another one.
    """
    if not (system.witness.begun and system.observer.epoch) or system.reference_left_s() >= lasts_s:
        return False
    system.restart("reference")
    system.wait(lambda: system.witness.listen() and system.reference_left_s() >= lasts_s, "another reference")
    return True


def suffer(system: System, fault: Fault, limits: Limits, report: MatrixReport, host: Host, near: bool) -> MatrixRow:
    """
    Inject a fault, mend it, wait for recovery, and measure the reaction, with the excuses of the host.

    Raises:
        Failed: Nothing can be measured.
    """
    report.say(fault, fault.text)
    fault_ns, mend_ns = endure(system, fault)
    lives = system.lives["robot"]
    reference = system.witness.reference
    report.say(fault, "waiting for the robot to recover")
    fault.mend(system)
    if system.lives["robot"] != lives:  # another life: nothing of the last one counts
        system.wait(lambda: system.observer.epoch, "the robot's first state")
        fault_ns = mend_ns = 0
    recovered(system, mend_ns, host)
    system.pause(AFTER_RECOVERY_S)
    end_ns = system.now_ns()
    system.wait(lambda: system.logged_ns() >= end_ns, "the robot's record", RECORD_TIMEOUT_S)
    if system.stopped:
        raise Failed("stopped")
    log, incident = system.log(), Incident(fault_ns, mend_ns, end_ns)
    position = system.motion.position(log.x)
    wanted = system.motion.wanted(reference, log.stamp_ns)
    error = system.motion.distance(position, wanted)
    moves = system.motion.distance(wanted[1:], wanted[:-1])
    measured, missed = measure(log, position, error, incident, limits), missed_ns(log, incident, limits.dt_s)
    promise = fault.promise if near else fault.promise.eased(error_before(log, error, incident))

    def held_up_ms(from_ns: int, to_ns: int) -> float:
        return host.held_up_ms(system.observer.arrival_ns(from_ns), system.observer.arrival_ns(to_ns))

    def moved_m(from_ns: int, to_ns: int) -> float:
        return float(np.nansum(moves[(log.stamp_ns[1:] > from_ns) & (log.stamp_ns[1:] <= to_ns)]))

    excused = excuses(measured, missed, incident, system.period_ns, held_up_ms=held_up_ms, moved_m=moved_m)
    return MatrixRow(fault, measured, promise.broken(measured, excused), explained(promise, measured, excused), system.motion.unit)


def endure(system: System, fault: Fault) -> tuple[int, int]:
    """Inject a fault, and wait for as long as it is to last from its beginning on; return when that was and when it is to end, robot time."""
    before_ns = system.now_ns()
    injected_ns = fault.inject(system)
    fault_ns = before_ns if injected_ns is None else injected_ns
    system.pause(1e-9 * max(0, fault_ns - system.now_ns()) + fault.hold_s)
    return fault_ns, max(system.now_ns(), fault_ns + round(2e9 * STATE_PERIOD_S))


def error_before(log: RobotLog, error: Array, incident: Incident) -> float:
    """Return the largest error in the time before a fault; 0 in the first moments of a robot."""
    before = (log.stamp_ns < incident.fault_ns) & (log.stamp_ns >= incident.fault_ns - BEFORE_NS)
    return float(error[before].max(initial=0.0))


def recovered(system: System, mend_ns: int, host: Host) -> None:
    """
    Wait until the robot is driven by answers to its present states; if it is not, the measurement says so.

    The time for which the host holds the processes up does not count, nor does a reference that ends meanwhile.
    """
    begun_ns = time.monotonic_ns()
    deadline_ns = begun_ns + round(1e9 * RECOVERY_TIMEOUT_S)

    def over() -> bool:
        nonlocal deadline_ns
        now_ns = time.monotonic_ns()
        if now_ns > deadline_ns:
            patience_ns = 1e9 * RECOVERY_TIMEOUT_S + 1e6 * host.held_up_ms(begun_ns, now_ns)
            deadline_ns = min(begun_ns + round(patience_ns), now_ns + round(1e9 * RECOVERY_TIMEOUT_S))
            if now_ns < deadline_ns:
                renewed(system, RECOVERY_TIMEOUT_S)
        return now_ns > deadline_ns

    with suppress(Failed):
        system.wait(
            lambda: (system.driven() and system.last_sample_ns() > mend_ns) or over(), "the robot to be driven again", missing=system.undriven
        )
