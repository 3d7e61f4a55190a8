# SPDX-License-Identifier: Apache-2.0
"""Tracking error of a robot, from the messages alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.contract.message import Reference
from rti_mpc.contract.status import Mode
from rti_mpc.signals import plane
from rti_mpc.wire.info import Info

NOTHING_TRACKED = (Mode.IDLE, Mode.WAITING, Mode.STOPPED)  # a robot that brakes for a fault has an error, one that was stopped has none
SAID_NS = 1_000_000_000  # for which a sample's mode counts, beyond a period: then there is no controller
MAX_DT_S = 60.0  # that is believed of a description


def tracked(times: NDArray[np.int64], told: Sequence[tuple[int, Mode]], dt_s: float) -> NDArray[np.bool_]:
    """
    Say when a reference is tracked.

    Args:
        times: In ns, shape ``(n,)``.
        told: Time and mode of the samples around, oldest first.
        dt_s: Sampling period, NaN or infinite where it is not known.

    Returns:
        Whether the last sample before each time followed a reference, shape ``(n,)``. Before the first one it is assumed: there may be
        samples that are not heard.
    """
    if not told:
        return np.ones(len(times), bool)
    begins = np.maximum.accumulate(np.array([time_ns for time_ns, _ in told], np.int64))  # a braking sample may have a later stamp than the next
    follows = np.array([mode not in NOTHING_TRACKED for _, mode in told])
    last = np.searchsorted(begins, times, side="right") - 1
    told_ns = SAID_NS + (int(1e9 * min(dt_s, MAX_DT_S)) if np.isfinite(dt_s) else 0)
    return np.array((last < 0) | (follows[last] & (times - begins[last] <= told_ns)), bool)


def tracking_error(info: Info, references: Sequence[Reference], stamps: NDArray[np.int64], y: Mapping[int, Array]) -> dict[str, Array]:
    """
    Compare outputs with the last reference that had begun, interpolated at their stamps.

    Args:
        info: Labels of the outputs.
        references: With their real stamps, oldest first.
        stamps: Of the outputs, in ns, shape ``(n,)``.
        y: Some of the outputs by their indices, each of shape ``(n,)``.

    Returns:
        By name of each of these outputs: itself minus reference, in its unit, rotations written near to it; and ``position``, the
        distance in the plane, in mm, where both its outputs are among them. Shape ``(n,)``; NaN before any row 0, against the last row after it.
    """
    errors: dict[str, Array] = {}
    for reference in references:
        begun = stamps >= reference.stamp_ns
        for name, values in _error(info, reference, stamps, y).items():
            errors[name] = np.where(begun, values, errors.get(name, np.nan))
    return errors


def _error(info: Info, reference: Reference, stamps: NDArray[np.int64], y: Mapping[int, Array]) -> dict[str, Array]:
    row, rows, position = (stamps - reference.stamp_ns) / reference.period_ns, reference.y.copy(), plane(info.outputs)
    rotations = info.rotations("outputs")
    rotations.unwrap(rows)
    wanted = np.column_stack([np.interp(row, np.arange(len(rows)), column) for column in rows.T])
    values: Array = np.full_like(wanted, np.nan)
    for i, column in y.items():
        values[:, i] = column
    deviation = rotations.difference(values, wanted)
    error = {info.outputs[i].name: deviation[:, i] for i in y}
    if position is not None and set(position) <= set(y):
        error["position"] = 1e3 * np.hypot(*(error[info.outputs[i].name] for i in position))
    return error
