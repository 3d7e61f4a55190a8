# SPDX-License-Identifier: Apache-2.0
"""Record of a run by the robot itself, and times read from it."""

from __future__ import annotations

import csv
from dataclasses import dataclass

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.approach import SLEW_WINDOW_PERIODS
from rti_mpc.contract.message import State
from tests.processes.system import System, until

STANDSTILL_SPEED = 1e-3  # m/s, rad/s
SLEW = np.array([0.25, 0.40])  # of the shipped configuration, over 0.1 s
MS = 1_000_000
PERIOD_NS = 10 * MS  # of the states: the resolution of the record
FAST_STATES = f"[sim]\nstate_period_s = {1e-9 * PERIOD_NS}\n"  # what a configuration needs beside the shipped one


def moves(state: State) -> bool:
    return bool(abs(state.x[3]) > 0.03)


def rests(state: State) -> bool:
    return bool(np.abs(state.x[3:]).max() < STANDSTILL_SPEED)


@dataclass
class Record:
    """What the robot did after an instant: times in ms, inputs, speeds, and how often it had braked on its own."""

    times: Array
    inputs: Array
    speeds: Array
    starved: Array

    @property
    def braking_ms(self) -> float:
        """Time at which the first input began to move towards rest, ms after the instant."""
        return float(self.times[self.inputs[:, 0] < self.inputs[0, 0] - 1e-3][0])

    @property
    def zero_ms(self) -> float:
        return float(self.times[~self.inputs.any(axis=1)][0])

    @property
    def standing_ms(self) -> float:
        """Time from which the robot stood until the end, ms after the instant."""
        return float(self.times[(np.abs(self.speeds) >= STANDSTILL_SPEED).any(axis=1)][-1]) + 1e-6 * PERIOD_NS


def recorded(system: System, fault_ns: int, to_ms: int) -> Record:
    """Wait until the record reaches a time after a fault, and read it from the fault on."""

    def read() -> list[list[float]] | None:
        with (system.folder / "robot.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["starved"] and int(row["stamp_ns"]) >= fault_ns]
        names = ("stamp_ns", "u_c", "omega_c", "u", "omega", "starved")
        return [[float(row[name]) for name in names] for row in rows] if rows and int(rows[-1]["stamp_ns"]) >= fault_ns + to_ms * MS else None

    rows = np.array(until(read, "the record is written", pause_s=0.1))
    rows = rows[rows[:, 0] <= fault_ns + to_ms * MS]
    return Record((rows[:, 0] - fault_ns) / MS, rows[:, 1:3], rows[:, 3:5], rows[:, 5])


def within_slew(record: Record) -> None:
    """Whether inputs keep to the slew limits over three quarters of a period: late and punctual commands may begin less than a period apart."""
    for rows in range(1, round(SLEW_WINDOW_PERIODS * 100 * MS) // PERIOD_NS + 1):
        changes = np.abs(record.inputs[rows:] - record.inputs[:-rows])
        assert (changes <= SLEW + 1e-6).all(), (rows, changes.max(axis=0))
