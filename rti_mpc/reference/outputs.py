# SPDX-License-Identifier: Apache-2.0
r"""
References of outputs, for robots that follow no path in the plane: sines, steps, or a CSV file with a column for each output.

Sines and steps begin at the outputs that the robot has, and stay inside bounds: output
:math:`i` moves in what lies within its reach :math:`r_i`, `REACH` in its SI unit, of its start :math:`y_{0,i}`,

.. math::

    [\max(\underline y_i, y_{0,i} - r_i), \min(\overline y_i, y_{0,i} + r_i)] .

A robot cannot follow more outputs at will than it has inputs, so others than those that
are to move keep their start.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import End
from rti_mpc.errors import ConfigError
from rti_mpc.reference.waypoint_file import MAX_CSV_BYTES, SEPARATORS, decimal, is_comment, is_number, split
from rti_mpc.rotation import Rotations
from rti_mpc.signals import Signal
from rti_mpc.text_file import read_text_file

REACH = 0.5  # from its start that an output moves at most, in its SI unit
ROOM_SHARE = 0.9  # of the room inside bounds that is used
PERIODS = 6  # of the slowest reference that is followed

Rows = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class OutputReference:
    """
    Outputs over time, from those of a robot at the start.

    Attributes:
        name: Scenario, as on the command line.
        rows: Of the outputs at the start, shape ``(ny,)``, and times since then, ``(M,)`` in s, the outputs wanted, ``(M, ny)``.
        duration_s: How long it is followed.
        end: What to do after its last row.
    """

    name: str
    rows: Rows
    duration_s: float
    end: End = End.HOLD

    def lasting(self, duration_s: float) -> OutputReference:
        """Return this reference with another duration, in s."""
        return replace(self, duration_s=duration_s)


def sines(lower: Array, upper: Array, moving: Sequence[int], period_s: float = 10.0, reach: float | Array = REACH) -> OutputReference:
    """
    Build a sine in each output that moves, each slower than the one before, so that not all turn back at once.

    Args:
        lower: Lower bounds of the outputs, shape ``(ny,)``, infinite where there is none; likewise `upper`.
        upper: Their upper bounds.
        moving: Indices of the outputs that move.
        period_s: Of the first of them.
        reach: How far from its start each output moves at most, shape ``(ny,)``, or one number for all, in their units.
    """
    periods_s = period_s * (1.0 + 0.5 * np.arange(len(moving)))

    def rows(y0: Array, t: Array) -> Array:
        y = np.tile(y0, (len(t), 1))
        low, high = room(y0, lower, upper, reach)
        middle, amplitude = 0.5 * (low + high), 0.5 * ROOM_SHARE * (high - low)
        for i, turn_s in zip(moving, periods_s, strict=True):
            if amplitude[i] > 0.0:
                phase = math.asin(float(np.clip((y0[i] - middle[i]) / amplitude[i], -1.0, 1.0)))
                y[:, i] = middle[i] + amplitude[i] * np.sin(2 * np.pi * t / turn_s + phase)
        return y

    return OutputReference("sines", rows, PERIODS * period_s)


def steps(lower: Array, upper: Array, moving: Sequence[int], period_s: float = 10.0, reach: float | Array = REACH) -> OutputReference:
    """Build steps there and back, of one output after another, every half period; arguments as of `sines`."""

    def rows(y0: Array, t: Array) -> Array:
        y = np.tile(y0, (len(t), 1))
        low, high = room(y0, lower, upper, reach)
        step = ROOM_SHARE * np.where(high - y0 >= y0 - low, high - y0, low - y0)
        steps_so_far = np.floor(2 * t / period_s).astype(int)
        for k, i in enumerate(moving):
            toggled = (steps_so_far - k - 1) // len(moving) + 1
            y[:, i] += step[i] * (toggled % 2)
        return y

    return OutputReference("steps", rows, PERIODS * period_s)


OUTPUT_SCENARIOS = {"sines": sines, "steps": steps}


def room(y0: Array, lower: Array, upper: Array, reach: float | Array) -> tuple[Array, Array]:
    """Return between which values outputs may move that start at `y0`, all of shape ``(ny,)``; at a bound that the start exceeds, not at all."""
    low, high = np.maximum(lower, y0 - reach), np.minimum(upper, y0 + reach)
    return np.minimum(low, high), np.maximum(low, high)


def recorded(path: Path, outputs: Sequence[Signal], rotations: Rotations) -> OutputReference:
    """
    Read outputs over time from a CSV file: a column ``t`` in s and one for each output, by name, in its unit.

    Columns come in any order and among others, times from any start on. In between outputs are interpolated, rotations among
    them without jumps. Empty lines and lines that begin with ``#`` are skipped.

    Raises:
        ConfigError: The file cannot be read, an output has no column, or a number is none: file, line and column are named.
    """
    columns = ("t", *(output.name for output in outputs))
    cells = list(_cells(path))
    number, header = cells[0] if cells else (1, [])
    if missing := [name for name in columns if name not in header]:
        raise ConfigError(
            f"{path}, line {number}: the header must name t and every output of the model, {missing[0]} is missing, "
            f"got {', '.join(header) or 'nothing'}"
        )
    table = np.array([[_number(path, line, name, row, header.index(name)) for name in columns] for line, row in cells[1:]]).reshape(-1, len(columns))
    if len(table) < 2:
        raise ConfigError(f"{path}: must have at least two lines below its header, got {len(table)}")
    t = table[:, 0] - table[0, 0]
    if (late := np.diff(t) <= 0.0).any():
        raise ConfigError(f"{path}, line {cells[2 + int(np.argmax(late))][0]}, column t: must be later than in the line before")
    y = table[:, 1:]
    rotations.unwrap(y)

    def rows(y0: Array, times: Array) -> Array:
        return np.column_stack([np.interp(times, t, y[:, i]) for i in range(y.shape[1])])

    return OutputReference(path.stem, rows, float(t[-1]))


def names_outputs(path: Path, outputs: Sequence[Signal]) -> bool:
    """Whether a CSV file holds times and all outputs by name, as `recorded` reads it, not waypoints."""
    header = next((row for _, row in _cells(path)), [])
    return {"t", *(output.name for output in outputs)} <= set(header)


def _cells(path: Path) -> list[tuple[int, list[str]]]:
    """Return the lines of a CSV file that hold something, with their numbers; separated as `rti_mpc.reference.waypoint_file` has it."""
    lines = enumerate(read_text_file(path, "CSV", MAX_CSV_BYTES).splitlines(), 1)
    rows = [(i, line) for i, line in lines if line.strip(" \t,;") and not is_comment(line)]
    separator = next((mark for mark in SEPARATORS if rows and mark in rows[0][1]), " ")
    try:
        return [(i, split(line, separator)) for i, line in rows]
    except csv.Error as error:
        raise ConfigError(f"{path}: must be CSV, got {error}") from error


def _number(path: Path, line: int, name: str, cells: Sequence[str], column: int) -> float:
    """Read one finite number."""
    cell = cells[column] if column < len(cells) else ""
    value = float(decimal(cell)) if is_number(cell) else math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{path}, line {line}, column {name}: must be a finite number, got {cell!r}")
    return value
