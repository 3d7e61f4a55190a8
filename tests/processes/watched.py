# SPDX-License-Identifier: Apache-2.0
"""A robot, a leader and its standbys as processes; every command on the bus is kept."""

from __future__ import annotations

import csv
import time
from pathlib import Path

import numpy as np

from rti_mpc.contract.approach import SLEW_WINDOW_PERIODS
from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.message import Command, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.wire.cdr import decode
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.shipped import SHIPPED
from tests.guarded import write_robot
from tests.in_time import BEFORE_NS, MS, SEEN, on_time
from tests.processes.system import KEYS, System, heard, owner, until

ARGUMENTS: dict[str, tuple[object, ...]] = {
    "robot": ("sim", "--x0", "x=0.5"),  # at real speed: the promises are in the robot's time
    "leader": ("run",),
    "standby": ("run", "--standby"),
    "third": ("run", "--standby"),
    "reference": ("reference", "--scenario", "eight", "--duration", 600),
}
CONTROLLERS = {"leader", "standby", "third"}
SPEED_LIMIT, TURN_LIMIT = 2.5, 4.0  # m/s^2, rad/s^2


def configuration(folder: Path, dt_s: float, live: bool = False, more: str = "") -> Path:
    """The shipped robot at another period, its slew limits per second the same."""
    text = SHIPPED.read_text() + more
    for old, new in (
        ("dt_s = 0.1 ", f"dt_s = {dt_s} "),
        ("[-0.25, 0.25]", f"[{-SPEED_LIMIT * dt_s}, {SPEED_LIMIT * dt_s}]"),
        ("live = false", f"live = {str(live).lower()}"),
        ("[-0.40, 0.40]", f"[{-TURN_LIMIT * dt_s}, {TURN_LIMIT * dt_s}]"),
    ):
        assert old in text
        text = text.replace(old, new)
    return write_robot(folder / "robot.toml", text=text)


class Watched(System):
    """A system with a record of every command on the bus and of everything that a guard publishes."""

    def __init__(self, folder: Path, dt_s: float, live: bool = False, more: str = "", tls: Path | None = None) -> None:
        super().__init__(folder, configuration(folder, dt_s, live, more), tls, **ARGUMENTS)
        self.dt_s = dt_s
        self.driven_ns = self.driven_stamp_ns = 0  # since when it is driven: by the monotonic clock, and by the robot's
        self.commands: list[Command] = []
        self.actuation: list[Command] = []
        self._inboxes = [
            (self.bus.subscriber(key, capacity=8192), messages) for key, messages in ((KEYS.actuation, self.actuation), (KEYS.command, self.commands))
        ]

    def drive(self, *guards: str) -> None:
        """Let a leader drive the robot, beside whom another stands by."""
        self.start("robot", *guards, "leader")
        until(lambda: "controller" in self.lives, "a leader")
        self.start("standby", "reference")
        until(lambda: "standby" in self.lives, "a standby")
        heard(self.bus.subscriber(KEYS.standby_telemetry), Telemetry, lambda sample: sample.mode is Mode.TRACKING)
        self.driven_stamp_ns = self.state(lambda state: abs(state.x[3]) > 0.05).stamp_ns
        self.driven_ns = time.monotonic_ns()

    def listen(self) -> list[Command]:
        for inbox, messages in self._inboxes:  # first what the guard has made of commands: then these are here, too
            messages += [decode(Command, received.payload) for received in inbox.drain()]
        return self.commands

    def process(self, epoch: int) -> str:
        """Return the controller that an epoch belongs to."""
        return next(role for role in CONTROLLERS & self.running.keys() if owner(self.said(role)) == epoch % (1 << NUMBER_BITS))

    def led_by_another(self, epoch: int) -> Command:
        """Wait for a command of a higher epoch."""
        return until(lambda: next((command for command in self.listen() if command.epoch > epoch), None), "another epoch")

    def answers(self, first: Command, count: int) -> None:
        """Wait until a leader has sent this number of further commands."""
        until(lambda: any(command.epoch == first.epoch and command.seq >= first.seq + count for command in self.listen()), "more commands")

    def samples_of_two_epochs(self) -> list[int]:
        """States that more than one leader has answered."""
        self.listen()
        answers = {(command.state_seq, command.epoch) for command in self.commands}
        return sorted(seq for seq in {seq for seq, _ in answers} if sum(seq == other for other, _ in answers) > 1)

    def log(self) -> list[dict[str, str]]:
        with (self.folder / "robot.csv").open(newline="") as file:
            return [row for row in csv.DictReader(file) if None not in row.values()]

    def answered_ns(self, command: Command) -> int:
        """Latest time at which the robot took a command, by its log, which holds the first answer to each state, possibly a guard's ramp."""

        def look() -> int | None:
            answered = [row for row in self.log() if int(row["seq"]) >= command.state_seq and row["command_seq"]]
            times = [int(row["stamp_ns"]) + round(1e3 * float(row["latency_us"])) for row in answered if int(row["command_seq"]) >= command.seq]
            return min(times, default=None)

        return until(look, "the robot's log tells of the command", pause_s=0.05)


def half_period(dt_s: float) -> str:
    """What a configuration needs for two states a period, so that inputs are recorded more often than their slew limits may be used up."""
    return f"\n[sim]\nstate_period_s = {dt_s / 2}\n"


def relieved(host: Host, system: Watched, since_ns: int) -> bool:
    """Whether the host has held processes up for so long that a living leader may have been taken for silent; prints it if so."""
    silent_ms = 1e3 * max(3 * system.dt_s, 0.05)
    worst_ms = host.worst_ms(since_ns - BEFORE_NS, time.monotonic_ns(), round(silent_ms * MS))
    if so := worst_ms >= SEEN * (silent_ms - 1e3 * system.dt_s):
        print(f"\na living leader may have been relieved: within {silent_ms:.0f} ms the host held processes up for {worst_ms:.0f} ms")
    return so


def within_limits(host: Host, system: Watched) -> None:
    """Check that inputs never jumped, and commands never ran out, unless the host held up the process that had to answer."""
    rows = system.log()
    t_s = 1e-9 * np.array([int(row["stamp_ns"]) for row in rows])
    u = np.array([[float(row["u_c"]), float(row["omega_c"])] for row in rows])
    near = np.diff(t_s) <= SLEW_WINDOW_PERIODS * system.dt_s  # late and punctual commands may begin less than a period apart
    assert near.mean() > 0.5
    assert np.all(np.abs(np.diff(u, axis=0)[near]) <= np.array([SPEED_LIMIT, TURN_LIMIT]) * system.dt_s + 1e-9)  # rounding
    driven = [row for row in rows if int(row["stamp_ns"]) >= system.driven_stamp_ns]  # while processes start, they hold each other up
    starved = int(driven[-1]["starved"]) - int(driven[0]["starved"])
    assert starved == 0 or not on_time(host, "what acts", 1e3 * system.dt_s, system.driven_ns)
