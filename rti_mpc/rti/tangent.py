# SPDX-License-Identifier: Apache-2.0
r"""
Tangent space of the states: small changes of a state that keep the length of its quaternions.

A unit quaternion has four numbers for the three angles by which a body can turn. With
:math:`\theta`, rad about the axes of the body,

.. math::

    dq = \tfrac12 \, q \otimes (0, \theta) = T \theta, \qquad \theta = 4 T^T dq .

The length cannot be controlled, so that regulators are designed in these coordinates,
as in [Sola2017]_, and their gains written for the states. All other states are
coordinates of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.model.model import Model


class Tangent(NamedTuple):
    """
    Coordinates of the tangent space.

    Attributes:
        basis: T, small changes of the state per coordinate, an expression of the state, shape ``(nx, nt)``.
        inverse: Coordinates of a small change, likewise, shape ``(nt, nx)``.
        states: Of each coordinate, the state that it stands in for: angles for x, y, z of a quaternion, nothing for w.
        factor: By how much a coordinate is larger than that state near no rotation, shape ``(nt,)``: 2 for angles, else 1.
    """

    basis: ca.SX
    inverse: ca.SX
    states: list[int]
    factor: Array

    def measured(self, sizes: Array) -> Array:
        """Return sizes of changes of the states, shape ``(nx,)``, as sizes of the coordinates, shape ``(nt,)``."""
        return self.factor * sizes[self.states]


def tangent(model: Model) -> Tangent:
    """Return the tangent space at the state of a model."""
    basis, inverse, factor = ca.SX.eye(model.nx), ca.SX.eye(model.nx), np.ones(model.nx)
    quaternions = model.rotations("states").quaternions
    for places in map(list, quaternions):
        w, x, y, z = ca.vertsplit(model.x[places])
        turning = ca.blockcat([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) / 2
        basis[places, places[1:]], inverse[places[1:], places] = turning, 4 * turning.T
        factor[places[1:]] = 2.0
    dropped = {places[0] for places in quaternions}
    states = [j for j in range(model.nx) if j not in dropped]
    return Tangent(basis[:, states], inverse[states, :], states, factor[states])
