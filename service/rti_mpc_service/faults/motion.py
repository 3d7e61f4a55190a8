# SPDX-License-Identifier: Apache-2.0
"""
Motion that a robot's reaction to a fault is measured by: its position in the plane, or else all of its outputs.

Speed and way are lengths in the space of these, in their common SI unit, so that the same promises hold in any unit.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.contract.message import Reference
from rti_mpc.rotation import Rotations
from rti_mpc.si import ones, read
from rti_mpc.signals import Signal, in_plane, plane
from rti_mpc_service.rig.run_data import wanted

if TYPE_CHECKING:
    from rti_mpc.model.model import Model

DRIVEN_SPEED_M_S = 0.1  # least speed at which a robot on a path counts as driven
DRIVEN_OUTPUT_SPEED = 0.02  # the same of outputs, in their SI unit / s


class Motion:
    """
    Measured outputs of a model, in SI units. Not for several threads at once.

    Attributes:
        unit: Their SI unit, ``"1"`` if they have several.
        driven_speed: Least speed at which the robot counts as driven, in the unit / s.
    """

    def __init__(self, model: Model) -> None:
        place = plane(model.outputs) if in_plane(model.outputs) else None
        self._columns = list(range(model.ny) if place is None else place)
        outputs = [model.outputs[i] for i in self._columns]
        self._one = ones(outputs)
        measured = [replace(output, unit=in_si(output)) for output in outputs]
        self.unit = measured[0].unit if len({read(output.unit).dimension for output in outputs}) == 1 else "1"
        self.driven_speed = DRIVEN_OUTPUT_SPEED if place is None else DRIVEN_SPEED_M_S
        self._rotations = Rotations.of(measured, model.quaternions)
        self._h, self._p = model.h(), model.p_nominal

    def position(self, x: Array) -> Array:
        """Return the measured outputs of states, shape ``(..., nx)`` to ``(..., k)``."""
        y = np.array(self._h(np.atleast_2d(x).T, self._p))[self._columns].T / self._one
        return np.asarray(y.reshape(*x.shape[:-1], len(self._columns)))

    def wanted(self, reference: Reference | None, stamp_ns: NDArray[np.int64]) -> Array:
        """Return those of a reference at stamps, shape ``(..., k)``; NaN without one."""
        if reference is None:
            return np.full((*stamp_ns.shape, len(self._columns)), np.nan)
        return np.asarray(wanted(reference, stamp_ns)[..., self._columns] / self._one)

    def distance(self, a: Array, b: Array) -> Array:
        """Return how far outputs are from each other, both of shape ``(..., k)``, rotations written near to each other; shape ``(...)``."""
        return np.asarray(np.linalg.norm(self._rotations.difference(a, b), axis=-1))


def in_si(output: Signal) -> str:
    """Return the SI unit of an output: its own text if it is one."""
    unit = read(output.unit)
    return output.unit if unit.size == 1.0 else unit.in_si
