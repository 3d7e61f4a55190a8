# SPDX-License-Identifier: Apache-2.0
"""
Frames of a recording: a table a stream, with columns named by field and signal, such as ``x.psi``, and units in the metadata.

A table is Arrow's, from which pandas, Polars and Parquet take it. Each row is a message;
of a reference, each of its rows is one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rti_mpc.contract.message import Reference
from rti_mpc.errors import MessageError
from rti_mpc.recording.reader import STREAM_OF_NAME, Recorded, Recording
from rti_mpc.wire.info import Info, Label
from rti_mpc.wire.layout import LAYOUTS, STAMP_LIMIT_NS, Field

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

LABELS_OF_WIDTH = {"nx": "states", "nu": "inputs", "ny": "outputs", "np": "parameters"}  # labels of a matrix, by the name of its row width
LABELS_OF_VECTOR = {"x": "states", "x0": "states", "u": "inputs", "y": "outputs", "d": "disturbances"}  # labels of a vector, by its name
UNIT_OF_SUFFIX = {"_ns": "ns", "_us": "us", "_s": "s"}  # units that the names of numbers end with
NUMBERS = ("uint8", "uint32", "uint64", "int64", "float64")
ARROW_TYPES = {"string": "string", "uint8[]": "binary", **{kind: kind for kind in NUMBERS}}  # by the type in .msg files

Column = tuple[str, str, Any]  # name, unit, values of Arrow


def table(recording: Recording, stream: str, robot: str | None = None, *, horizon: bool = False) -> pa.Table:
    """
    Return a stream as a table of Arrow.

    Columns: `robot_s`, the stamp of the message in s of the robot's clock; `local_s`, the time of its arrival in s since the
    recording was begun; then the message's own. Of vectors and of the first row of matrices there is one for each component,
    `field.signal`, with the names and units of the robot's ``info``. Each field of the table has its unit as metadata.

    Args:
        recording: The recording.
        stream: Name of the stream, such as ``telemetry`` or ``info``.
        robot: Name of the robot; None: the only one.
        horizon: Whether to add all rows of plans and references used, as a list for each component, `field.signal[]`.

    Raises:
        MessageError: There is no such stream, or no such robot, or more than one to choose from.
    """
    import pyarrow as pa

    robot = chosen(recording, robot)
    if stream not in STREAM_OF_NAME:
        raise MessageError(f"stream must be one of {', '.join(STREAM_OF_NAME)}, got {stream!r}")
    messages = list(recording.messages(robot, (stream,)))
    cls = STREAM_OF_NAME[stream].message
    columns: list[Column] = [("local_s", "s", pa.array([1e-9 * (recorded.local_ns - recording.start_ns) for recorded in messages], pa.float64()))]
    if STREAM_OF_NAME[stream].by_role:
        columns.append(("role", "", pa.array([recorded.role for recorded in messages], pa.string())))
    if cls is None:
        columns.append(("json", "", pa.array([text_of(recorded) for recorded in messages], pa.string())))
    else:
        decoded = [recorded.message for recorded in messages]
        if cls is Reference:
            columns, decoded = exploded(columns, decoded)
        columns.insert(0, ("robot_s", "s", pa.array([robot_s(message.stamp_ns) for message in decoded], pa.float64())))
        labels = labels_of(recording, robot)
        for field in LAYOUTS[cls]:
            columns += columns_of(field, [getattr(message, field.name) for message in decoded], labels, horizon=horizon)
    schema = pa.schema([pa.field(name, values.type, metadata={"unit": unit} if unit else None) for name, unit, values in columns])
    return pa.Table.from_arrays([values for _, _, values in columns], schema=schema)


def text_of(recorded: Recorded) -> str:
    """
    Return the text of a JSON object.

    Raises:
        MessageError: It is not UTF-8.
    """
    try:
        return recorded.received.payload.decode()
    except UnicodeDecodeError as error:
        raise MessageError(f"{recorded.received.key} must be JSON in UTF-8, got {error.reason} at byte {error.start}") from None


def robot_s(stamp_ns: int) -> float:
    """Return a stamp in s; NaN for a reference that is anchored later, whose copy is in the stream ``reference/anchored``."""
    return 1e-9 * stamp_ns if stamp_ns > -STAMP_LIMIT_NS else np.nan


def frame(recording: Recording, stream: str, robot: str | None = None, *, horizon: bool = False) -> pd.DataFrame:
    """
    Return a stream as a frame of pandas, as `table` has it; ``frame.attrs["units"]`` has the units of its columns by name.

    Raises:
        MessageError: As `table`.
    """
    arrow = table(recording, stream, robot, horizon=horizon)
    result = arrow.to_pandas()
    result.attrs["units"] = units(arrow)
    return result


def units(arrow: pa.Table) -> dict[str, str]:
    """Return the units of the columns of a table, by name."""
    return {field.name: field.metadata[b"unit"].decode() for field in arrow.schema if field.metadata}


def export(recording: Recording, folder: Path, *, horizon: bool = False) -> list[tuple[Path, int]]:
    """
    Write every stream of every robot as a Parquet file, ``<folder>/<robot>/<stream>.parquet``; return the files with their rows.

    Raises:
        MessageError: A message is none of its stream.
        OSError: A file cannot be written.
    """
    import pyarrow.parquet as pq

    written = []
    for robot, streams in recording.streams.items():
        for stream in streams:
            path = folder / robot / f"{stream.replace('/', '_')}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            arrow = table(recording, stream, robot, horizon=horizon)
            pq.write_table(arrow, path, compression="zstd")
            written.append((path, arrow.num_rows))
    return written


def chosen(recording: Recording, robot: str | None) -> str:
    """
    Return the robot, or the only one if none is named.

    Raises:
        MessageError: It is not in the recording, or there are several.
    """
    robots = recording.robots
    if robot in robots or (robot is None and len(robots) == 1):
        return robot or robots[0]
    raise MessageError(f"robot must be one of {', '.join(robots) or 'none, as the recording is empty'}, got {robot!r}")


def labels_of(recording: Recording, robot: str) -> dict[str, Sequence[Label]]:
    """Return the labels of each kind of vector, from the first description by a controller, or else by any other; empty without one."""
    infos = sorted(recording.infos(robot), key=lambda recorded: recorded.role != "controller")
    for recorded in infos:
        try:
            info = Info.from_received(recorded.received)
        except MessageError:
            continue
        if info.states:
            kinds = {kind: getattr(info, kind) for kind in ("states", "inputs", "outputs", "disturbances")}
            with suppress(LookupError, TypeError):
                kinds["parameters"] = [Label(str(signal["name"]), str(signal["unit"])) for signal in recorded.message["stage_parameters"]]
            return kinds
    return {}


def exploded(columns: Iterable[Column], references: Sequence[Reference]) -> tuple[list[Column], list[Reference]]:
    """Return each row of references as a message of its own, with the time of that row."""
    rows = [(i, k) for i, reference in enumerate(references) for k in range(len(reference.y))]
    indices = np.array([i for i, _ in rows], np.int64)
    single = [
        Reference(r.epoch, r.seq, r.stamp_ns + k * r.period_ns, r.period_ns, r.end, r.y[k : k + 1], r.p[k : k + 1])
        for r, k in ((references[i], k) for i, k in rows)
    ]
    return [(name, unit, values.take(indices)) for name, unit, values in columns], single


def columns_of(field: Field, values: Sequence[Any], labels: dict[str, Sequence[Label]], *, horizon: bool) -> list[Column]:
    """Return the columns of a field of a message."""
    import pyarrow as pa

    if field.kind != "float64[]":
        unit = next((unit for suffix, unit in UNIT_OF_SUFFIX.items() if field.name.endswith(suffix)), "")
        if field.member_of is not None:
            return [(field.name, "", pa.array([value.name for value in values], pa.string()))]
        return [(field.name, unit, pa.array(values, getattr(pa, ARROW_TYPES[field.kind])()))]
    names = labels.get(LABELS_OF_WIDTH[field.width] if field.width else LABELS_OF_VECTOR.get(field.name, ""), ())
    width = max((value.shape[-1] for value in values if value.size), default=0)
    found = [names[i] if i < len(names) else Label(str(i), "") for i in range(width)]
    pick: Callable[[Any], Any] = (lambda value: value[0]) if field.width else (lambda value: value)
    first = np.full((len(values), width), np.nan)
    for i, value in enumerate(values):
        if value.size:
            first[i, : value.shape[-1]] = pick(value)
    columns: list[Column] = [(f"{field.name}.{label.name}", label.unit, pa.array(first[:, i])) for i, label in enumerate(found)]
    if horizon and field.width:
        for i, label in enumerate(found):
            rows = [value[:, i] if i < value.shape[1] else None for value in values]
            columns.append((f"{field.name}.{label.name}[]", label.unit, pa.array(rows, pa.list_(pa.float64()))))
    return columns
