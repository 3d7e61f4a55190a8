# SPDX-License-Identifier: Apache-2.0
"""Record of a simulated robot as arrays: the true states, by which a controller is judged."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.wire.actuator import Counters
from rti_mpc.wire.info import Info

COUNTERS = tuple(field.name for field in fields(Counters))


@dataclass(frozen=True, eq=False)
class RobotLog:
    """
    Record with one row per state of the robot.

    Attributes:
        stamp_ns: Stamps, robot time, shape ``(M,)``.
        seq: Sequence numbers, shape ``(M,)``.
        x: True states, shape ``(M, nx)``.
        u: Inputs that acted up to the stamps, shape ``(M, nu)``.
        latency_us: Time from sending a state to receiving the first command that answers it, NaN where none came, shape ``(M,)``.
        counters: Counters of commands at the last row.
    """

    stamp_ns: NDArray[np.int64]
    seq: NDArray[np.int64]
    x: Array
    u: Array
    latency_us: Array
    counters: dict[str, int]

    def part(self, rows: NDArray[np.bool_]) -> RobotLog:
        """Return the selected rows, with the counters of the whole record."""
        return RobotLog(self.stamp_ns[rows], self.seq[rows], self.x[rows], self.u[rows], self.latency_us[rows], self.counters)


def read(path: Path, info: Info) -> RobotLog:
    """
    Read the record of a robot.

    Args:
        path: CSV file, see `rti_mpc_sim.log`.
        info: Names of states and inputs.
    """
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))

    def numbers(names: Sequence[str]) -> Array:
        return np.array([[float(row[name] or "nan") for name in names] for row in rows]).reshape(len(rows), len(names))

    return RobotLog(
        stamp_ns=np.array([int(row["stamp_ns"]) for row in rows], dtype=np.int64),
        seq=np.array([int(row["seq"]) for row in rows], dtype=np.int64),
        x=numbers([label.name for label in info.states]),
        u=numbers([label.name for label in info.inputs]),
        latency_us=numbers(["latency_us"])[:, 0],
        counters={name: int(rows[-1][name]) if rows else 0 for name in COUNTERS},
    )
