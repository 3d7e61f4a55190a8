# SPDX-License-Identifier: Apache-2.0
"""
The reference that is followed, interpolated at the controller's nodes.

Angles are unwrapped along time before they are interpolated, so a reference may cross
pi. `rti_mpc.rti.turns` decides in which turn all of it is followed. Before its first
row and after its last one a reference is held, never extrapolated.

`Track.lay_out` does the work that grows with the number of rows, and any thread may
call it. Following its result takes the same time for any number of rows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, End, Reference
from rti_mpc.model.model import Model

MAX_OFFSET_NS = 2**62  # limit of the time since the start of a reference: longer than any reference


class Track:
    """
    The reference being followed.

    Attributes:
        y_ref: Reference at nodes 1 to N of the last `look_up`, shape ``(N, ny)``.
        p: Stage parameters at nodes 0 to N of the last `look_up`, shape ``(N + 1, np)``.
        arriving: A checked reference and its `lay_out`, until `anchor` has a state to start at; else None.
    """

    def __init__(self, model: Model, N: int, dt_ns: int) -> None:
        self.y_ref: Array = np.zeros((N, model.ny))
        self.p: Array = np.tile(np.array(model.p_nominal), (N + 1, 1))
        self._nominal = self.p.copy()
        self._angles = [j for j, signal in enumerate(model.outputs) if signal.angle]
        self._nodes_ns = np.arange(N + 1) * dt_ns
        self.arriving: tuple[Reference, Array] | None = None
        self._reference: Reference | None = None
        self._rows: Array = np.zeros((1, model.ny))

    def misfit(self, reference: Reference, right_np: int) -> str:
        """
        Return why a reference cannot be followed, and what would be right; empty if it can.

        Args:
            reference: The message as it came.
            right_np: Number of parameters that a row may have.
        """
        (rows, ny), np_, right_ny = reference.y.shape, reference.p.shape[1], self.y_ref.shape[1]
        if rows >= 1 and ny == right_ny and np_ in (0, right_np) and reference.period_ns > 0:
            return ""
        return (
            f"a reference must have rows of {right_ny} outputs and of 0 or {right_np} parameters, and a positive period, "
            f"got {rows} rows of {ny} and {np_}, {reference.period_ns} ns"
        )

    def lay_out(self, reference: Reference) -> Array:
        """
        Return the rows of a reference for `anchor`: outputs, with angles unwrapped along time, and the parameters given. Changes no attribute.

        Args:
            reference: A checked reference, with the model's `ny` and none or the first of its `np`; the other parameters are nominal.
        """
        rows = np.hstack([reference.y, reference.p])
        for j in self._angles:
            rows[:, j] = np.unwrap(rows[:, j])
        return rows

    def anchor(self, stamp_ns: int) -> Reference:
        """
        Follow the reference that has arrived, and return it: from the state on if it was to start on arrival.

        Args:
            stamp_ns: Time of the last state.
        """
        assert self.arriving is not None
        (reference, rows), self.arriving = self.arriving, None
        if reference.stamp_ns == STAMP_ON_ARRIVAL:
            reference = replace(reference, stamp_ns=stamp_ns)
        self._reference, self._rows = reference, rows
        return reference

    def clear(self) -> None:
        """Forget the reference."""
        self._reference = None

    @property
    def loaded(self) -> bool:
        """Whether there is a reference to follow."""
        return self._reference is not None

    def ended(self, t_ns: int) -> End | None:
        """Return what to do after the end if the reference is over at a time, else None."""
        reference = self._reference
        if reference is None or t_ns <= reference.stamp_ns + (len(reference.y) - 1) * reference.period_ns:
            return None
        return reference.end

    def look_up(self, t_ns: int) -> None:
        """Write the reference from `t_ns` on, node 0 included for `p`, into `y_ref` and `p`."""
        assert self._reference is not None
        rows = self._rows
        since_ns = min(max(t_ns - self._reference.stamp_ns, -MAX_OFFSET_NS), MAX_OFFSET_NS)  # of two stamps that differ by more than an int64 holds
        at = np.clip((self._nodes_ns + since_ns) / self._reference.period_ns, 0, len(rows) - 1)
        below = np.minimum(at.astype(np.intp), max(len(rows) - 2, 0))
        fraction = (at - below)[:, np.newaxis]
        values = rows[below] + fraction * (rows[np.minimum(below + 1, len(rows) - 1)] - rows[below])
        ny, given = self.y_ref.shape[1], rows.shape[1]
        self.y_ref[:] = values[1:, :ny]
        self.p[:, : given - ny] = values[:, ny:]
        self.p[:, given - ny :] = self._nominal[:, given - ny :]
