# SPDX-License-Identifier: Apache-2.0
"""
Table of faults: how each is injected and mended, and which promise must hold.

Faults with the same wiring share a system; in each, the faults through which the
robot keeps driving come before those that stop it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from rti_mpc.contract.message import End, Reference
from rti_mpc.wire.streams import RELAY
from rti_mpc_service.faults.promise import HOLDS, KEEPS_ON, PAUSES, RECOVERS, REJOINS, STAYS, STOPS, WAITS, Promise
from rti_mpc_service.faults.relay import COMMANDS_LOST
from rti_mpc_service.faults.system import System, Wiring

Act = Callable[[System], int | None]

HOLD_S = 3.5
PAUSE_S = 1.5  # of the controller
LOSS_S = 0.8  # of commands
SECOND_ROBOT_S = 1.0  # life of a second robot
MALFORMED_MESSAGES = 10_000
GARBAGE = (b"", b"\x00\x00\x00\x00", b"\x00\x01\x00\x00" + bytes(24), b"\x00\x01\x00\x00" + b"\xff" * 400)  # none is a message
VIEWER_CYCLE_S, VIEWER_SHARE = 0.1, 0.05  # a slow viewer runs for this share of each cycle
REFERENCE_ENDS_S = 1.0
REFERENCE_AGE_NS = 10**12
SAMPLES_UNTIL_MENDED = 10_000  # more than a fault lasts
REFERENCE_JUMP_S = 2.0


@dataclass(frozen=True)
class Fault:
    """
    One row of the matrix.

    Attributes:
        name: Name, as `--only` takes it.
        text: Description for people.
        wiring: How the processes of its system are linked.
        promise: The promise that must hold.
        inject: Injects the fault; returns its robot time, None if it takes effect at once.
        mend: Ends the fault.
        hold_s: How long it lasts, s.
        viewer: Whether a viewer is part of the system.
    """

    name: str
    text: str
    wiring: Wiring
    promise: Promise
    inject: Act
    mend: Act
    hold_s: float = HOLD_S
    viewer: bool = False


def do_nothing(system: System) -> None:
    """Do nothing: the fault ends by itself."""


def kill(*roles: str) -> Act:
    """Return an act that kills processes by SIGKILL."""
    return lambda system: system.kill(*roles)


def start(*roles: str) -> Act:
    """Return an act that starts killed processes."""
    return lambda system: system.start(*roles)


def suspend(*roles: str) -> Act:
    """Return an act that suspends processes by SIGSTOP."""
    return lambda system: system.suspend(*roles)


def resume(*roles: str) -> Act:
    """Return an act that resumes processes by SIGCONT."""
    return lambda system: system.resume(*roles)


def slow_viewer(system: System) -> None:
    """Let the viewer run for `VIEWER_SHARE` of the time, for `HOLD_S`."""
    deadline_s = time.monotonic() + HOLD_S
    while time.monotonic() < deadline_s:
        system.suspend("viewer")
        system.pause((1.0 - VIEWER_SHARE) * VIEWER_CYCLE_S)
        system.resume("viewer")
        system.pause(VIEWER_SHARE * VIEWER_CYCLE_S)


def states(change: str, count: int | None = None) -> Act:
    """Return an act that changes `count` states, or all from now on; the fault begins at the last unchanged state."""
    request = {"fault": change} | ({} if count is None else {"states": count})
    return lambda system: int(system.ask(system.keys.of(RELAY), **request)["stamp_ns"])


def stop_and_kill(*roles: str) -> Act:
    """Return an act that stops the robot as an operator does, kills processes, and starts them again as a supervisor does."""

    def act(system: System) -> None:
        system.ask(system.keys.stop, request="stop")
        system.kill(*roles)
        system.ensure(*roles)

    return act


def enable(system: System) -> None:
    """Release the robot as an operator does."""
    system.ask(system.keys.stop, request="enable")


def solver(failure: str, samples: int) -> Act:
    """Return an act that lets the solver fail in `samples` samples; the first one is the second from now, as one is prepared already."""

    def act(system: System) -> int:
        system.ask(system.keys.request, request="inject", failure=failure, samples=samples)
        granted_ns = system.now_ns()
        system.wait(lambda: system.last_sample_ns() > granted_ns, "the next sample")
        return system.last_sample_ns() + system.period_ns

    return act


def solver_works(system: System) -> None:
    """Let the solver work again, after one more failing sample."""
    system.ask(system.keys.request, request="inject", failure="solver", samples=1)


def flood(system: System) -> None:
    """Publish malformed messages on every key that a process acts on, as fast as possible."""
    keys = system.keys
    ends: list[Any] = [system.bus.publisher(key) for key in (keys.state, keys.reference, keys.command, keys.actuation)]
    for number in range(MALFORMED_MESSAGES):
        ends[number % len(ends)].put_bytes(GARBAGE[number // len(ends) % len(GARBAGE)])


def restart(*roles: str) -> Act:
    """End processes as Ctrl-C does, and start them again."""
    return lambda system: system.restart(*roles)


def clock_in_ns(system: System) -> None:
    """Change the robot's stamps back to nanoseconds, and restart the reference, whose stamps are in the changed clock."""
    states("none")(system)
    system.restart("reference")


