# SPDX-License-Identifier: Apache-2.0
"""
The robot's own record as CSV: one line per state, written once its answer is known.

Columns: ``stamp_ns, seq``, the true state by name, the inputs that acted up to
that instant by name, ``command_seq, latency_us`` of the first command answering
the state (sent to received, by the monotonic clock; empty if none came), and
the counters ``lost, late, expired, refused, starved`` so far.
"""

from __future__ import annotations

import csv
import os
from collections import OrderedDict
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

from rti_mpc.array import Array
from rti_mpc.errors import ConfigError
from rti_mpc.model.model import Model
from rti_mpc.wire.actuator import Counters

ANSWER_TIMEOUT_NS = 1_000_000_000  # by the monotonic clock: later answers to a state are not recorded


@dataclass(slots=True)
class Line:
    """Line of one state: the cells before and after those of its answer."""

    measured_ns: int
    before: list[Any]
    after: tuple[int, ...]
    sent_ns: int = 0
    command_seq: int | None = None
    latency_us: float | None = None


class Log:
    """
    Writes the record; without a path, nothing is written.

    Raises:
        ConfigError: The file cannot be written.
    """

    def __init__(self, path: Path | None, model: Model) -> None:
        try:
            self._file = open(path or os.devnull, "w", newline="", buffering=1, encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"log must be a file that can be written, got {path}: {error.strerror}") from error
        self._writer = csv.writer(self._file)
        names = [signal.name for signal in (*model.states, *model.inputs)]
        self._writer.writerow(["stamp_ns", "seq", *names, "command_seq", "latency_us", *(field.name for field in fields(Counters))])
        self._lines: OrderedDict[int, Line] = OrderedDict()  # by seq, bounded by patience

    def measured(self, seq: int, stamp_ns: int, x: Array, u: Array, counters: Counters, monotonic_ns: int) -> None:
        """Begin the line of a state."""
        self._lines[seq] = Line(monotonic_ns, [stamp_ns, seq, *x.tolist(), *u.tolist()], astuple(counters))

    def sent(self, seq: int, monotonic_ns: int) -> None:
        """Note when a state left."""
        if seq in self._lines:
            self._lines[seq].sent_ns = monotonic_ns

    def answered(self, state_seq: int, command_seq: int, monotonic_ns: int) -> None:
        """Note when the first command answering a state arrived."""
        line = self._lines.get(state_seq)
        if line and line.sent_ns and line.command_seq is None:
            line.command_seq, line.latency_us = command_seq, 1e-3 * (monotonic_ns - line.sent_ns)

    def write(self, monotonic_ns: int) -> None:
        """Write the lines, in order, up to the first that may still be answered."""
        while self._lines:
            seq, line = next(iter(self._lines.items()))
            if line.command_seq is None and monotonic_ns - line.measured_ns < ANSWER_TIMEOUT_NS:
                return
            del self._lines[seq]
            self._writer.writerow([*line.before, line.command_seq, line.latency_us, *line.after])

    def close(self) -> None:
        """Write what is left, answered or not."""
        self.write(2**63)
        self._file.close()
