# SPDX-License-Identifier: Apache-2.0
"""Tracking error of a robot, from the messages alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.contract.message import Reference
from rti_mpc.wire.info import Info


def tracking_error(info: Info, reference: Reference, stamps: NDArray[np.int64], x: Array) -> dict[str, Array]:
    """
    Compare states with a reference, interpolated at their stamps.

    Args:
        info: Which state is which output.
        reference: With its real stamp.
        stamps: Of the states, in ns, shape ``(n,)``.
        x: States, shape ``(n, nx)``.

    Returns:
        By name of an output that is a state: state minus reference, in its unit, angles within pi; and ``position``, the
        distance in the plane, in mm, where there is one. Shape ``(n,)``; NaN before row 0, against the last row after it.
    """
    row = (stamps - reference.stamp_ns) / reference.period_ns
    error, position = {}, info.tracked_position
    for i, k in info.tracked:
        label, y = info.outputs[i], reference.y[:, i]
        deviation = x[:, k] - np.interp(row, np.arange(len(y)), np.unwrap(y) if label.angle else y)
        error[label.name] = np.remainder(deviation + np.pi, 2 * np.pi) - np.pi if label.angle else deviation
    if position is not None:
        error["position"] = 1e3 * np.hypot(*(error[info.outputs[i].name] for i in position))
    return {name: np.where(row < 0.0, np.nan, values) for name, values in error.items()}