def fill_disk(system: System) -> None:
    """Let every write of viewer and controller to a file fail."""
    system.limit_files(0, "viewer", "controller")


def free_disk(system: System) -> None:
    """Let them write again."""
    system.limit_files(None, "viewer", "controller")


def reference_part(system: System, from_s: float, duration_s: float) -> Reference:
    """Return a part of the followed reference that starts `from_s` after now, with its own stamps; short enough for one packet."""
    followed, period_ns = system.reference, system.reference.period_ns
    first = (system.now_ns() + round(1e9 * from_s) - followed.stamp_ns) // period_ns
    rows = slice(first, first + round(1e9 * duration_s) // period_ns)
    return replace(followed, stamp_ns=followed.stamp_ns + first * period_ns, y=followed.y[rows], p=followed.p[rows])


def reference_ends(end: End) -> Act:
    """Return an act that shortens the reference to `REFERENCE_ENDS_S`; the fault begins at its last row."""

    def act(system: System) -> int:
        short = replace(reference_part(system, 0.0, REFERENCE_ENDS_S), end=end)
        system.refer(short)
        return short.stamp_ns + (len(short.y) - 1) * short.period_ns

    return act


def reference_in_the_past(system: System) -> None:
    """Publish a reference that ended long ago."""
    short = reference_part(system, 0.0, REFERENCE_ENDS_S)
    system.refer(replace(short, end=End.STOP, stamp_ns=short.stamp_ns - REFERENCE_AGE_NS))


def reference_jumps(system: System) -> None:
    """Publish the reference as it is `REFERENCE_JUMP_S` later, from now on."""
    later = reference_part(system, REFERENCE_JUMP_S, 10 * REFERENCE_JUMP_S)
    system.refer(replace(later, stamp_ns=later.stamp_ns - round(1e9 * REFERENCE_JUMP_S)))


def no_reference(system: System) -> int:
    """Start robot and controller where there is no reference."""
    system.kill("reference", "controller", "robot")
    system.start("robot", "controller")
    system.wait(lambda: system.observer.epoch, "the robot's first state")
    return 0


PEERS, ROUTER, LINK, SENSOR = Wiring
FAULTS = (
    Fault("viewer_killed", "SIGKILL of the viewer", PEERS, KEEPS_ON, kill("viewer"), do_nothing, viewer=True),
    Fault("viewer_hung", "SIGSTOP of the viewer", PEERS, KEEPS_ON, suspend("viewer"), resume("viewer"), viewer=True),
    Fault("viewer_slow", "the viewer gets 5 % of its time", PEERS, KEEPS_ON, slow_viewer, do_nothing, 0.0, viewer=True),
    Fault("disk_full", "viewer and controller cannot write", PEERS, KEEPS_ON, fill_disk, free_disk, viewer=True),
    Fault("malformed_flood", f"{MALFORMED_MESSAGES} malformed messages at once", PEERS, KEEPS_ON, flood, do_nothing),
    Fault("solver_fails", "the first solver finds nothing", PEERS, KEEPS_ON, solver("solver", SAMPLES_UNTIL_MENDED), solver_works),
    Fault("qp_fails_twice", "no solver finds anything, twice", PEERS, KEEPS_ON, solver("qp", 2), do_nothing),
    Fault("reference_killed", "SIGKILL of the reference's source", PEERS, KEEPS_ON, kill("reference"), do_nothing),
    Fault("reference_jumps", f"the reference is {REFERENCE_JUMP_S:g} s further on", PEERS, REJOINS, reference_jumps, restart("reference"), 8.0),
    Fault("reference_ends_hold", "the reference ends, to be held", PEERS, HOLDS, reference_ends(End.HOLD), restart("reference"), 6.0),
    Fault("controller_killed", "SIGKILL of the controller", PEERS, STOPS, kill("controller"), start("controller")),
    Fault("controller_hung", "SIGSTOP of the controller", PEERS, STOPS, suspend("controller"), resume("controller")),
    Fault("controller_paused", f"SIGSTOP of the controller for {PAUSE_S:g} s", PEERS, PAUSES, suspend("controller"), resume("controller"), PAUSE_S),
    Fault("guard_killed", "SIGKILL of the guard", PEERS, STOPS, kill("guard"), start("guard")),
    Fault("guard_hung", "SIGSTOP of the guard", PEERS, STOPS, suspend("guard"), resume("guard")),
    Fault("guard_and_controller_killed", "SIGKILL of both", PEERS, STOPS, kill("guard", "controller"), start("guard", "controller")),
    Fault("stop_then_controller_killed", "a stop, then SIGKILL of the controller", PEERS, STAYS, stop_and_kill("controller"), enable),
    Fault(
        "stop_then_both_killed",
        "an operator's stop, then SIGKILL of guard and controller",
        PEERS,
        STAYS,
        stop_and_kill("guard", "controller"),
        enable,
    ),
    Fault("qp_fails", "no solver finds anything", PEERS, STOPS, solver("qp", SAMPLES_UNTIL_MENDED), solver_works),
    Fault("nan_model", "the model gives NaN", PEERS, STOPS, solver("nan_model", SAMPLES_UNTIL_MENDED), solver_works),
    Fault("over_budget", "a sample takes 1.5 periods", PEERS, STOPS, solver("over_budget", SAMPLES_UNTIL_MENDED), solver_works),
    Fault("reference_ends_stop", "the reference ends with a stop", PEERS, STOPS, reference_ends(End.STOP), restart("reference"), 5.0),
    Fault("reference_stale", "a reference that ended long ago", PEERS, STOPS, reference_in_the_past, restart("reference")),
    Fault("reference_missing", "all start, but no reference", PEERS, WAITS, no_reference, start("reference")),
    Fault("robot_hung", "SIGSTOP of the simulator", PEERS, RECOVERS, suspend("robot"), resume("robot")),
    Fault("robot_killed", "SIGKILL of the simulator", PEERS, RECOVERS, kill("robot"), start("robot")),
    Fault("link_cut", "the controller's link is cut", ROUTER, STOPS, lambda system: system.link.cut(), lambda system: system.link.restore()),
    Fault("router_killed", "SIGKILL of the router", ROUTER, STOPS, kill("router"), start("router")),
    Fault("state_duplicated", "every state comes three times", LINK, KEEPS_ON, states("duplicated"), states("none")),
    Fault("state_reordered", "every two states in the wrong order", LINK, KEEPS_ON, states("reordered"), states("none")),
    Fault("commands_lost", f"commands are lost for {LOSS_S:g} s, states are not", LINK, PAUSES, states(COMMANDS_LOST), states("none"), LOSS_S),
    Fault("state_late", "every state 0.4 s late", LINK, STOPS, states("late"), states("none")),
    Fault("state_nan_once", "one state with a NaN", SENSOR, KEEPS_ON, states("nan", 1), do_nothing),
    Fault("state_nan", "every state with a NaN", SENSOR, STOPS, states("nan"), states("none")),
    Fault("state_wrong_length", "every state one number short", SENSOR, STOPS, states("short"), states("none")),
    Fault(
        "two_robots", f"a second robot of this name lives for {SECOND_ROBOT_S:g} s", SENSOR, PAUSES, states("twins"), states("none"), SECOND_ROBOT_S
    ),
    Fault("state_frozen", "the same state again and again", SENSOR, STOPS, states("frozen"), states("none")),
    Fault("clock_in_us", "the robot's stamps change from ns to us", SENSOR, STOPS, states("microseconds"), clock_in_ns),
    Fault("clock_back", "the robot's clock jumps back by 5 s", SENSOR, STOPS, states("behind"), restart("reference")),
    Fault("clock_ahead", "the robot's clock jumps ahead by 5 s", SENSOR, RECOVERS, states("ahead"), do_nothing),
)
