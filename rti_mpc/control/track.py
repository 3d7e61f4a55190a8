# SPDX-License-Identifier: Apache-2.0
"""
The reference that is followed, interpolated at the controller's nodes.

Rotations are written without jumps along time before they are interpolated, so a reference may
cross pi, or change the sign of a quaternion. `rti_mpc.rti.turns` decides in which turn all of it is followed. Before its first
row and after its last one a reference is held, never extrapolated.

`Track.lay_out` does the work that grows with the number of rows, and any thread may
call it. Following its result takes the same time for any number of rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from struct import Struct

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind, compiled, function
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, End, Reference
from rti_mpc.model.model import Model


class Track:
    """
    The reference being followed.

    Attributes:
        y_ref: Reference at nodes 1 to N of the last `look_up`, shape ``(N, ny)``.
        p: Stage parameters at nodes 0 to N of the last `look_up`, shape ``(N + 1, np)``.
        arriving: A checked reference and its `lay_out`, until `anchor` has a state to start at; else None.
        arriving_for: Epoch of a new life of the robot that was heard when it came, but not believed yet; None if there was none.
    """

    def __init__(self, model: Model, N: int, dt_ns: int, *, compile: bool = True) -> None:
        self.y_ref: Array = np.zeros((N, model.ny))
        self._nominal: Array = np.array(model.p_nominal)
        self.p: Array = np.tile(self._nominal, (N + 1, 1))
        self._rotations = model.rotations("outputs")
        grid, at, below = np.zeros(3), np.zeros(N + 1), np.zeros(N + 1)
        self._grid, self._write, self._below = grid.data, Struct("3d").pack_into, below
        # A reference gives no parameters, or has all of them in its rows.
        self._found = {columns: np.zeros((N + 1, 2 * columns)) for columns in (model.ny, model.ny + model.np_)}
        functions = [placing(N, dt_ns), *(interpolation(N, model.ny, columns) for columns in self._found)]
        place, *interpolations = compiled(*functions) if compile else functions
        self._place = bind(place, {"grid": grid}, {"at": at, "below": below})
        outputs = {"y_ref": self.y_ref, "p": self.p}
        self._interpolate: dict[int, Callable[[], None]] = {}
        for interpolate, (columns, found) in zip(interpolations, self._found.items(), strict=True):
            written = {name: outputs[name] for name in interpolate.name_out()}
            self._interpolate[columns] = bind(interpolate, {"found": found, "at": at, "below": below}, written)
        self.arriving: tuple[Reference, Array] | None = None
        self.arriving_for: int | None = None
        self._reference: Reference | None = None
        self._rows: Array = np.zeros((1, 2 * model.ny))

    def misfit(self, reference: Reference, right_np: int) -> str:
        """
        Return why a reference cannot be followed, and what would be right; empty if it can.

        Args:
            reference: The message as it came.
            right_np: Number of parameters that a row may have.
        """
        right_ny, shapes = self.y_ref.shape[1], f"{reference.y.shape} and {reference.p.shape}"
        if reference.y.ndim != 2 or reference.p.ndim != 2:
            return f"a reference must be tables of outputs and of parameters, got shapes {shapes}"
        (rows, ny), np_ = reference.y.shape, reference.p.shape[1]
        if rows < 1 or ny != right_ny or np_ not in (0, right_np) or reference.period_ns <= 0:
            return (
                f"a reference must have rows of {right_ny} outputs and of 0 or {right_np} parameters, and a positive period, "
                f"got {rows} rows of {ny} and {np_}, {reference.period_ns} ns"
            )
        return "" if len(reference.p) == rows else f"a reference must have as many rows of parameters as of outputs, got shapes {shapes}"

    def lay_out(self, reference: Reference) -> Array:
        """
        Return the rows of a reference for `anchor`: outputs, with rotations unwrapped along time, the parameters if any are given, and after them
        by how much each of these changes to the next row. Changes no attribute.

        Args:
            reference: A checked reference, with the model's `ny` and none or the first of its `np`; the other parameters are nominal.
        """
        rows, given = np.hstack([reference.y, reference.p]), reference.p.shape[1]
        if given:
            rows = np.hstack([rows, np.tile(self._nominal[given:], (len(rows), 1))])
        self._rotations.unwrap(rows)
        return np.hstack([rows, np.diff(rows, axis=0, append=rows[-1:])])

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
        self.p[:] = self._nominal
        return reference

    def clear(self, life: int | None = None) -> None:
        """Forget the reference, and one that arrives unless it came after a new life, by its epoch, was first heard: it is for that life."""
        self._reference = None
        if life is None or life != self.arriving_for:
            self.arriving = None

    @property
    def followed(self) -> Reference | None:
        """The reference that is followed; None if there is none."""
        return self._reference

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
        columns = rows.shape[1] // 2
        self._write(self._grid, 0, t_ns - self._reference.stamp_ns, self._reference.period_ns, len(rows) - 1)
        self._place()
        rows.take(self._below.astype(np.intp), axis=0, out=self._found[columns], mode="clip")
        self._interpolate[columns]()


def placing(N: int, dt_ns: int) -> ca.Function:
    """Build ``grid -> (at, below)``: the place of each node among the rows, and the row before it; `grid` is offset, period and last row."""
    grid = ca.SX.sym("grid", 3)
    since_ns, period_ns, last = ca.vertsplit(grid)
    at = ca.fmin(ca.fmax((ca.DM(range(N + 1)) * dt_ns + since_ns) / period_ns, 0), last)
    return function("placing", {"grid": grid}, {"at": at, "below": ca.fmin(ca.floor(at), ca.fmax(last - 1, 0))})


def interpolation(N: int, ny: int, columns: int) -> ca.Function:
    """Build ``(found, at, below) -> (y_ref, p)``, the latter only if there are more columns than outputs; `found` holds rows and their changes."""
    found, at, below = ca.SX.sym("found", 2 * columns, N + 1), ca.SX.sym("at", N + 1), ca.SX.sym("below", N + 1)
    values = found[:columns, :] + ca.repmat((at - below).T, columns, 1) * found[columns:, :]
    written = {"y_ref": values[:ny, 1:]} | ({"p": values[ny:, :]} if columns > ny else {})
    return function(f"interpolation_{columns}", {"found": found, "at": at, "below": below}, written)
