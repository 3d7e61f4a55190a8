# SPDX-License-Identifier: Apache-2.0
"""
CSV files of waypoints, as people and tools write them: the columns x and y in m, wherever they stand; of tracks, also widths and speeds.

Columns are separated by comma, semicolon, tab or spaces. Names are in the first line, or
in a comment before the numbers, as racelines have them (``# s_m; x_m; y_m``). Without
names the first two columns are meant, unless the first may just as well be a time.
"""

from __future__ import annotations

import csv
import math
import re
from itertools import pairwise
from pathlib import Path

import numpy as np

from rti_mpc.array import Array
from rti_mpc.errors import ConfigError
from rti_mpc.text_file import read_text_file

MAX_CSV_BYTES = 1 << 26
SEPARATORS = (";", "\t", ",", " ")  # the first one that a line holds separates it
NAME = re.compile(r"(?:pos(?:ition)?[ _]?)?([xy])(?:[ _]?[\[(]?m[\])]?)?")  # x, pos_x, x_m, x [m]
TRACK_NAMES = {
    "right": re.compile(r"(?:w(?:idth)?_)?(?:tr(?:ack)?_)?right(?:_m)?"),  # w_tr_right_m, as in the TUM's race track database
    "left": re.compile(r"(?:w(?:idth)?_)?(?:tr(?:ack)?_)?left(?:_m)?"),
    "speed": re.compile(r"v(?:x|el)?(?:_mps|_m_s)?|speed(?:_m_s)?"),  # vx_mps, as in the TUM's race lines
}
DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+")


def read_csv(path: Path) -> Array:
    """
    Read waypoints: one point per line.

    Empty lines and lines that begin with ``#`` are skipped, but for the one that names the columns.

    Returns:
        Points, shape ``(n, 2)``.

    Raises:
        ConfigError: The file cannot be read, a number in it, or its columns: file, line and column are named.
    """
    cells, columns, _, separator = table(path)
    return np.array([[number(path, i, name, row, columns[name], separator) for name in "xy"] for i, row in cells]).reshape(-1, 2)


def read_track(path: Path) -> dict[str, Array]:
    """
    Read the centre line of a track with its widths, or a race line.

    Returns:
        Columns by name, each of shape ``(n,)``: ``x`` and ``y`` in m; where the file names them ``right`` and ``left``, from the line to the edges
        of the track in m, and ``speed`` in m/s.

    Raises:
        ConfigError: As `read_csv`; or one width is there without the other, or a width or speed is negative.
    """
    cells, columns, names, separator = table(path)
    for name, pattern in TRACK_NAMES.items():
        if found := [i for i, cell in enumerate(names) if pattern.fullmatch(cell.strip().lower())]:
            columns[name] = found[0]
    if ("right" in columns) != ("left" in columns):
        raise ConfigError(f"{path}: the header must name both widths, w_right and w_left, or none, got {', '.join(names)}")
    values = {name: np.array([number(path, i, name, row, column, separator) for i, row in cells]) for name, column in columns.items()}
    for name in TRACK_NAMES:
        if name in values and (wrong := values[name] < 0.0).any():
            raise ConfigError(f"{path}, line {cells[int(np.argmax(wrong))][0]}, column {name}: must be at least 0, got {values[name][wrong][0]:g}")
    return values


def table(path: Path) -> tuple[list[tuple[int, list[str]]], dict[str, int], list[str], str]:
    """Return the cells of each line with its number, the columns of x and y, the names of all columns where they have names, and what separates."""
    text = read_text_file(path, "CSV with waypoints", MAX_CSV_BYTES)
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip(" \t,;")]
    rows = [(i, line) for i, line in lines if not is_comment(line)]
    if not rows:
        return [], {"x": 0, "y": 1}, [], " "
    separator = next((mark for mark in SEPARATORS if mark in rows[0][1]), " ")
    try:
        cells = [(i, split(line, separator)) for i, line in rows]
        first = cells[0][0]
        comments = [(i, split(line.lstrip("# \t"), separator)) for i, line in lines if is_comment(line) and i < first]
    except csv.Error as error:
        raise ConfigError(f"{path}: must be CSV with waypoints, got {error}") from error
    if not is_number(cells[0][1][0]):
        (line, names), *cells = cells
        return cells, named(path, line, names), names, separator
    if header := next(((line, names) for line, names in reversed(comments) if {"x", "y"} <= {*map(axis, names)}), None):
        return cells, named(path, *header), header[1], separator
    return cells, unnamed(path, cells), [], separator


def is_comment(line: str) -> bool:
    """Whether a line is a comment."""
    return line.lstrip().startswith("#")


def split(line: str, separator: str) -> list[str]:
    """Return the cells of a line."""
    return line.split() if separator == " " else [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]


def axis(name: str) -> str:
    """Return x or y for a column that is this coordinate in m, as ``X``, ``x_m``, ``pos_x`` or ``pose.position.x``; empty for others."""
    match = NAME.fullmatch(name.strip().lower().rpartition(".")[2])
    return match[1] if match else ""


def named(path: Path, line: int, names: list[str]) -> dict[str, int]:
    """Return the columns of x and y by their names."""
    found = [axis(name) for name in names]
    for name in "xy":
        if found.count(name) != 1:
            told = f": {name} is there {found.count(name)} times" if name in found else ""
            raise ConfigError(f"{path}, line {line}, column {name}: the header must name the columns x and y, got {', '.join(names)}{told}")
    return {name: found.index(name) for name in "xy"}


def unnamed(path: Path, rows: list[tuple[int, list[str]]]) -> dict[str, int]:
    """Return the first two columns, if they can be meant."""
    first = [float(decimal(cells[0])) for _, cells in rows if is_number(cells[0])]
    if len(rows[0][1]) > 2 and len(first) > 1 and all(a < b for a, b in pairwise(first)):
        raise ConfigError(
            f"{path}, line {rows[0][0]}, column 1: must be x where {len(rows[0][1])} columns have no names, but it always increases, as time or "
            f"arc length would: name the columns in a first line, such as x,y,v or t,x,y, got {', '.join(rows[0][1])}"
        )
    return {"x": 0, "y": 1}


def is_number(cell: str) -> bool:
    """Whether a cell reads as a number."""
    try:
        float(decimal(cell))
    except ValueError:
        return False
    return True


def decimal(cell: str) -> str:
    """Return a number with a decimal point, where it has a comma: a cell holds none that separates."""
    return cell.replace(",", ".") if DECIMAL_COMMA.fullmatch(cell) else cell


def number(path: Path, line: int, name: str, cells: list[str], column: int, separator: str) -> float:
    """Return one finite number."""
    cell = cells[column] if column < len(cells) else ""
    if not is_number(cell) or not math.isfinite(float(decimal(cell))):
        parted = {";": "semicolon", "\t": "tab", ",": "comma", " ": "space"}[separator]
        raise ConfigError(f"{path}, line {line}, column {name}: must be a finite number in m, got {cell!r} as cell {column + 1} between {parted}s")
    return float(decimal(cell))
