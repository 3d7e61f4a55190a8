# SPDX-License-Identifier: Apache-2.0
"""Tracking error of a robot, from the messages alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.contract.message import Reference
from rti_mpc.signals import plane
from rti_mpc.wire.info import Info


def tracking_error(info: Info, reference: Reference, stamps: NDArray[np.int64], y: Mapping[int, Array]) -> dict[str, Array]:
    """
    Compare outputs with a reference, interpolated at their stamps.

    Args:
        info: Labels of the outputs.
        reference: With its real stamp.
        stamps: Of the outputs, in ns, shape ``(n,)``.
        y: Some of the outputs by their indices, each of shape ``(n,)``.

    Returns:
        By name of each of these outputs: itself minus reference, in its unit, angles within pi; and ``position``, the distance
        in the plane, in mm, where both its outputs are among them. Shape ``(n,)``; NaN before row 0, against the last row after it.
    """
    row = (stamps - reference.stamp_ns) / reference.period_ns
    error, position = {}, plane(info.outputs)
    for i, values in y.items():
        label, wanted = info.outputs[i], reference.y[:, i]
        deviation = values - np.interp(row, np.arange(len(wanted)), np.unwrap(wanted) if label.angle else wanted)
        error[label.name] = np.remainder(deviation + np.pi, 2 * np.pi) - np.pi if label.angle else deviation
    if position is not None and set(position) <= set(y):
        error["position"] = 1e3 * np.hypot(*(error[info.outputs[i].name] for i in position))
    return {name: np.where(row < 0.0, np.nan, values) for name, values in error.items()}
